"""Newton's method for one part of a step."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from diffcloud.sim.compiled.data import Floats, Ints, Motion, Parameters
from diffcloud.sim.compiled.kernel import kernel
from diffcloud.sim.compiled.lu import solve_general
from diffcloud.sim.contact.places import Touching, as_elements, places
from diffcloud.sim.implicit.equation import place_points, residual, set_motion, start_velocities
from diffcloud.sim.implicit.matrix import newton_matrix, pattern_for
from diffcloud.sim.implicit.room import Room, away, distances_at, free_way, room_around, widened_room
from diffcloud.sim.implicit.scene import Scene, Start

_TOLERANCE = 1e-8
"""Expected next change of velocity, relative to the largest, at which Newton's method has converged.

It is overestimated: convergence is quadratic in the end, so what is left is far smaller."""
_ROUNDING = 1e-7
"""Below this relative change a step that no longer shrinks has reached the arithmetic's precision."""
_ITERATIONS = 30
_HALVINGS = 8
_SLOWEST = 1e-1
"""Velocities below this are at rest for the tolerance [m/s]."""
_LEAST_CAUTION = 0.05
"""Of the step after one that the exact matrix led astray."""
_REUSE = 1e-4
"""A relative change below this is followed by one correction with the same matrix instead of a new one."""
_PROBE = 1e-4
"""Part of the obstacles' way over which its effect is measured."""


class Place(NamedTuple):
    """Where Newton's method is."""

    velocity: Floats
    """[D, 3]"""
    scenery: Floats
    """[O, 3] how far obstacles have come [m]."""
    points: Floats
    """[N, 3] [m]"""
    turned: Floats
    """[B, 12] as of `rigid.spin`."""
    distances: Floats
    """[C] of the room's pairs [m]."""
    listed: Ints
    """[E, 5] what touches (`contact.places`)."""
    numbers: Floats
    """[E, 4]"""
    touching: Touching


@kernel
def _place(
    scene: Scene, room: Room, velocity: Floats, scenery: Floats, points: Floats, turned: Floats
) -> Place:
    """The place with what touches there."""
    distances = distances_at(scene, room, points)
    listed, numbers = places(scene.surface, scene.planes, scene.law[0, 1], room.pairs, distances, points)
    touching = as_elements(scene.planes, scene.law, listed, numbers)
    return Place(velocity, scenery, points, turned, distances, listed, numbers, touching)


@kernel
def converge(
    scene: Scene, start: Start, parameters: Parameters, motion: Motion
) -> tuple[bool, Place, Room, float]:
    """Solve one part of a step; `motion` is room for that of all points.

    Returns:
        (whether it converged, where, the room, the last relative change)
    """
    first = start_velocities(start)
    turned, still = np.empty((len(start.bodies), 12)), np.zeros((len(first), 3))
    begin, predicted = np.empty((len(start.points), 3)), np.empty((len(start.points), 3))
    place_points(scene, start, first, start.final, predicted, turned)
    place_points(scene, start, still, start.scenery, begin, turned)
    room = room_around(scene, start, begin, predicted)
    # velocities go on, as far as nothing is in the way
    here, room = _towards(scene, start, _place(scene, room, still, start.scenery, begin, turned), first, 1.0, room)
    left_over, trial_left = np.empty((len(first), 3)), np.empty((len(first), 3))
    _residual(scene, start, parameters, here, motion, left_over)
    pattern, moved = scene.pattern, np.arange(len(scene.pattern.rows))
    fresh, change, caution = False, np.inf, 1.0
    right, direction = np.empty((len(first), 3)), np.empty((len(first), 3))
    for _ in range(_ITERATIONS):
        if not fresh:
            pattern, moved = pattern_for(scene, pattern, moved, here.listed)
            set_motion(start, parameters, here.velocity, here.points, motion)
            matrix = newton_matrix(
                scene, start, parameters, motion, here.velocity, here.turned, here.listed, here.touching, caution, pattern, moved
            )
            fresh = True
        _pushed(scene, start, parameters, here, left_over, motion, right)
        if not solve_general(matrix, right, 0, direction):
            return False, here, room, change
        downhill, speed, size = 0.0, _SLOWEST, 0.0
        for i in range(len(first)):
            for axis in range(3):
                direction[i, axis] = -direction[i, axis]
                downhill -= left_over[i, axis] * direction[i, axis]
                speed = max(speed, abs(here.velocity[i, axis]))
                size = max(size, abs(direction[i, axis]))
        size /= speed
        rough = size > _REUSE
        bad = rough and downhill <= 0
        if not bad:
            here, room, short = _search(
                scene, start, parameters, here, direction, downhill, room, rough, motion, trial_left
            )
            left_over, trial_left = trial_left, left_over
            before, change = change, size
            expected = change * min(change / before, 1.0) if np.isfinite(before) else change
            settled = expected < _TOLERANCE or (change < _ROUNDING and change > 0.3 * before)
            if settled and _arrived(start, here):
                return True, here, room, change
            bad = short
            if not bad and not rough and caution == 0:
                continue
        fresh = False
        caution = min(max(4 * caution, _LEAST_CAUTION), 1.0) if bad else 0.0
    return False, here, room, change


