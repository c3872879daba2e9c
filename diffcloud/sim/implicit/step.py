"""The loop over the implicit steps of an episode. A step that does not converge is halved."""

from __future__ import annotations

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.copying import copy_to
from diffcloud.sim.compiled.data import Floats, Ints, Parameters
from diffcloud.sim.compiled.pool import with_room
from diffcloud.sim.contact.places import gap_of
from diffcloud.sim.held import Held, aim, first_anchors, holders, take_anchors
from diffcloud.sim.implicit.equation import body_points, finish
from diffcloud.sim.implicit.newton import converge
from diffcloud.sim.implicit.room import distance_of
from diffcloud.sim.implicit.scene import (
    BODY,
    PARTS,
    STUCK,
    Kept,
    Past,
    Scene,
    Work,
    follow,
    new_work,
    no_past,
    nothing_kept,
)
from diffcloud.sim.status import DONE, INTERRUPTED, NOT_FINITE

_GROWTH = 2.0
"""Largest ratio of the lengths of successive parts for BDF2, which is stable up to 1 + √2."""


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
    """Simulate all steps of one cloth.

    Args:
        track: [S, G, 3] displacement of each gripper at the end of each step [m]. Any length if no handle follows a track.
        obstacles: [S + 1, O, 3] points of static and moving obstacles at the start and after each step [m].
        anchors: [H, 3] receives the anchors of the handles.
        positions, velocities: [S + 1, V, 3] the first row is the initial state; receive the others.
        bodies: [S + 1, B, 18] centre, rotation matrix in row-major order, velocity, angular velocity, likewise.
        keep: negative to store nothing for the derivatives.
        control: [2] the first number counts finished steps. If another thread sets the second one, the run stops.
        fault: [6] receives details if a step does not converge: the relative change, the kind of the closest pair (0: point
            and face, 1: two edges, 2: point and plane, -1: none) and its points.

    Returns:
        The status, the index of the step in which the run ended, and the record for the derivatives.
    """
    steps, nodes = len(positions) - 1, positions.shape[1]
    kept = nothing_kept(steps if keep >= 0 else 0, 6 * nodes + BODY * bodies.shape[1])
    parts = 0
    copy_to(anchors, first_anchors(held, positions[0]))
    work, past = new_work(scene, parameters, nodes, bodies.shape[1]), no_past(nodes)
    for step in range(steps):
        if control[1] != 0:
            return INTERRUPTED, step, kept
        take_anchors(held, track, step, positions[step], anchors)
        aim(held, track, step, anchors, parameters)
        holder = holders(held, step, nodes)
        for i in range(nodes):
            if holder[i] != work.holder[i]:
                work.serves = 0.0
        work.holder = holder
        for i in range(nodes):
            for axis in range(3):
                positions[step + 1, i, axis], velocities[step + 1, i, axis] = (
                    positions[step, i, axis],
                    velocities[step, i, axis],
                )
        for b in range(bodies.shape[1]):
            for k in range(BODY):
                bodies[step + 1, b, k] = bodies[step, b, k]
        place, length = 0, PARTS
        while place < PARTS:
            begin_part(
                work, scene.time_step, obstacles[step], obstacles[step + 1], place, place + length, positions[step],
                positions[step + 1], velocities[step + 1], bodies[step + 1], past,
            )  # fmt: skip
            done, here, room, change = converge(work)
            if not done:
                if length == 1:
                    fault[0] = change
                    _closest(work, here.points, room.pairs, fault)
                    return STUCK, step, kept
                length //= 2
                continue
            if scene.second_order:
                follow(past, length / PARTS, positions[step + 1], velocities[step + 1])
            finish(work, here.velocity, here.turned, positions[step + 1], velocities[step + 1], bodies[step + 1])
            place += length
            length = place & -place  # the second half, or the sibling of the interval that both halves form
            if keep >= 0:
                kept = _remember(
                    kept,
                    parts,
                    place,
                    positions[step + 1],
                    velocities[step + 1],
                    bodies[step + 1],
                    here.listed,
                    here.numbers,
                )
                parts += 1
        if not _finite(positions[step + 1]):
            return NOT_FINITE, step, kept
        if keep >= 0:
            kept.begins[step + 1] = parts
        control[0] += 1
    return DONE, steps, kept


