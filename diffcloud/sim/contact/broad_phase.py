"""Which pairs of primitives can touch: those whose axis-aligned boxes overlap, found by sweeping along one axis.

Both kinds of pair are four points with signed weights that sum to zero, and the vector between the closest places is
Σ w_k x_k: a point and a face have (1, -b0, -b1, -b2), two edges (a0, a1, -b0, -b1).
"""

from __future__ import annotations

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats, Ints
from diffcloud.sim.compiled.pool import with_room
from diffcloud.sim.compiled.sorting import ascending
from diffcloud.sim.contact.surface import SurfaceBox


@kernel
def candidates(surface: SurfaceBox, places: Floats, others: Floats, margin: float) -> tuple[Ints, Ints]:
    """Pairs whose boxes come within `margin` of each other [m]: (point-face [C, 2], edge-edge [C, 2]) in no order.

    Pairs that share a point, that lie on one obstacle, or of which neither can move are left out.

    Args:
        places, others: [N, 3] positions of all points; a box holds a primitive at both (start and end of a motion).

    Returns:
        Indices into the surface's points and faces, and into its edges (twice).
    """
    points = _boxes(places, others, surface.points.reshape(-1, 1), 0.5 * margin)
    faces = _boxes(places, others, surface.faces, 0.5 * margin)
    edges = _boxes(places, others, surface.edges, 0.5 * margin)
    kind = np.arange(2)  # not literally 0 and 1, for which numba would compile everything twice
    return _overlapping(surface, points, faces, kind[0]), _overlapping(surface, edges, edges, kind[1])


@kernel
def _boxes(places: Floats, others: Floats, primitives: Ints, margin: float) -> Floats:
    """[M, 6] the lowest, then the highest coordinates."""
    found = np.empty((len(primitives), 6))
    for m in range(len(primitives)):
        for axis in range(3):
            low, high = np.inf, -np.inf
            for k in range(primitives.shape[1]):
                first, second = places[primitives[m, k], axis], others[primitives[m, k], axis]
                low, high = min(low, first, second), max(high, first, second)
            found[m, axis], found[m, 3 + axis] = low - margin, high + margin
    return found


@kernel
def _overlapping(surface: SurfaceBox, first: Floats, second: Floats, edges: int) -> Ints:
    """[C, 2] of two lists of boxes: one of each pair begins within the other, along the axis on which they spread most."""
    axis = _widest(second)
    order_a, order_b = ascending(first[:, axis]), ascending(second[:, axis])
    a, b = first[order_a], second[order_b]
    found = np.empty((4 * len(first) + 64, 2), np.int64)
    count = begin = 0
    for i in range(len(a)):
        while begin < len(b) and b[begin, axis] < a[i, axis]:
            begin += 1
        for j in range(begin, len(b)):
            if b[j, axis] > a[i, 3 + axis]:
                break
            if _meet(a, i, b, j) and _eligible(surface, order_a[i], order_b[j], edges):
                found = with_room(found, count, 1)
                found[count, 0], found[count, 1] = order_a[i], order_b[j]
                count += 1
    begin = 0
    for j in range(len(b)):
        while begin < len(a) and a[begin, axis] <= b[j, axis]:
            begin += 1
        for i in range(begin, len(a)):
            if a[i, axis] > b[j, 3 + axis]:
                break
            if _meet(a, i, b, j) and _eligible(surface, order_a[i], order_b[j], edges):
                found = with_room(found, count, 1)
                found[count, 0], found[count, 1] = order_a[i], order_b[j]
                count += 1
    return found[:count]


@kernel
def _widest(boxes: Floats) -> int:
    """The axis along which boxes [M, 6] spread most."""
    best, axis = -1.0, 0
    for k in range(3):
        low, high = np.inf, -np.inf
        for m in range(len(boxes)):
            low, high = min(low, boxes[m, k]), max(high, boxes[m, k])
        if high - low > best:
            best, axis = high - low, k
    return axis


@kernel
def _meet(a: Floats, i: int, b: Floats, j: int) -> bool:
    return (
        a[i, 0] <= b[j, 3]
        and b[j, 0] <= a[i, 3]
        and a[i, 1] <= b[j, 4]
        and b[j, 1] <= a[i, 4]
        and a[i, 2] <= b[j, 5]
        and b[j, 2] <= a[i, 5]
    )


@kernel
def _eligible(surface: SurfaceBox, a: int, b: int, edges: int) -> bool:
    """Whether contact can bring two primitives together; of two edges, in one order only."""
    second = surface.edges[b, 0] if edges else surface.faces[b, 0]
    first = surface.edges[a, 0] if edges else surface.points[a]
    owner_a, owner_b = surface.owner[first], surface.owner[second]
    if owner_a == owner_b and (owner_a > 0 or not surface.touches_itself):
        return False
    moves_a, moves_b = surface.movable[owner_a], surface.movable[owner_b]
    if edges:
        if not moves_a or (moves_b and a >= b):
            return False
        for k in range(2):
            for l in range(2):
                if surface.edges[a, k] == surface.edges[b, l]:
                    return False
        return True
    if not moves_a and not moves_b:
        return False
    return surface.faces[b, 0] != first and surface.faces[b, 1] != first and surface.faces[b, 2] != first


@kernel
def corners_of(surface: SurfaceBox, edges: int, a: int, b: int) -> tuple[int, int, int, int]:
    """The four points of a pair."""
    if edges:
        return surface.edges[a, 0], surface.edges[a, 1], surface.edges[b, 0], surface.edges[b, 1]
    return surface.points[a], surface.faces[b, 0], surface.faces[b, 1], surface.faces[b, 2]
