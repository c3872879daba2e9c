"""Problems in Newton: its vertex block descent (VBD), and the explicit solver that it differentiates.

Both have a stable neo-Hookean membrane, which is this simulator's at small strain. Hinges have the energies of this
simulator's after a conversion. `scripts/run_newton.py` builds the model, here and beside an exported cloth.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from diffcloud.simulators.problem import Problem, Track

Solver = Literal["vbd", "semi_implicit"]


@dataclass(frozen=True)
class Settings:
    """What one sets in Newton besides the problem."""

    solver: Solver = "vbd"
    step: float = 1 / 1200
    """[s]"""
    iterations: int = 10
    """Sweeps of a step of VBD."""


EXPLICIT = Settings("semi_implicit", step=2e-4)


def simulate(problem: Problem, settings: Settings | None = None) -> Track:
    """The motion in steps of constant length, in single precision on the processor."""
    script, _ = _modules()
    chosen, cloth = settings or Settings(), problem.arrays()
    explicit = chosen.solver == "semi_implicit"
    model = script.build(cloth, explicit)
    solver = script.solver_of(model, cloth, explicit, chosen.iterations)
    count = problem.steps_of(chosen.step)
    step, total = 1 / (problem.rate * count), (len(problem.times) - 1) * count
    wanted = problem.held_at(np.arange(total + 1) * step)
    list(script.frames(model, solver, cloth, wanted[:2], step, 1))  # kernels are compiled before the motion is timed
    began = time.process_time()
    frames = list(script.frames(model, solver, cloth, wanted, step, count))
    return Track(np.array(frames), time.process_time() - began)


def mean_height(problem: Problem, stretching: float = 1.0) -> tuple[float, float, float, float]:
    """As `ours.mean_height`, by the explicit solver, of a problem without table whose held nodes stay."""
    script, warp = _modules()
    cloth = problem.arrays()
    model = script.build(cloth, explicit=True, gradient=True)
    model.tri_materials.assign(model.tri_materials.numpy() * np.array([stretching, stretching, 1, 1, 1], dtype=np.float32))
    solver = script.solver_of(model, cloth, explicit=True)
    count = problem.steps_of(EXPLICIT.step)
    step, total = 1 / (problem.rate * count), (len(problem.times) - 1) * count
    states, control = [model.state() for _ in range(total + 1)], model.control()
    for number in range(2):  # the first time kernels are compiled
        began = time.process_time()
        with warp.Tape() as tape:
            for before, after in pairwise(states):
                before.clear_forces()
                solver.step(before, after, control, None, step)
        forward = time.process_time()
        seed = np.zeros((len(problem.mesh.nodes), 3), dtype=np.float32)
        seed[:, 2] = 1 / len(seed)
        tape.backward(grads={states[-1].particle_q: warp.array(seed, dtype=warp.vec3, device="cpu")})
        done = time.process_time()
        slopes = model.tri_materials.grad.numpy()[:, :2]
        derivative = float((slopes * model.tri_materials.numpy()[:, :2]).sum())
        if number == 0:
            tape.zero()
    return float(states[-1].particle_q.numpy()[:, 2].mean()), derivative, forward - began, done - forward


def _modules() -> tuple[Any, Any]:
    """Import and return (the script `run_newton`, warp). Warp's log messages about loaded kernels are turned off."""
    import warp

    warp.config.log_level = warp.LOG_WARNING
    from diffcloud.simulators.scripts import run_newton

    return run_newton, warp
