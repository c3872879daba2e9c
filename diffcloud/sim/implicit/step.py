"""An episode of implicit steps, each halved where it does not converge."""

from __future__ import annotations

import numpy as np

from diffcloud.sim.compiled.data import Floats, Ints, Parameters
from diffcloud.sim.compiled.kernel import kernel
from diffcloud.sim.compiled.pool import with_room
from diffcloud.sim.contact.places import gap_of
from diffcloud.sim.held import Held, aim, first_anchors, holders, take_anchors
from diffcloud.sim.implicit.equation import body_points, finish, room_for_motion
from diffcloud.sim.implicit.newton import Place, converge
from diffcloud.sim.implicit.room import Room, distance_of
from diffcloud.sim.implicit.scene import BODY, PARTS, Kept, Scene, Start, nothing_kept
from diffcloud.sim.status import DONE, INTERRUPTED, NOT_FINITE, STUCK


@kernel
def simulate(
    scene: Scene,
    held: Held,
    parameters: Parameters,
    track: Floats,
    obstacles: Floats,
    anchors: Floats,
    positions: Floats,
    velocities: Floats,
    bodies: Floats,
    keep: int,
    control: Ints,
    fault: Floats,
) -> tuple[int, int, Kept]:
    """All steps of one cloth.

    Args:
        track: [S, 3] displacement of the gripper at the end of each step [m]; of any length where no handle follows it.
        obstacles: [S + 1, O, 3] points of static and moving obstacles at the steps' times [m].
        anchors: [H, 3] takes those of the handles.
        positions, velocities: [S + 1, V, 3] the first is the start; take the others.
        bodies: [S + 1, B, 18] centre, orientation row by row, velocity, angular velocity; the first is the start.
        keep: below zero: nothing is kept for the derivatives.
        control: [2] finished steps are added to the first; the second one stops the run when it is not zero.
        fault: [6] where the run got stuck: the relative change, the kind of the closest pair (0: point and face, 1: two edges,
            2: point and plane, -1: none) and its points.

    Returns:
        (how it ended (`status`), the step in which it did, what the derivatives need)
    """
    steps, nodes = len(positions) - 1, positions.shape[1]
    kept = nothing_kept(steps if keep >= 0 else 0, 6 * nodes + BODY * bodies.shape[1])
    parts = 0
    anchors[:] = first_anchors(held, positions[0])
    motion = room_for_motion(scene)
    for step in range(steps):
        if control[1] != 0:
            return INTERRUPTED, step, kept
        take_anchors(held, track, step, positions[step], anchors)
        aim(held, track, step, anchors, parameters)
        holder = holders(held, step, nodes)
        for i in range(nodes):
            for axis in range(3):
                positions[step + 1, i, axis], velocities[step + 1, i, axis] = positions[step, i, axis], velocities[step, i, axis]
        for b in range(bodies.shape[1]):
            for k in range(BODY):
                bodies[step + 1, b, k] = bodies[step, b, k]
        place, length = 0, PARTS
        while place < PARTS:
            start = part_of_step(
                scene, parameters, obstacles, step, place, place + length, positions[step],
                positions[step + 1], velocities[step + 1], bodies[step + 1], holder,
            )  # fmt: skip
            done, here, room, change = converge(scene, start, parameters, motion)
            if not done:
                if length == 1:
                    fault[0] = change
                    _closest(scene, here, room, fault)
                    return STUCK, step, kept
                length //= 2
                continue
            finish(start, here.velocity, here.turned, positions[step + 1], velocities[step + 1], bodies[step + 1])
            place += length
            length = place & -place  # the other half, or that of the part which both make up
            if keep >= 0:
                kept = _remember(kept, parts, place, positions[step + 1], velocities[step + 1], bodies[step + 1], here)
                parts += 1
        if not _finite(positions[step + 1]):
            return NOT_FINITE, step, kept
        if keep >= 0:
            kept.begins[step + 1] = parts
        control[0] += 1
    return DONE, steps, kept


