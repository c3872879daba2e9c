"""Broad phase: find the pairs of primitives whose axis-aligned boxes overlap.

A few boxes are swept along one axis. Many boxes are sorted into grids, one for each size of box.
"""

from __future__ import annotations

from math import ceil, exp, floor, log
from typing import NamedTuple

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Flags, Floats, Ints
from diffcloud.sim.compiled.pool import with_room
from diffcloud.sim.compiled.sorting import ascending
from diffcloud.sim.contact.rest import listed_in
from diffcloud.sim.contact.surface import SurfaceBox

_FEW = 600
"""With fewer boxes than this, sweeping is faster than grids."""
_SMALLEST = 1e-9
"""Lower bound of the box size when the cell size is chosen [m]."""
_CELLS = 8
"""Maximum number of cells per box."""
_ROUNDING = 1e-9


@kernel
def candidates(surface: SurfaceBox, places: Floats, others: Floats, margin: float) -> tuple[Ints, Ints]:
    """Find the pairs whose boxes come within `margin` of each other [m]: point-face [C, 3], edge-edge [C, 3], unordered.

    Pairs that share a point, that belong to the same obstacle, or that cannot move are omitted.

    Args:
        places, others: [N, 3] positions of all points at the start and end of a motion. A box contains a primitive at both.

    Returns:
        Two columns of indices into the surface's points and faces, or into its edges, the movable one first. The third
        column is 1 for pairs that are close at rest (`rest`), else 0.
    """
    points, faces, edges = boxes_of(surface, places, others, margin)
    between = _pool(surface, surface.points.reshape(-1, 1), surface.faces, surface.rest_face_starts, surface.rest_faces)
    among = _pool(surface, surface.edges, surface.edges, surface.rest_edge_starts, surface.rest_edges)
    point_face = _swept_between(between, points, faces) if len(faces) < _FEW else _in_cells(between, points, faces)
    if len(edges) < _FEW:
        return point_face, _swept_among(among, edges)
    return point_face, _in_cells(among, edges, edges)


class _Pool(NamedTuple):
    """Data about the two lists of primitives that form pairs."""

    first: Ints
    """[M, n] points of each first primitive."""
    second: Ints
    """[N, m] points of each second primitive."""
    first_moves: Flags
    """[M] whether contact can move the first primitive."""
    second_moves: Flags
    """[N] whether contact can move the second primitive."""
    owner: Ints
    """[points] owner of each point, 0 for the cloth."""
    movable: Flags
    """[owners] whether contact can move the owner."""
    touches_itself: bool
    """Whether the cloth can touch itself."""
    rest_starts: Ints
    """Starts in `rest` of the list of each first primitive of the cloth: the second primitives that are close to it at
    rest."""
    rest: Ints
    """Members of these lists."""


@kernel
def _pool(surface: SurfaceBox, first: Ints, second: Ints, rest_starts: Ints, rest: Ints) -> _Pool:
    owner, movable = surface.owner, surface.movable
    return _Pool(
        first,
        second,
        movable[owner[first[:, 0]]],
        movable[owner[second[:, 0]]],
        owner,
        movable,
        surface.touches_itself,
        rest_starts,
        rest,
    )


@kernel
def boxes_of(surface: SurfaceBox, places: Floats, others: Floats, margin: float) -> tuple[Floats, Floats, Floats]:
    """Boxes of points [P, 6], faces [F, 6] and edges [E, 6] at both positions [N, 3]: lowest, then highest coordinates.
    Boxes overlap if the boxes of the primitives come within `margin` of each other [m]."""
    return (
        _boxes(places, others, surface.points.reshape(-1, 1), 0.5 * margin),
        _boxes(places, others, surface.faces, 0.5 * margin),
        _boxes(places, others, surface.edges, 0.5 * margin),
    )


