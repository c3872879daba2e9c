"""Pairs that can touch for a while (Verlet 1967): listed with a margin, so that one list serves several steps.

When the list is made, each point gets a box around its motion in this step and one step ahead. While all points stay within
half of the margin around their boxes, every pair that can touch is on the list; once one leaves, the list is made again.
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
"""Of typical edges of the cloth: a wider one lists more pairs less often."""
_AHEAD = 1.0
"""The boxes reach so many steps beyond the one at hand."""
_ROUNDING = 1e-9


class NeighboursType(BoxType):  # type: ignore[misc]
    """Of `Neighbours`."""


class Neighbours(Box):  # type: ignore[misc]
    """The pairs, and where they hold.

    Fields:
        distance: boxes that come so near to each other belong to listed pairs [m].
        margin: [m]
        low, high: [N, 3] the box of each point [m].
        pairs: [C, 7] kind (1: two edges), points and primitives.
    """


define(Neighbours, NeighboursType, ["distance", "margin", "low", "high", "pairs"])


@kernel
def no_neighbours(surface: SurfaceBox, distance: float) -> Neighbours:
    """Nothing listed yet."""
    shape = (surface.point_count, 3)
    margin = _MARGIN * sqrt(surface.typical_face_area[0])
    return Neighbours(distance, margin, np.full(shape, np.inf), np.full(shape, -np.inf), np.empty((0, 7), np.int64))


@kernel
def neighbours_of(surface: SurfaceBox, known: Neighbours, start: Floats, end: Floats) -> Ints:
    """The pairs [C, 7] that can touch while points go straight from `start` to `end` [N, 3], and others."""
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
    """The rows of the pairs whose boxes come within a distance of each other [m] while points go from start to end."""
    points, faces, edges = boxes_of(surface, start, end, distance)
    found = np.empty(len(pairs), np.int64)
    count = 0
    for c in range(len(pairs)):
        a, b = pairs[c, 5], pairs[c, 6]
        if meet(edges, a, edges, b) if pairs[c, 0] > 0 else meet(points, a, faces, b):
            found[count] = c
            count += 1
    return found[:count]
