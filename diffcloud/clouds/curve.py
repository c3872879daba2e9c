"""Order of points along a Hilbert curve, so that neighbours in the order are neighbours in space.

The state table of the curve follows Hamilton, "Compact Hilbert indices" (2006). It has 12 states.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diffcloud.compiled import kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_BITS = 10
_CELLS = 1 << _BITS
"""Number of cells along the longest side of the points' bounding box."""


def _rotated(bits: int, by: int) -> int:
    """Rotate three bits to the right."""
    by %= 3
    return (bits >> by | bits << (3 - by)) & 7


def _curve_tables() -> tuple[Ints, Ints]:
    """For each octant in each of S states [8 S]: its position along the curve, and the start of the next state's
    octants."""
    gray = [i ^ i >> 1 for i in range(8)]
    entry = [0, 0, 0, 3, 3, 6, 6, 5]  # the corner at which the curve enters the w-th octant
    direction = [0, 1, 1, 2, 2, 1, 1, 0]  # the axis along which it crosses it
    states = [(0, 0)]
    places, following = [], []
    for corner, axis in states:  # the list grows in the loop
        for octant in range(8):
            place = gray.index(_rotated(octant ^ corner, axis + 1))
            state = (corner ^ _rotated(entry[place], -axis - 1), (axis + direction[place] + 1) % 3)
            if state not in states:
                states.append(state)
            places.append(place)
            following.append(8 * states.index(state))
    return np.array(places), np.array(following)


_PLACE, _NEXT = _curve_tables()


@kernel
def larger(a: float, b: float) -> float:
    """The larger of two numbers that are not NaN. Faster than the built-in function, which checks for NaN."""
    return a if a > b else b


@kernel
def smaller(a: float, b: float) -> float:
    """The smaller of two numbers that are not NaN."""
    return a if a < b else b


@kernel
def _cell(offset: float, scale: float) -> int:
    """Cell index along one axis. Overflowing values get cell 0, where the search still finds them, but more slowly."""
    place = offset * scale
    return int(place) if 0 <= place < _CELLS else 0


@kernel
def _along_curve(x: int, y: int, z: int) -> int:
    """Position of a cell along the curve."""
    place = state = 0
    for bit in range(_BITS - 1, -1, -1):
        octant = state + ((x >> bit) & 1 | ((y >> bit) & 1) << 1 | ((z >> bit) & 1) << 2)
        place = place << 3 | _PLACE[octant]
        state = _NEXT[octant]
    return place


@kernel
def curve_order(points: Floats) -> Ints:
    """Indices [at most P] of the finite points among points [P, 3], in order along the curve (radix sort)."""
    order, other = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    count = 0
    for i in range(len(points)):
        if np.isfinite(points[i, 0]) and np.isfinite(points[i, 1]) and np.isfinite(points[i, 2]):
            order[count] = i
            count += 1
            for axis in range(3):
                low[axis] = smaller(low[axis], points[i, axis])
                high[axis] = larger(high[axis], points[i, axis])
    side = max(high[0] - low[0], high[1] - low[1], high[2] - low[2])
    scale = (_CELLS - 1e-3) / side if 0 < side < np.inf else 0.0
    places, moved = np.empty(count, np.int64), np.empty(count, np.int64)
    starts = np.zeros((3, _CELLS), np.int64)
    for k in range(count):
        x, y, z = points[order[k], 0] - low[0], points[order[k], 1] - low[1], points[order[k], 2] - low[2]
        place = _along_curve(_cell(x, scale), _cell(y, scale), _cell(z, scale))
        places[k] = place
        for digit in range(3):
            starts[digit, (place >> digit * _BITS) & (_CELLS - 1)] += 1
    for digit in range(3):
        total = 0
        for bucket in range(_CELLS):
            starts[digit, bucket], total = total, total + starts[digit, bucket]
        for k in range(count):
            bucket = (places[k] >> digit * _BITS) & (_CELLS - 1)
            at = starts[digit, bucket]
            starts[digit, bucket] += 1
            moved[at] = places[k]
            other[at] = order[k]
        places, moved = moved, places
        order, other = other, order
    return order[:count]
