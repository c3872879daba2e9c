"""How far points can move along straight lines before a pair touches: additive continuous collision detection.

Li et al. 2021 (Codimensional IPC): advance by no more than the distance that is left, divided by the speed bound, until
the distance falls to a fixed part of what it was. No polynomial is solved, so nothing goes wrong for parallel edges,
flat motions or zero thickness, and the answer is always on the safe side.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats, Ints
from diffcloud.sim.contact.distance import closest

_LEFT = 0.2
"""Part of the starting distance that the first advance leaves; later ones may go down to half of that."""
_ENOUGH = 2.0
"""An advance stops when the distance is less than this many times its goal."""
_ADVANCES = 100
"""Stopping earlier is safe, only short."""


@kernel
def safe_fraction(pairs: Ints, distances: Floats, start: Floats, end: Floats, limit: float, floor: float) -> float:
    """The fraction of the motion that keeps at least a tenth of every pair's distance, at most `limit`.

    Args:
        pairs: [C, 5] kind (1: two edges) and points.
        distances: [C] at the start, or a lower bound [m].
        start, end: [N, 3] positions of all points [m].
        floor: pairs as close as this may not come closer at all: below, rounding could put them on the wrong side [m].
    """
    x, motion, at, found = np.empty((4, 3)), np.empty((4, 3)), np.empty((4, 3)), np.empty(6)
    ways = path_lengths(start, end)
    for c in range(len(pairs)):
        # most pairs move so little that they need no look, not even at what their points have in common
        if reach(pairs, c, ways) * limit <= (1 - _LEFT) * distances[c]:
            continue
        bound = approach(pairs, c, start, end, x, motion)
        # a pair that moves so little that it cannot touch needs no look
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
                break  # near the goal each advance would be shorter than the last: enough
            fraction += 0.9 * (left - goal) / bound
        limit = min(limit, fraction)
    return limit


@kernel
def path_lengths(start: Floats, end: Floats) -> Floats:
    """[N] how far each point goes from start to end [N, 3] [m]."""
    found = np.empty(len(start))
    for i in range(len(start)):
        square = 0.0
        for axis in range(3):
            square += (end[i, axis] - start[i, axis]) ** 2
        found[i] = sqrt(square)
    return found


@kernel
def reach(pairs: Ints, c: int, lengths: Floats) -> float:
    """How much closer pair c [kind, points] can have come when its points have gone so far [m]."""
    i, j, k, l = pairs[c, 1], pairs[c, 2], pairs[c, 3], pairs[c, 4]
    if pairs[c, 0] > 0:
        return max(lengths[i], lengths[j]) + max(lengths[k], lengths[l])
    return lengths[i] + max(lengths[j], lengths[k], lengths[l])


@kernel
def approach(pairs: Ints, c: int, start: Floats, end: Floats, x: Floats, motion: Floats) -> float:
    """How fast a pair can come closer [m]; x, motion [4, 3] take where its points start and how they go, without what
    they have in common."""
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