@kernel
def _boxes(places: Floats, others: Floats, primitives: Ints, margin: float) -> Floats:
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
def _swept_between(pool: _Pool, first: Floats, second: Floats) -> Ints:
    """Pairs [C, 3] by a sweep along the axis of the largest spread. One box of each pair begins within the other."""
    axis = _widest(second)
    order_a, order_b = ascending(first[:, axis]), ascending(second[:, axis])
    a, b, a_moves, b_moves = first[order_a], second[order_b], pool.first_moves[order_a], pool.second_moves[order_b]
    found = np.empty((4 * len(first) + 64, 3), np.int64)
    count = begin = 0
    for i in range(len(a)):
        found = with_room(found, count, len(b))
        while begin < len(b) and b[begin, axis] < a[i, axis]:
            begin += 1
        for j in range(begin, len(b)):
            if b[j, axis] > a[i, 3 + axis]:
                break
            if (a_moves[i] | b_moves[j]) & meet(a, i, b, j):
                count = _note(pool, found, count, order_a[i], order_b[j])
    begin = 0
    for j in range(len(b)):
        found = with_room(found, count, len(a))
        while begin < len(a) and a[begin, axis] <= b[j, axis]:
            begin += 1
        for i in range(begin, len(a)):
            if a[i, axis] > b[j, 3 + axis]:
                break
            if (a_moves[i] | b_moves[j]) & meet(a, i, b, j):
                count = _note(pool, found, count, order_a[i], order_b[j])
    return found[:count]


@kernel
def _swept_among(pool: _Pool, boxes: Floats) -> Ints:
    """Pairs [C, 3] within one list of boxes, by the same sweep."""
    axis = _widest(boxes)
    order = ascending(boxes[:, axis])
    a, a_moves = boxes[order], pool.first_moves[order]
    found = np.empty((4 * len(boxes) + 64, 3), np.int64)
    count = 0
    for i in range(len(a)):
        found = with_room(found, count, len(a))
        for j in range(i + 1, len(a)):
            if a[j, axis] > a[i, 3 + axis]:
                break
            if (a_moves[i] | a_moves[j]) & meet(a, i, a, j):
                count = _note(pool, found, count, order[i], order[j])
    return found[:count]


@kernel
def _widest(boxes: Floats) -> int:
    """Axis along which the boxes [M, 6] have the largest spread."""
    best, axis = -1.0, 0
    for k in range(3):
        low, high = np.inf, -np.inf
        for m in range(len(boxes)):
            low, high = min(low, boxes[m, k]), max(high, boxes[m, k])
        if high - low > best:
            best, axis = high - low, k
    return axis


@kernel
def _in_cells(pool: _Pool, first: Floats, second: Floats) -> Ints:
    """Pairs [C, 3] by grids: one for all second boxes up to the typical size, and one for each doubling of it. A box
    belongs to the cell of its low corner. Each first box is compared with the cells whose boxes can reach it."""
    same = pool.first.shape[1] == pool.second.shape[1]  # both lists are edges: report each pair once
    level, levels = np.full(len(second), -1, np.int64), 1  # boxes that are not finite overlap with nothing
    total, finite = 0.0, 0
    for m in range(len(second)):
        if 0 <= _extent(second, m) < np.inf:
            total += log(max(_extent(second, m), _SMALLEST))
            finite += 1
    usual = exp(total / max(finite, 1))
    for m in range(len(second)):
        if 0 <= _extent(second, m) < np.inf:
            level[m] = max(ceil(log(_extent(second, m) / usual) / log(2.0)), 0) if _extent(second, m) > 0 else 0
            levels = max(levels, level[m] + 1)
    found = np.empty((4 * len(first) + 64, 3), np.int64)
    begin, end = np.empty(3, np.int64), np.empty(3, np.int64)
    count = 0
    for grid in range(levels):
        cells = _cells(second, level, grid, usual * 2.0**grid * (1 + _ROUNDING))
        boxes = second[cells.order]  # copied in this order for fast access
        for i in range(len(first) if len(boxes) > 0 else 0):
            found = with_room(found, count, len(boxes))
            for axis in range(3):
                low = first[i, axis] - cells.reach - cells.origin[axis]
                high = first[i, 3 + axis] - cells.origin[axis]
                begin[axis] = min(max(floor(low / cells.size), 0.0), float(cells.shape[axis]))
                end[axis] = min(max(floor(high / cells.size) + 1, 0.0), float(cells.shape[axis]))
            for x in range(begin[0], end[0] if begin[2] < end[2] else begin[0]):
                for y in range(begin[1], end[1]):
                    row = (x * cells.shape[1] + y) * cells.shape[2]
                    for p in range(cells.starts[row + begin[2]], cells.starts[row + end[2]]):  # contiguous along z
                        if meet(first, i, boxes, p):
                            j = cells.order[p]
                            if (not same or i < j) and (pool.first_moves[i] or pool.second_moves[j]):
                                count = _note(pool, found, count, i, j)
    return found[:count]