@kernel
def part_of_step(
    scene: Scene,
    parameters: Parameters,
    obstacles: Floats,
    step: int,
    begin: int,
    end: int,
    first: Floats,
    positions: Floats,
    velocities: Floats,
    bodies: Floats,
    holder: Ints,
) -> Start:
    """What the part [begin, end] of a step starts from, of `PARTS`; prescribed nodes and obstacles go straight.

    Args:
        first: [V, 3] positions at the start of the whole step [m].
        positions, velocities, bodies: at the start of this part.
    """
    count = scene.surface.point_count
    nodes, others = len(positions), scene.obstacle_points
    scenery, final, points = np.empty((others, 3)), np.empty((others, 3)), np.empty((count, 3))
    a, b = begin / PARTS, end / PARTS
    for o in range(others):
        for axis in range(3):
            x, y = obstacles[step, o, axis], obstacles[step + 1, o, axis]
            scenery[o, axis] = x + a * (y - x)
            final[o, axis] = y if end == PARTS else x + b * (y - x)
            points[nodes + o, axis] = scenery[o, axis]
    for i in range(nodes):
        for axis in range(3):
            points[i, axis] = positions[i, axis]
    body_points(scene, bodies, points, nodes + others)
    target = parameters.target.copy()
    if end < PARTS:
        for i in range(nodes):
            h = holder[i]
            if h >= 0:
                for axis in range(3):
                    target[h, axis] = first[i, axis] + b * (parameters.target[h, axis] - first[i, axis])
    part = (end - begin) / PARTS * scene.time_step
    return Start(
        part, positions.copy(), velocities.copy(), bodies.copy(), scenery, final, points, holder, target
    )


@kernel
def _finite(positions: Floats) -> bool:
    for i in range(len(positions)):
        for axis in range(3):
            if not np.isfinite(positions[i, axis]):
                return False
    return True


@kernel
def _remember(
    kept: Kept, part: int, end: int, positions: Floats, velocities: Floats, bodies: Floats, here: Place
) -> Kept:
    """The record with one part more."""
    ends, states, first = kept.ends, kept.states, kept.first_place
    if part + 1 >= len(ends):
        ends, first = np.empty(2 * len(ends), np.int64), np.empty(2 * len(ends) + 1, np.int64)
        for p in range(part):
            ends[p] = kept.ends[p]
        for p in range(part + 1):
            first[p] = kept.first_place[p]
    states = with_room(states, part, 1)
    ends[part] = end
    row, nodes = states[part], len(positions)
    for i in range(nodes):
        for axis in range(3):
            row[3 * i + axis], row[3 * (nodes + i) + axis] = positions[i, axis], velocities[i, axis]
    for b in range(len(bodies)):
        for k in range(BODY):
            row[6 * nodes + BODY * b + k] = bodies[b, k]
    used, more = first[part], len(here.listed)
    listed, numbers = with_room(kept.listed, used, more), with_room(kept.numbers, used, more)
    for e in range(more):
        for k in range(5):
            listed[used + e, k] = here.listed[e, k]
        for k in range(4):
            numbers[used + e, k] = here.numbers[e, k]
    first[part + 1] = used + more
    return Kept(kept.begins, ends, states, first, listed, numbers)


@kernel
def _closest(scene: Scene, here: Place, room: Room, fault: Floats) -> None:
    """The closest pair of all, into fault [6]."""
    smallest = np.inf
    fault[1] = -1.0
    planes = scene.planes
    for q in range(len(planes.points)):
        for w in range(len(planes.offsets)):
            gap = gap_of(planes, w, here.points, planes.points[q])
            if gap < smallest:
                smallest = gap
                fault[1], fault[2], fault[3], fault[4], fault[5] = 2.0, planes.points[q], w, -1.0, -1.0
    x, found = np.empty((4, 3)), np.empty(6)
    for c in range(len(room.pairs)):
        distance = distance_of(room.pairs, c, here.points, x, found)
        if distance < smallest:
            smallest = distance
            for k in range(5):
                fault[1 + k] = room.pairs[c, k]
