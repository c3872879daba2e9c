"""Newton's method for one part of a step."""

from __future__ import annotations

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.box import Box, BoxType, define
from diffcloud.sim.compiled.data import Floats, Ints
from diffcloud.sim.compiled.lu import solve_general
from diffcloud.sim.contact.places import as_elements, places
from diffcloud.sim.implicit.equation import first_velocities, place_points, residual, resting_velocities, set_motion
from diffcloud.sim.implicit.matrix import newton_matrix
from diffcloud.sim.implicit.room import Room, away, cover, distances_at, free_way, room_around
from diffcloud.sim.implicit.scene import Work

_TOLERANCE = 1e-11
"""Convergence tolerance: expected sum of the remaining velocity changes, relative to the largest velocity. The sum is that
of a geometric series with the ratio of the last two changes."""
_ROUNDING = 1e-7
"""Below this relative change, a step that no longer shrinks is at rounding precision."""
_ITERATIONS = 30
_BACKTRACKS = 8
_SLOWEST = 1e-1
"""Lower bound of the velocity to which the tolerance is relative [m/s]."""
_LEAST_CAUTION = 0.05
"""Smallest caution after a step with the exact matrix overshot."""
_ROUGH = 1e-4
"""Steps with relative changes above this are checked, and shortened if they overshoot."""
_REUSE = 5e-1
"""Below this relative change a factorised matrix is reused, as long as the changes shrink. This includes the matrix of the
previous part. A new matrix costs as much as five to ten steps with an old one, which Broyden's updates correct."""
_SHRINKING = 0.45
_SLOWEST_RATIO = 0.9
"""Upper bound of the ratio of two changes in the convergence test. The first changes can grow."""
_WHOLE = 1 - 1e-9
"""A collision-free fraction above this counts as 1, because an earlier shortening leaves rounding errors."""
_ALMOST_WHOLE = 0.999
"""A step of at least this fraction of its direction is used for Broyden's update."""
_LEAST_REST = 0.2
"""Lower bound of the divisor in Broyden's update. Smaller divisors exaggerate a step."""
_LEAST_PART = 1e-3
"""Smallest useful fraction of a step. With shorter steps, blocked by a contact, Newton's method makes no progress."""
_PROBE = 1e-4
"""Fraction of the obstacles' motion for the finite difference that measures its effect."""


class PlaceType(BoxType):  # type: ignore[misc]
    """Numba type of `Place`."""


class Place(Box):  # type: ignore[misc]
    """An iterate of Newton's method.

    Fields:
        velocity: [D, 3] unknowns.
        scenery: [O, 3] current obstacle points [m].
        points: [N, 3] all points [m].
        turned: [B, 12] results of `rigid.spin`.
        distances: [C] distances of the pairs of `Room` [m].
        listed, numbers: [E, 5], [E, 4] contacts, as in `contact.places`.
        touching: the contacts as elements of terms.
    """


define(Place, PlaceType, ["velocity", "scenery", "points", "turned", "distances", "listed", "numbers", "touching"])


@kernel
def _place(work: Work, room: Room, velocity: Floats, scenery: Floats, points: Floats, turned: Floats) -> Place:
    """Build the iterate with its contacts."""
    surface, planes, law = work.surface, work.planes, work.law
    distances = distances_at(work, room, points)
    listed, numbers = places(surface, planes, law, room.pairs, distances, points, work.holder)
    touching = as_elements(planes, law, listed, numbers)
    return Place(velocity, scenery, points, turned, distances, listed, numbers, touching)