@kernel
def begin_part(
    work: Work,
    time_step: float,
    before: Floats,
    after: Floats,
    begin: int,
    end: int,
    first: Floats,
    positions: Floats,
    velocities: Floats,
    bodies: Floats,
    past: Past,
) -> None:
    """Set the start of the part [begin, end] of a step, in units of 1 / `PARTS`. Prescribed nodes and obstacles move
    straight.

    Args:
        time_step: of the whole step [s].
        before, after: [O, 3] obstacle points at the start and end of the step [m].
        first: [V, 3] positions at the start of the step [m].
        positions, velocities, bodies: at the start of this part.
        past: state before this part.
    """
    a, b = begin / PARTS, end / PARTS
    work.length = (b - a) * time_step
    work.keep, work.back, share = _weights(b - a, past.length[0])
    work.time_step = share * work.length
    keep, back = work.keep, work.back
    scenery, final, points, nodes = work.start_scenery, work.final_scenery, work.start_points, len(positions)
    for o in range(len(scenery)):
        for axis in range(3):
            x, y = before[o, axis], after[o, axis]
            scenery[o, axis] = x + a * (y - x)
            final[o, axis] = y if end == PARTS else x + b * (y - x)
            points[nodes + o, axis] = scenery[o, axis]
    x0, v0, own = work.start_positions, work.start_velocities, work.start_bodies
    holder, target, wanted = work.holder, work.target, work.parameters.target
    for i in range(nodes):
        h = holder[i]
        for axis in range(3):
            points[i, axis] = positions[i, axis]
            x0[i, axis] = keep * positions[i, axis] - back * past.positions[i, axis]
            v0[i, axis] = keep * velocities[i, axis] - back * past.velocities[i, axis]
            if h >= 0:
                way = wanted[h, axis] - first[i, axis]
                target[h, axis] = wanted[h, axis] if end == PARTS else first[i, axis] + b * way
    for body in range(len(own)):
        for k in range(BODY):
            own[body, k] = bodies[body, k]
    if len(own) > 0:
        body_points(work.rigid, own, points, work.first_body_point)


@kernel
def _weights(length: float, before: float) -> tuple[float, float, float]:
    """BDF2 weights of the last state, of the state before it, and of the rate at the end.

    Without an earlier state, or if the earlier part is too short for stability, these are the weights of backward Euler.

    Args:
        length, before: of this part and of the previous one, as fractions of a step.
    """
    if before == 0 or length > _GROWTH * before:
        return 1.0, 0.0, 1.0
    ratio = length / before
    whole = 1 + 2 * ratio
    return (1 + ratio) ** 2 / whole, ratio**2 / whole, (1 + ratio) / whole


@kernel
def _finite(positions: Floats) -> bool:
    for i in range(len(positions)):
        for axis in range(3):
            if not np.isfinite(positions[i, axis]):
                return False
    return True


@kernel
def _remember(
    kept: Kept, part: int, end: int, positions: Floats, velocities: Floats, bodies: Floats, listed: Ints, numbers: Floats
) -> Kept:
    """Append a part to the record."""
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
    used, more = first[part], len(listed)
    places, areas = with_room(kept.listed, used, more), with_room(kept.numbers, used, more)
    for e in range(more):
        if numbers[e, 0] == 0:
            continue
        for k in range(5):
            places[used, k] = listed[e, k]
        for k in range(4):
            areas[used, k] = numbers[e, k]
        used += 1
    first[part + 1] = used
    return Kept(kept.begins, ends, states, first, places, areas)


@kernel
def _closest(work: Work, points: Floats, pairs: Ints, fault: Floats) -> None:
    """Write the closest pair at points [N, 3] into `fault` [6]."""
    smallest = np.inf
    fault[1] = -1.0
    planes = work.planes
    for q in range(len(planes.points)):
        i = planes.points[q]
        if i < len(work.holder) and work.holder[i] >= 0:  # prescribed nodes may pass through planes
            continue
        for w in range(len(planes.offsets)):
            gap = gap_of(planes, w, points, i)
            if gap < smallest:
                smallest = gap
                fault[1], fault[2], fault[3], fault[4], fault[5] = 2.0, i, w, -1.0, -1.0
    x, found = np.empty((4, 3)), np.empty(6)
    for c in range(len(pairs)):
        distance = distance_of(pairs, c, points, x, found)
        if distance < smallest:
            smallest = distance
            for k in range(5):
                fault[1 + k] = pairs[c, k]
