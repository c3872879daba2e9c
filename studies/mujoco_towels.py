"""Towels that MuJoCo lifts by a pad, simulated here at their true parameters: what the model lacks, without a fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diffcloud.mesh.shapes import grid_cloth
from diffcloud.mesh.topology import ClothMesh
from diffcloud.scene.scenarios.grid import LIFT, GridScenario, grid_scenario
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.simulators import mujoco, ours
from diffcloud.simulators.problem import REST_HEIGHT, Problem, Sheet, Track

COUNTS = (25, 19)
"""Nodes of MuJoCo's towel: about what its explicit steps bear for stiff and light cloths."""
_SECONDS, _RATE = 1.5, 10.0
_KEYS = 81
OLD, PAD = "single node, diagonals one way", "pad, alternating diagonals"


@dataclass(frozen=True)
class Towel:
    """A cloth and its lift: the pad holds the cell at one corner of MuJoCo's mesh."""

    seed: int
    sheet: Sheet
    size: tuple[float, float]
    """[m]"""
    friction: float
    path: Motion

    @property
    def pad(self) -> float:
        """Side of a square of the held cell's area [m]."""
        return float(np.sqrt(self.size[0] / (COUNTS[0] - 1) * self.size[1] / (COUNTS[1] - 1)))


@dataclass(frozen=True)
class Apart:
    """A towel simulated here beside MuJoCo's."""

    towel: Towel
    model: str
    nodes: tuple[int, int]
    rms: NDArray[np.float64]
    """[T] over this simulator's nodes, at tenths of a second from 0 [m]."""
    seconds: float
    """Of processor time."""


def towel(seed: int) -> Towel:
    """A random cloth in a random lift: log-uniform 8 to 120 N/m, 0.8 to 15 µN·m and 0.12 to 0.35 kg/m², Poisson's ratio up
    to 0.35, friction 0.2 to 0.8; lifted by 0.25 to 0.42 m in 1.6 to 2.6 s."""
    rng = np.random.default_rng(seed)

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    sheet = Sheet(
        stretching=between(8, 120),
        bending=between(8e-7, 1.5e-5),
        density=between(0.12, 0.35),
        damping=between(0.001, 0.006),
        poisson=float(rng.uniform(0, 0.35)),
    )
    size = (float(rng.uniform(0.26, 0.44)), float(rng.uniform(0.22, 0.34)))
    times = np.linspace(0, _SECONDS, _KEYS)
    up, lasts, lag = rng.uniform(0.25, 0.42), rng.uniform(1.6, 2.6), rng.uniform(0, 0.5)
    across, along = rng.uniform(-0.14, 0.05), rng.uniform(-0.12, 0.08)
    risen, moved = (np.clip((times - late) / lasts, 0, 1) for late in (0.0, lag))
    risen, moved = (part**3 * (10 - 15 * part + 6 * part**2) for part in (risen, moved))
    keys = zip(times.tolist(), (across * moved).tolist(), (along * moved).tolist(), (up * risen).tolist(), strict=True)
    path = Motion(tuple(Keyframe(time, (x, y, z)) for time, x, y, z in keys))
    return Towel(seed, sheet, size, float(rng.uniform(0.2, 0.8)), path)


def compare(seed: int, counts: tuple[tuple[int, int], ...]) -> Iterator[Apart]:
    """A towel in MuJoCo, against meshes of this simulator with a pad and with a single node."""
    one = towel(seed)
    truth = _truth(one)
    for nodes in counts:
        for model in (OLD, PAD):
            problem = _problem(one, nodes, model)
            track = ours.simulate(problem)
            wanted = _at(truth, one, problem.mesh)
            rms = np.sqrt(((track.nodes - wanted) ** 2).sum(-1).mean(-1))
            yield Apart(one, model, nodes, rms, track.seconds)


def _truth(one: Towel) -> Track:
    columns, rows = COUNTS
    corner = [columns * row + column for row in (rows - 2, rows - 1) for column in (columns - 2, columns - 1)]
    flat = grid_cloth(rows, columns, one.size[1], one.size[0])
    mesh = one_way(flat, columns, through=True)
    problem = _lifted(one, mesh, corner)
    settings, sheet = mujoco.stable(problem)
    return mujoco.simulate(replace(problem, sheet=sheet), settings)


def _problem(one: Towel, nodes: tuple[int, int], model: str) -> Problem:
    options: dict[str, object] = {"size_m": one.size, "nodes": nodes, "yaw_deg": 0.0, "grip_m": one.pad}
    options |= {"name": "towel"} if model == PAD else {"name": "towel", "grip": "pivot"}
    scene = grid_scenario(GridScenario.model_validate({**LIFT.model_dump(), **options})).scene
    mesh = scene.mesh if model == PAD else one_way(scene.mesh, nodes[0], through=False)
    return _lifted(one, mesh, scene.handles.nodes)


def _lifted(one: Towel, mesh: ClothMesh, held: list[int]) -> Problem:
    level = replace(mesh, nodes=np.column_stack([mesh.nodes[:, :2], np.full(len(mesh.nodes), REST_HEIGHT)]))
    moved = dict.fromkeys(held, one.path)
    return Problem("towel", level, one.sheet, _SECONDS, moved, table=0.0, friction=one.friction, rate=_RATE)


def one_way(mesh: ClothMesh, columns: int, *, through: bool) -> ClothMesh:
    """A grid's mesh with all diagonals in one direction, through its last corner or across it."""
    a = np.arange(len(mesh.nodes)).reshape(-1, columns)[:-1, :-1].ravel()
    b, c, d = a + 1, a + columns, a + columns + 1
    faces = [[a, b, d], [a, d, c]] if through else [[a, b, c], [b, d, c]]
    return replace(mesh, face_verts=np.array(faces).transpose(2, 0, 1).reshape(-1, 3))


def _at(truth: Track, one: Towel, mesh: ClothMesh) -> NDArray[np.float64]:
    """[T, V, 3] where MuJoCo's towel has the nodes of another mesh."""
    from scipy.interpolate import RegularGridInterpolator  # slow to import

    columns, rows = COUNTS
    grid = [np.linspace(0, side, count) for side, count in zip(one.size[::-1], (rows, columns), strict=True)]
    nodes = truth.nodes.reshape(-1, rows, columns, 3).transpose(1, 2, 0, 3)
    return np.asarray(RegularGridInterpolator(grid, nodes)(mesh.verts[:, ::-1])).transpose(1, 0, 2)
