"""Additive continuous collision detection: how far points can move along straight lines before a pair touches.

Method of Li et al. 2021 (Codimensional IPC): advance repeatedly by at most the remaining distance over a bound of the
speed, until the distance is a fixed fraction of the initial one. No polynomial is solved. So parallel edges, flat motions
and zero thickness are not special cases, and the result is always conservative.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats, Ints
from diffcloud.sim.contact.distance import closest

_LEFT = 0.2
"""Fraction of the initial distance that remains after the first advance. Further advances may leave half of this
fraction."""
_ENOUGH = 2.0
"""Stop when the distance is below this multiple of its goal."""
_ADVANCES = 100
"""Maximum number of advances. Stopping early is safe, but shortens the step."""


@kernel
def safe_fraction(pairs: Ints, distances: Floats, start: Floats, end: Floats, limit: float, floor: float) -> float:
    """Fraction of the motion, at most `limit`, that keeps at least a tenth of every pair's distance.

    Args:
        pairs: [C, 5] kind (1: two edges) and points.
        distances: [C] at the start, or a lower bound [m].
        start, end: [N, 3] positions of all points [m].
        floor: pairs this close may not come closer, because rounding could make them interpenetrate [m].
    """
    x, motion, at, found = np.empty((4, 3)), np.empty((4, 3)), np.empty((4, 3)), np.empty(6)
    ways = path_lengths(start, end)
    for c in range(len(pairs)):
        # Most pairs move so little that this cheap bound is sufficient, which includes their common motion.
        if reach(pairs, c, ways) * limit <= (1 - _LEFT) * distances[c]:
            continue
        bound = approach(pairs, c, start, end, x, motion)
        # This bound excludes the common motion. Pairs that cannot touch are skipped.
        if not bound * limit > (1 - _LEFT) * distances[c]:
            continue
        first = closest(pairs[c, 0], x, found)
        goal = max(0.5 * _LEFT * first, floor)
        fraction = min(max(0.9 * (first - goal) / max(bound, 1e-300), 0.0), 1.0)
        for _ in range(_ADVANCES):
            if not fraction < limit:
                break
            for k in range(4):
                for axis in range(3):
                    at[k, axis] = x[k, axis] + fraction * motion[k, axis]
            left = closest(pairs[c, 0], at, found)
            if left < _ENOUGH * goal and left <= first:
                break  # near the goal, further advances would only become shorter
            fraction += 0.9 * (left - goal) / bound
        limit = min(limit, fraction)
    return limit


@kernel
def path_lengths(start: Floats, end: Floats) -> Floats:
    """Length [N] of each point's path from start to end [N, 3] [m]."""
    found = np.empty(len(start))
    for i in range(len(start)):
        square = 0.0
        for axis in range(3):
            square += (end[i, axis] - start[i, axis]) ** 2
        found[i] = sqrt(square)
    return found


@kernel
def reach(pairs: Ints, c: int, lengths: Floats) -> float:
    """Upper bound of the approach of pair c [kind, points] if its points have moved by these lengths [m]."""
    i, j, k, l = pairs[c, 1], pairs[c, 2], pairs[c, 3], pairs[c, 4]
    if pairs[c, 0] > 0:
        return max(lengths[i], lengths[j]) + max(lengths[k], lengths[l])
    return lengths[i] + max(lengths[j], lengths[k], lengths[l])


@kernel
def approach(pairs: Ints, c: int, start: Floats, end: Floats, x: Floats, motion: Floats) -> float:
    """Upper bound of the approach of a pair over the motion [m]. `x` and `motion` [4, 3] receive the start of its points
    and their motion relative to its mean."""
    for axis in range(3):
        mean = 0.0
        for k in range(4):
            x[k, axis] = start[pairs[c, 1 + k], axis]
            motion[k, axis] = end[pairs[c, 1 + k], axis] - x[k, axis]
            mean += 0.25 * motion[k, axis]
        for k in range(4):
            motion[k, axis] -= mean
    split = 2 if pairs[c, 0] > 0 else 1
    first = second = 0.0
    for k in range(4):
        speed = motion[k, 0] * motion[k, 0] + motion[k, 1] * motion[k, 1] + motion[k, 2] * motion[k, 2]
        if k < split:
            first = max(first, speed)
        else:
            second = max(second, speed)
    return sqrt(first) + sqrt(second)
