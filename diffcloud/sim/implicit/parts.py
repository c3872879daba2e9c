"""A solved part of a step, found again for its derivatives."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from diffcloud.sim.compiled.data import Floats, Ints, Motion, Parameters
from diffcloud.sim.compiled.kernel import kernel
from diffcloud.sim.compiled.lu import General
from diffcloud.sim.contact.places import Touching, as_elements
from diffcloud.sim.implicit.equation import place_points, set_motion
from diffcloud.sim.implicit.matrix import newton_matrix, pattern_for
from diffcloud.sim.implicit.scene import BODY, PARTS, Kept, Scene, Start
from diffcloud.sim.implicit.step import part_of_step


class Solved(NamedTuple):
    """The end of a part."""

    start: Start
    velocity: Floats
    """[D, 3]"""
    turned: Floats
    """[B, 12] as of `rigid.spin`."""
    touching: Touching
    matrix: General
    """The exact one, factorised."""
    end: int
    """Where the part ends, of `PARTS`."""


@kernel
def solved_part(
    scene: Scene,
    parameters: Parameters,
    obstacles: Floats,
    step: int,
    part: int,
    positions: Floats,
    velocities: Floats,
    bodies: Floats,
    holder: Ints,
    kept: Kept,
    motion: Motion,
) -> Solved:
    """A part of a step whose start is positions, velocities [V, 3] and bodies [B, 18]; `motion` takes its motion."""
    nodes, count = len(positions), len(bodies)
    begin, end = 0, kept.ends[part]
    first, x, v, own = positions, positions, velocities, bodies
    if part > kept.begins[step]:
        begin = kept.ends[part - 1]
        x, v, own = np.empty((nodes, 3)), np.empty((nodes, 3)), np.empty((count, BODY))
        _read(kept.states[part - 1], x, v, own)
    start = part_of_step(scene, parameters, obstacles, step, begin, end, first, x, v, own, holder)
    last, after, others = np.empty((nodes, 3)), np.empty((nodes, 3)), np.empty((count, BODY))
    _read(kept.states[part], last, after, others)
    velocity = np.empty((nodes + 2 * count, 3))
    for axis in range(3):
        for i in range(nodes):
            velocity[i, axis] = after[i, axis]
        for b in range(count):
            velocity[nodes + 2 * b, axis], velocity[nodes + 2 * b + 1, axis] = others[b, 12 + axis], others[b, 15 + axis]
    points, turned = np.empty((len(start.points), 3)), np.empty((count, 12))
    place_points(scene, start, velocity, start.final, points, turned)
    set_motion(start, parameters, velocity, points, motion)
    a, b = kept.first_place[part], kept.first_place[part + 1]
    listed = kept.listed[a:b]
    touching = as_elements(scene.planes, scene.law, listed, kept.numbers[a:b])
    pattern, moved = pattern_for(scene, scene.pattern, np.arange(len(scene.pattern.rows)), listed)
    matrix = newton_matrix(
        scene, start, parameters, motion, velocity, turned, listed, touching, 0.0, pattern, moved
    )
    return Solved(start, velocity, turned, touching, matrix, end)


@kernel
def _read(state: Floats, positions: Floats, velocities: Floats, bodies: Floats) -> None:
    """A row of `Kept.states`."""
    nodes = len(positions)
    for i in range(nodes):
        for axis in range(3):
            positions[i, axis], velocities[i, axis] = state[3 * i + axis], state[3 * (nodes + i) + axis]
    for b in range(len(bodies)):
        for k in range(BODY):
            bodies[b, k] = state[6 * nodes + BODY * b + k]


@kernel
def along(end: int) -> float:
    """Which part of its way a prescribed node has gone at the end of a part; the rest is where the step began."""
    return end / PARTS
