"""Simulate problems in Newton with vertex block descent (VBD), or with its differentiable explicit solver.

Both have a stable neo-Hookean membrane, which agrees with DiffCloud's at small strain. Hinge stiffnesses are converted,
so that the bending energies agree. `scripts/run_newton.py` builds the model, both here and for an exported cloth.
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
    """Newton settings that are not part of the problem."""

    solver: Solver = "vbd"
    step: float = 1 / 1200
    """Time step [s]."""
    iterations: int = 10
    """Number of VBD iterations per step."""


EXPLICIT = Settings("semi_implicit", step=2e-4)


def simulate(problem: Problem, settings: Settings | None = None) -> Track:
    """Simulate a problem with constant time steps, in single precision on the CPU."""
    script, _ = _modules()
    chosen, cloth = settings or Settings(), problem.arrays()
    explicit = chosen.solver == "semi_implicit"
    model = script.build(cloth, explicit)
    solver = script.solver_of(model, cloth, explicit, chosen.iterations)
    count = problem.steps_of(chosen.step)
    step, total = 1 / (problem.rate * count), (len(problem.times) - 1) * count
    wanted = problem.held_at(np.arange(total + 1) * step)
    list(script.frames(model, solver, cloth, wanted[:2], step, 1))  # compile kernels before the time measurement
    began = time.process_time()
    frames = list(script.frames(model, solver, cloth, wanted, step, count))
    return Track(np.array(frames), time.process_time() - began)


def mean_height(problem: Problem, stretching: float = 1.0) -> tuple[float, float, float, float]:
    """As `ours.mean_height`, with the explicit solver. The problem must have no table and fixed held nodes."""
    script, warp = _modules()
    cloth = problem.arrays()
    model = script.build(cloth, explicit=True, gradient=True)
    model.tri_materials.assign(model.tri_materials.numpy() * np.array([stretching, stretching, 1, 1, 1], dtype=np.float32))
    solver = script.solver_of(model, cloth, explicit=True)
    count = problem.steps_of(EXPLICIT.step)
    step, total = 1 / (problem.rate * count), (len(problem.times) - 1) * count
    states, control = [model.state() for _ in range(total + 1)], model.control()
    for number in range(2):  # the first iteration compiles the kernels
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