@kernel
def converge(work: Work) -> tuple[bool, Place, Room, float]:
    """Solve one part of a step. Return whether it converged, the last iterate, the room, and the last relative change."""
    work.wide, work.moved = work.pattern, np.arange(len(work.pattern.rows))
    count, first = len(work.start_points), first_velocities(work)
    turned, still = np.empty((len(work.start_bodies), 12)), resting_velocities(work)
    begin, predicted = np.empty((count, 3)), np.empty((count, 3))
    place_points(work, first, work.final_scenery, predicted, turned)
    place_points(work, still, work.start_scenery, begin, turned)
    room = room_around(work, begin, predicted)
    # Start from the old velocities, as far as this path is free of collisions.
    here = _towards(work, _place(work, room, still, work.start_scenery, begin, turned), first - still, 1.0, room)
    left_over, trial_left = np.empty((len(first), 3)), np.empty((len(first), 3))
    residual(work, here.velocity, here.points, here.turned, here.touching, left_over)
    matrix, change, stale, trouble = work.last, np.inf, work.serves != work.time_step, False
    caution, reused = 1.0 if stale else 0.0, not stale
    work.serves = 0.0
    right, direction = np.empty((len(first), 3)), np.empty((len(first), 3))
    steps, sizes, taken = np.empty((_ITERATIONS, len(first), 3)), np.empty(_ITERATIONS), 0  # full steps with this matrix
    for _ in range(_ITERATIONS):
        fresh = stale
        if stale:
            set_motion(work, here.velocity, here.points)
            matrix = newton_matrix(work, here.velocity, here.turned, here.listed, here.numbers, here.touching, caution)
            taken = 0
        _pushed(work, here, left_over, right)
        if not solve_general(matrix, right, 0, direction):
            return False, here, room, change
        _correct(steps, sizes, taken, direction)
        downhill, size = _judge(work.holder, left_over, direction, here.velocity)
        rough = size > _ROUGH
        bad = (rough and downhill <= 0 and caution < 1) or (reused and size > _REUSE)
        if not bad:
            here, short, part = _search(work, here, direction, downhill, room, rough, trial_left)
            left_over, trial_left = trial_left, left_over
            before, change = change, size
            ratio = min(change / before, _SLOWEST_RATIO)
            expected = change * ratio / (1 - ratio) if np.isfinite(before) else change
            settled = expected < _TOLERANCE or (fresh and change < _ROUNDING and change > 0.3 * before)
            if settled and _arrived(here.scenery, work.final_scenery):
                work.last, work.left_path = matrix, away(room, here.points)
                if not trouble:
                    work.serves = work.time_step
                return True, here, room, change
            taken = _remember(steps, sizes, taken, direction) if part > _ALMOST_WHOLE else 0
            if part < _LEAST_PART and caution >= 1:
                return False, here, room, change
            bad = short or part < _LEAST_PART
            stale = bad or caution > 0 or change > _REUSE or not (fresh or change < _SHRINKING * before)
            if not stale:
                continue
        trouble = trouble or bad
        stale = True
        caution = (1.0 if reused else min(max(4 * caution, _LEAST_CAUTION), 1.0)) if bad else 0.0
        reused = False
    return False, here, room, change


@kernel
def _correct(steps: Floats, sizes: Floats, taken: int, direction: Floats) -> None:
    """Correct the solution [D, 3] of a reused matrix by the steps taken since its factorisation. This is Broyden's update
    of the inverse, from these steps alone (Kelley, Iterative Methods for Linear and Nonlinear Equations, SIAM 1995, section
    7.3). The direction still has the sign of the residual. `_judge` reverses it later."""
    if taken == 0:
        return
    for k in range(taken - 1):
        share = _along(steps[k], direction) / sizes[k]
        for i in range(len(direction)):
            for axis in range(3):
                direction[i, axis] += share * steps[k + 1, i, axis]
    rest = 1.0 + _along(steps[taken - 1], direction) / sizes[taken - 1]
    if rest > _LEAST_REST:
        for i in range(len(direction)):
            for axis in range(3):
                direction[i, axis] /= rest


@kernel
def _remember(steps: Floats, sizes: Floats, taken: int, direction: Floats) -> int:
    """Store a step [D, 3] and return the new number of stored steps."""
    size = 0.0
    for i in range(len(direction)):
        for axis in range(3):
            steps[taken, i, axis] = direction[i, axis]
            size += direction[i, axis] ** 2
    sizes[taken] = size
    return taken + 1 if size > 0 else taken


@kernel
def _along(first: Floats, second: Floats) -> float:
    found = 0.0
    for i in range(len(first)):
        for axis in range(3):
            found += first[i, axis] * second[i, axis]
    return found


@kernel
def _judge(holder: Ints, left_over: Floats, direction: Floats, velocity: Floats) -> tuple[float, float]:
    """Reverse the sign of a direction [D, 3]. Return its downhill slope -r · direction and its size relative to the
    velocities."""
    downhill, speed, size = 0.0, _SLOWEST, 0.0
    for i in range(len(direction)):
        for axis in range(3):
            direction[i, axis] = -direction[i, axis]
            if i >= len(holder) or holder[i] < 0:
                downhill -= left_over[i, axis] * direction[i, axis]
            speed = max(speed, abs(velocity[i, axis]))
            size = max(size, abs(direction[i, axis]))
    return downhill, size / speed


