"""Reconstructs a solved part of a step, for its derivatives."""

from __future__ import annotations

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.box import Box, BoxType, define
from diffcloud.sim.compiled.data import Floats
from diffcloud.sim.contact.places import as_elements
from diffcloud.sim.implicit.equation import place_points, set_motion
from diffcloud.sim.implicit.matrix import newton_matrix
from diffcloud.sim.implicit.scene import BODY, PARTS, Kept, Scene, Work, follow, no_past
from diffcloud.sim.implicit.step import begin_part


class SolvedType(BoxType):  # type: ignore[misc]
    """Numba type of `Solved`."""


class Solved(Box):  # type: ignore[misc]
    """Solution of one part of a step.

    Fields:
        velocity: [D, 3] solution.
        turned: [B, 12] results of `rigid.spin`.
        touching: the contacts as elements of terms.
        matrix: the exact Newton matrix, factorised.
        gone: fraction of the step at the end of this part. Prescribed nodes have covered this fraction of their path.
    """


define(Solved, SolvedType, ["velocity", "turned", "touching", "matrix", "gone"])


@kernel
def solved_part(
    work: Work,
    scene: Scene,
    obstacles: Floats,
    step: int,
    part: int,
    positions: Floats,
    velocities: Floats,
    bodies: Floats,
    kept: Kept,
) -> Solved:
    """Reconstruct a part of a step, and set its start and motion in `work`.

    Args:
        obstacles: [S + 1, O, 3] obstacle points [m].
        positions, velocities, bodies: [S + 1, ...] states after each step.
    """
    nodes, count = positions.shape[1], bodies.shape[1]
    x, v, own = positions[0].copy(), velocities[0].copy(), bodies[0].copy()
    past = no_past(nodes)
    if scene.second_order and part > 0:
        if part > 1:
            _read(kept.states[part - 2], x, v, own)
        follow(past, (kept.ends[part - 1] - _begin(kept, part - 1)) / PARTS, x, v)
    if part > 0:
        _read(kept.states[part - 1], x, v, own)
    end = kept.ends[part]
    begin_part(
        work, scene.time_step, obstacles[step], obstacles[step + 1], _begin(kept, part), end, positions[step], x, v, own,
        past,
    )  # fmt: skip
    last, speed, others = np.empty((nodes, 3)), np.empty((nodes, 3)), np.empty((count, BODY))
    _read(kept.states[part], last, speed, others)
    velocity = np.empty((nodes + 2 * count, 3))
    for axis in range(3):
        for i in range(nodes):
            velocity[i, axis] = speed[i, axis]
        for b in range(count):
            velocity[nodes + 2 * b, axis], velocity[nodes + 2 * b + 1, axis] = others[b, 12 + axis], others[b, 15 + axis]
    points, turned = np.empty((len(work.start_points), 3)), np.empty((count, 12))
    place_points(work, velocity, work.final_scenery, points, turned)
    set_motion(work, velocity, points)
    listed = kept.listed[kept.first_place[part] : kept.first_place[part + 1]]
    numbers = kept.numbers[kept.first_place[part] : kept.first_place[part + 1]]
    touching = as_elements(work.planes, work.law, listed, numbers)
    work.wide, work.moved = work.pattern, np.arange(len(work.pattern.rows))
    matrix = newton_matrix(work, velocity, turned, listed, numbers, touching, 0.0)
    return Solved(velocity, turned, touching, matrix, end / PARTS)


@kernel
def _begin(kept: Kept, part: int) -> int:
    """Start of a part within its step, in units of 1 / `PARTS`."""
    return 0 if part == 0 or kept.ends[part - 1] == PARTS else kept.ends[part - 1]


@kernel
def _read(state: Floats, positions: Floats, velocities: Floats, bodies: Floats) -> None:
    """Read a row of `Kept.states` into positions, velocities and bodies."""
    nodes = len(positions)
    for i in range(nodes):
        for axis in range(3):
            positions[i, axis], velocities[i, axis] = state[3 * i + axis], state[3 * (nodes + i) + axis]
    for b in range(len(bodies)):
        for k in range(BODY):
            bodies[b, k] = state[6 * nodes + BODY * b + k]