@kernel
def _arrived(start: Start, here: Place) -> bool:
    """Whether obstacles are where they go."""
    for o in range(len(here.scenery)):
        for axis in range(3):
            if here.scenery[o, axis] != start.final[o, axis]:
                return False
    return True


@kernel
def _residual(
    scene: Scene, start: Start, parameters: Parameters, here: Place, motion: Motion, found: Floats
) -> None:
    residual(scene, start, parameters, here.velocity, here.points, here.turned, here.touching, motion, found)


@kernel
def _pushed(
    scene: Scene, start: Start, parameters: Parameters, here: Place, left_over: Floats, motion: Motion, found: Floats
) -> None:
    """The residual, and how it changes as moving obstacles go the rest of their way, to first order.

    Without it a step would not know that they come, and they would eat up the gap instead of pushing.
    """
    for i in range(len(found)):
        for axis in range(3):
            found[i, axis] = left_over[i, axis]
    if _arrived(start, here):
        return
    points, nodes = here.points.copy(), len(start.positions)
    for o in range(len(start.final)):
        for axis in range(3):
            points[nodes + o, axis] += _PROBE * (start.final[o, axis] - here.scenery[o, axis])
    ahead = np.empty((len(found), 3))
    residual(scene, start, parameters, here.velocity, points, here.turned, here.touching, motion, ahead)
    for i in range(len(found)):
        for axis in range(3):
            found[i, axis] += (ahead[i, axis] - left_over[i, axis]) / _PROBE


@kernel
def _search(
    scene: Scene,
    start: Start,
    parameters: Parameters,
    here: Place,
    direction: Floats,
    downhill: float,
    room: Room,
    rough: bool,
    motion: Motion,
    found: Floats,
) -> tuple[Place, Room, bool]:
    """The step along `direction` at whose end it leads downhill still, or uphill less steeply than it began.

    Where forces have a potential, that is a step along which it falls; friction, drag and damping are judged alike.
    `found` [D, 3] takes the residual at its end.

    Returns:
        (the place, the room, whether the step had to be shortened for it)
    """
    alpha, short, trial = 1.0, False, here
    most = 1e-300
    for i in range(len(direction)):
        for axis in range(3):
            most = max(most, abs(direction[i, axis]))
    for _ in range(_HALVINGS):
        trial, room = _towards(scene, start, here, direction, alpha, room)
        _residual(scene, start, parameters, trial, motion, found)
        uphill = gone = 0.0
        for i in range(len(direction)):
            for axis in range(3):
                uphill += found[i, axis] * direction[i, axis]
                gone = max(gone, abs(trial.velocity[i, axis] - here.velocity[i, axis]))
        if not rough or uphill <= 0.9 * downhill:
            break
        short = True
        alpha = 0.5 * gone / most
    return trial, room, short


@kernel
def _towards(
    scene: Scene, start: Start, here: Place, direction: Floats, alpha: float, room: Room
) -> tuple[Place, Room]:
    """`here` + α direction with the longest α up to the given one that has no collision on the way."""
    for halving in range(_HALVINGS + 2):
        velocity, scenery = np.empty((len(direction), 3)), np.empty((len(start.final), 3))
        for i in range(len(direction)):
            for axis in range(3):
                velocity[i, axis] = here.velocity[i, axis] + alpha * direction[i, axis]
        for o in range(len(scenery)):
            for axis in range(3):
                old, new = here.scenery[o, axis], start.final[o, axis]
                scenery[o, axis] = new if alpha == 1 else old + alpha * (new - old)
        points, turned = np.empty((len(here.points), 3)), np.empty((len(here.turned), 12))
        place_points(scene, start, velocity, scenery, points, turned)
        far = away(room, points)
        if far > room.longest:
            alpha *= 0.5 * room.longest / far
            continue
        distances = here.distances
        if far > room.size:
            room = widened_room(scene, start, room, far)
            distances = distances_at(scene, room, here.points)
            here = Place(
                here.velocity, here.scenery, here.points, here.turned, distances, here.listed, here.numbers, here.touching
            )
        fraction = free_way(scene, start, room, distances, here.points, points)
        if fraction == 1:
            return _place(scene, room, velocity, scenery, points, turned), room
        # what is straight in velocities is not quite straight in space where bodies turn: look again at the shorter step
        alpha *= 0.0 if halving >= _HALVINGS else (fraction * 0.9 if halving > 0 else fraction)
    return here, room  # no step this way is free of collisions