@kernel
def _arrived(scenery: Floats, final: Floats) -> bool:
    """Whether all obstacles [O, 3] are at the end of their motion."""
    for o in range(len(scenery)):
        for axis in range(3):
            if scenery[o, axis] != final[o, axis]:
                return False
    return True


@kernel
def _pushed(work: Work, here: Place, left_over: Floats, found: Floats) -> None:
    """The residual plus its first-order change as moving obstacles complete their motion. Without this change, a step would
    not account for the obstacles. They would close the gap instead of pushing the cloth."""
    for i in range(len(found)):
        for axis in range(3):
            found[i, axis] = left_over[i, axis]
    scenery, final = here.scenery, work.final_scenery
    if _arrived(scenery, final):
        return
    points, nodes = here.points.copy(), len(work.start_positions)
    for o in range(len(final)):
        for axis in range(3):
            points[nodes + o, axis] += _PROBE * (final[o, axis] - scenery[o, axis])
    ahead = np.empty((len(found), 3))
    residual(work, here.velocity, points, here.turned, here.touching, ahead)
    for i in range(len(found)):
        for axis in range(3):
            found[i, axis] += (ahead[i, axis] - left_over[i, axis]) / _PROBE


@kernel
def _search(
    work: Work, here: Place, direction: Floats, downhill: float, room: Room, rough: bool, found: Floats
) -> tuple[Place, bool, float]:
    """Line search: find a step along `direction` that does not overshoot.

    At its end the residual must point downhill, or uphill less steeply than at the start. If forces have a potential, the
    potential decreases along such a step. The criterion also works for friction, drag and damping.

    Args:
        found: [D, 3] receives the residual at the end of the step.

    Returns:
        The new iterate, whether the step was shortened to avoid overshooting, and the fraction of the direction that it
        covers.
    """
    alpha, short, trial, holder, part = 1.0, False, here, work.holder, 1.0
    most = 1e-300
    for i in range(len(direction)):
        for axis in range(3):
            most = max(most, abs(direction[i, axis]))
    for _ in range(_BACKTRACKS):
        trial = _towards(work, here, direction, alpha, room)
        residual(work, trial.velocity, trial.points, trial.turned, trial.touching, found)
        uphill = gone = 0.0
        new, old = trial.velocity, here.velocity
        for i in range(len(direction)):
            for axis in range(3):
                if i >= len(holder) or holder[i] < 0:
                    uphill += found[i, axis] * direction[i, axis]
                gone = max(gone, abs(new[i, axis] - old[i, axis]))
        part = gone / most
        if not rough or uphill <= 0.9 * max(downhill, 0.0):
            break
        short = True
        alpha = 0.5 * part
    return trial, short, part


@kernel
def _towards(work: Work, here: Place, direction: Floats, alpha: float, room: Room) -> Place:
    """Step to `here` + α direction, with the largest α up to the given one that is free of collisions."""
    old, began, final = here.velocity, here.scenery, work.final_scenery
    for attempt in range(_BACKTRACKS + 2):
        velocity, scenery = np.empty((len(direction), 3)), np.empty((len(final), 3))
        for i in range(len(direction)):
            for axis in range(3):
                velocity[i, axis] = old[i, axis] + alpha * direction[i, axis]
        for o in range(len(scenery)):
            for axis in range(3):
                a, b = began[o, axis], final[o, axis]
                scenery[o, axis] = b if alpha == 1 else a + alpha * (b - a)
        points, turned = np.empty((len(here.points), 3)), np.empty((len(here.turned), 12))
        place_points(work, velocity, scenery, points, turned)
        far = away(room, points)
        if far > room.longest:
            alpha *= 0.5 * room.longest / far
            continue
        if far > room.size:
            cover(work, room, far)
            here.distances = distances_at(work, room, here.points)
        fraction = free_way(work, room, here.distances, here.points, points)
        if fraction > _WHOLE:
            return _place(work, room, velocity, scenery, points, turned)
        # A straight line in velocities is not straight in space if bodies rotate, so the shorter step is checked again.
        alpha *= 0.0 if attempt >= _BACKTRACKS else (fraction * 0.9 if attempt > 0 else fraction)
    return here  # no step in this direction is free of collisions
