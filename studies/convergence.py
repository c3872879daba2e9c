"""How far a simulated motion is from that of finer steps and of a finer mesh, and what it costs."""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from diffcloud.scene.description import Scene
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.properties import PARAMETERS
from diffcloud.sim.simulate import init, rollout

FINER = 4
"""Times the steps that errors of a step are measured with."""
NUDGE = 1e-10
"""[m] A random change of the start's coordinates; a chaotic motion turns it into one that can be seen."""
PUSH = 1e-4
"""[m] The same, of a size that no hand lays a cloth down to; what a motion turns into centimetres nobody can repeat."""
_SIDE = 3


@dataclass(frozen=True)
class Run:
    """One motion for each of nine pairs (stretching, density)."""

    nodes: NDArray[np.float64]
    """[9, V, 3] at the loss frame [m]; NaN where a motion diverged."""
    seconds: float
    """Of processor time for each motion."""


@dataclass(frozen=True)
class StepRow:
    """A scenario with steps of one size."""

    scenario: str
    integrator: str
    order: int
    steps_per_frame: int
    errors: NDArray[np.float64]
    """[9] RMS node distance at the loss frame to four times the steps [m]."""
    nudged: NDArray[np.float64]
    """[9] the same to a start that differs by `NUDGE` [m]."""
    pushed: NDArray[np.float64]
    """[9] and by `PUSH` [m]."""
    seconds: float
    """As of `Run`."""


@dataclass(frozen=True)
class MeshRow:
    """A scenario with a mesh cut finer."""

    scenario: str
    cuts: int
    nodes: int
    errors: NDArray[np.float64]
    """[9] RMS distance of the scenario's own nodes at the loss frame to one more cut [m]."""
    seconds: float


def pairs(scenario: Scenario) -> dict[str, torch.Tensor]:
    """Nine pairs: the middles of nine equal parts of the bounds of stretching and density, on their logarithmic scale."""
    axes = []
    for name in ("stretching", "density"):
        low, high = scenario.bounds.get(name, PARAMETERS[name].bounds)
        axes.append([low * (high / low) ** ((k + 0.5) / _SIDE) for k in range(_SIDE)])
    stretch, mass = zip(*itertools.product(*axes), strict=True)
    return {"stretching": torch.tensor(stretch), "density": torch.tensor(mass)}


def simulate(scenario: Scenario, scene: Scene, *, nudge: float = 0.0) -> Run:
    """The nine motions of a scenario in a variant of its scene, as far as the first loss frame."""
    system, _ = scene.build()
    frame = scenario.loss_frames[0] if scenario.loss_frames[0] >= 0 else scenario.frames + 1 + scenario.loss_frames[0]
    properties = scenario.properties(system, pairs(scenario))
    state = init(system, properties.batch)
    noise = np.random.default_rng(0).normal(size=state.positions.shape[1:])
    state = replace(state, positions=state.positions + nudge * torch.from_numpy(noise))
    began = time.process_time()
    with torch.no_grad():
        run = rollout(system, frame * scene.frame_steps, properties=properties, state=state, drop_diverged=True)
    return Run(run.positions[:, -1].numpy(), (time.process_time() - began) / properties.batch)


def step_study(scenario: Scenario, scene: Scene, sizes: list[int]) -> list[StepRow]:
    """What steps of each size [a frame] cost in accuracy, in a variant of the scenario's scene."""
    found: dict[int, Run] = {}

    def at(steps: int) -> Run:
        if steps not in found:
            found[steps] = simulate(scenario, replace(scene, frame_steps=steps))
        return found[steps]

    simulate(scenario, replace(scene, frame_steps=1))  # kernels are loaded before the first one is timed
    rows = []
    for steps in sizes:
        nudged, pushed = (
            _distance(at(steps).nodes, simulate(scenario, replace(scene, frame_steps=steps), nudge=size).nodes)
            for size in (NUDGE, PUSH)
        )
        rows.append(
            StepRow(
                scenario.name,
                scene.integrator,
                scene.order if scene.integrator == "implicit" else 1,
                steps,
                _distance(at(steps).nodes, at(FINER * steps).nodes),
                nudged,
                pushed,
                at(steps).seconds,
            )
        )
    return rows


def mesh_study(scenario: Scenario, cuts: int) -> list[MeshRow]:
    """What the mesh costs in accuracy: the scenario's own, and meshes whose edges are halved so many times."""
    nodes, finer = len(scenario.scene.mesh.nodes), scenario
    runs, sizes = [simulate(scenario, scenario.scene)], [nodes]
    for _ in range(cuts):
        finer = finer.finer()
        runs.append(simulate(finer, finer.scene))
        sizes.append(len(finer.scene.mesh.nodes))
    return [
        MeshRow(scenario.name, cut, sizes[cut], _distance(coarse.nodes[:, :nodes], fine.nodes[:, :nodes]), coarse.seconds)
        for cut, (coarse, fine) in enumerate(itertools.pairwise(runs))
    ]


def _distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """[9] RMS over nodes [m]."""
    return np.asarray(np.sqrt(((a - b) ** 2).sum(-1).mean(-1)))
