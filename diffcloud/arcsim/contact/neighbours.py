"""Neighbour lists (Verlet 1967): pairs that can touch, listed with a margin, so that one list serves several steps.

When the list is built, each point gets a box around its motion in this step and the next. While all points stay within half
of the margin around their boxes, the list contains every pair that can touch. Otherwise it is built again.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.box import Box, BoxType, define
from diffcloud.sim.compiled.data import Floats, Ints
from diffcloud.sim.contact.broad_phase import boxes_of, candidates, corners_of, meet
from diffcloud.sim.contact.surface import SurfaceBox

_MARGIN = 0.5
"""Margin relative to a typical edge length of the cloth. A larger margin lists more pairs less often."""
_AHEAD = 1.0
"""Number of steps by which the boxes extend beyond the current one."""
_ROUNDING = 1e-9


class NeighboursType(BoxType):  # type: ignore[misc]
    """Numba type of `Neighbours`."""


class Neighbours(Box):  # type: ignore[misc]
    """The list of pairs, and the region in which it is valid.

    Fields:
        distance: pairs whose boxes come this close to each other are listed [m].
        margin: distance by which the list exceeds this [m].
        low, high: [N, 3] box of each point [m].
        pairs: [C, 7] kind (1: two edges), points and primitives.
    """


define(Neighbours, NeighboursType, ["distance", "margin", "low", "high", "pairs"])


@kernel
def no_neighbours(surface: SurfaceBox, distance: float) -> Neighbours:
    """Create an empty list."""
    shape = (surface.point_count, 3)
    margin = _MARGIN * sqrt(surface.typical_face_area[0])
    return Neighbours(distance, margin, np.full(shape, np.inf), np.full(shape, -np.inf), np.empty((0, 7), np.int64))


@kernel
def neighbours_of(surface: SurfaceBox, known: Neighbours, start: Floats, end: Floats) -> Ints:
    """Pairs [C, 7], among them all that can touch while points move straight from `start` to `end` [N, 3]."""
    if not (_are_inside(known, start) and _are_inside(known, end)):
        low, high = known.low, known.high
        for i in range(len(start)):
            for axis in range(3):
                a, b = start[i, axis], end[i, axis]
                beyond = b + _AHEAD * (b - a)
                low[i, axis], high[i, axis] = min(a, beyond), max(a, beyond)
        known.pairs = _listed(surface, low, high, known.distance + known.margin)
    return known.pairs


@kernel
def _are_inside(known: Neighbours, points: Floats) -> bool:
    low, high, room = known.low, known.high, (0.5 - _ROUNDING) * known.margin
    for i in range(len(points)):
        for axis in range(3):
            if not low[i, axis] - room <= points[i, axis] <= high[i, axis] + room:
                return False
    return True


@kernel
def _listed(surface: SurfaceBox, low: Floats, high: Floats, distance: float) -> Ints:
    point_face, edge_edge = candidates(surface, low, high, distance)
    found = np.empty((len(point_face) + len(edge_edge), 7), np.int64)
    count = 0
    for kind in range(2):
        pairs = edge_edge if kind > 0 else point_face
        for c in range(len(pairs)):
            a, b = pairs[c, 0], pairs[c, 1]
            found[count, 0], found[count, 5], found[count, 6] = kind, a, b
            found[count, 1], found[count, 2], found[count, 3], found[count, 4] = corners_of(surface, kind, a, b)
            count += 1
    return found


@kernel
def meeting(surface: SurfaceBox, pairs: Ints, start: Floats, end: Floats, distance: float) -> Ints:
    """Rows of the pairs whose boxes come within `distance` of each other [m] while points move from start to end."""
    points, faces, edges = boxes_of(surface, start, end, distance)
    found = np.empty(len(pairs), np.int64)
    count = 0
    for c in range(len(pairs)):
        a, b = pairs[c, 5], pairs[c, 6]
        if meet(edges, a, edges, b) if pairs[c, 0] > 0 else meet(points, a, faces, b):
            found[count] = c
            count += 1
    return found[:count]