class Cells(NamedTuple):
    """A grid whose cells list boxes. Each box belongs to the cell that contains its low corner."""

    origin: Floats
    """[3] low corner of the grid [m]."""
    size: float
    """Edge length of a cell [m]."""
    reach: float
    """Upper bound of the size of the boxes [m]."""
    shape: Ints
    """[3] number of cells along each axis; z varies fastest."""
    starts: Ints
    """[cells + 1] start of each cell in `order`."""
    order: Ints
    """Indices of the boxes, sorted by cell."""


@kernel
def _cells(boxes: Floats, level: Ints, grid: int, reach: float) -> Cells:
    """Build the grid of the boxes [M, 6] of one level, none larger than `reach` [m]. Cells have half this size, or more if
    there would be too many."""
    taken = 0
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for m in range(len(boxes)):
        if level[m] == grid:
            taken += 1
            for axis in range(3):
                low[axis], high[axis] = min(low[axis], boxes[m, axis]), max(high[axis], boxes[m, axis])
    size, shape = 0.5 * reach, np.ones(3, np.int64)
    while taken > 0:
        total = 1.0
        for axis in range(3):
            total *= floor((high[axis] - low[axis]) / size) + 1
        if total <= _CELLS * taken:
            for axis in range(3):
                shape[axis] = floor((high[axis] - low[axis]) / size) + 1
            break
        size *= 1.5
    starts = np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int64)
    place, order = np.empty(len(boxes), np.int64), np.empty(taken, np.int64)
    for m in range(len(boxes)):
        if level[m] == grid:
            cell = 0
            for axis in range(3):
                cell = cell * shape[axis] + floor((boxes[m, axis] - low[axis]) / size)
            place[m] = cell
            starts[cell] += 1
    total_before = 0
    for cell in range(len(starts)):
        total_before += starts[cell]
        starts[cell] = total_before  # end of each cell; filling from the back turns it into the start
    for m in range(len(boxes) - 1, -1, -1):
        if level[m] == grid:
            starts[place[m]] -= 1
            order[starts[place[m]]] = m
    return Cells(low, size, reach, shape, starts, order)


@kernel
def _extent(boxes: Floats, m: int) -> float:
    return max(boxes[m, 3] - boxes[m, 0], boxes[m, 4] - boxes[m, 1], boxes[m, 5] - boxes[m, 2])


@kernel
def meet(a: Floats, i: int, b: Floats, j: int) -> bool:
    """Whether two boxes of lists [., 6] overlap."""
    return (  # `and` would branch six times
        (a[i, 0] <= b[j, 3])
        & (b[j, 0] <= a[i, 3])
        & (a[i, 1] <= b[j, 4])
        & (b[j, 1] <= a[i, 4])
        & (a[i, 2] <= b[j, 5])
        & (b[j, 2] <= a[i, 5])
    )


@kernel
def _note(pool: _Pool, found: Ints, count: int, a: int, b: int) -> int:
    """Append a pair of overlapping boxes, if contact between its primitives is possible. Return the new length of the
    list."""
    first, second, owner = pool.first, pool.second, pool.owner
    owner_a, owner_b = owner[first[a, 0]], owner[second[b, 0]]
    if owner_a == owner_b and (owner_a > 0 or not pool.touches_itself):
        return count
    for k in range(first.shape[1]):
        for l in range(second.shape[1]):
            if first[a, k] == second[b, l]:
                return count
    near = False
    if owner_a == owner_b and len(pool.rest) > 0:
        low, high = (min(a, b), max(a, b)) if first.shape[1] > 1 else (a, b)
        near = listed_in(pool.rest_starts, pool.rest, low, high)
    if first.shape[1] > 1 and (not pool.movable[owner_a] or (pool.movable[owner_b] and b < a)):
        a, b = b, a
    found[count, 0], found[count, 1], found[count, 2] = a, b, near
    return count + 1


@kernel
def corners_of(surface: SurfaceBox, edges: int, a: int, b: int) -> tuple[int, int, int, int]:
    """Indices of the four points of a pair."""
    if edges:
        return surface.edges[a, 0], surface.edges[a, 1], surface.edges[b, 0], surface.edges[b, 1]
    return surface.points[a], surface.faces[b, 0], surface.faces[b, 1], surface.faces[b, 2]
