"""Continuous collision detection: when and where linearly moving primitives first meet (Provot 1997; Bridson et al. 2002).

Four points are coplanar at the roots of a cubic in time. With a static partner it is quadratic or linear. The roots are
bracketed between the cubic's critical points, where it is monotone. Newton's method finds them within the bracket.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from diffcloud.arcsim.contact.frames import covers, cross3, dot3, frame_at, height
from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats

_ITERATIONS = 80
_TIME = 1e-15
_COPLANAR = 1e-6
"""Distance of the primitives above which a root is a rounding artefact [m]."""
_OUTSIDE = 1e-6
"""Tolerance of the weights for points slightly outside a primitive."""
NEVER = 2.0
"""Time that stands for no impact."""


@kernel
def first_impact(edges: int, start: Floats, end: Floats, smallest: float, place: Floats) -> float:
    """First time in [0, 1] at which a pair meets that moves straight from start to end [4, 3], or `NEVER`.

    Args:
        edges: 1 for two edges, 0 for a point and a face.
        smallest: pairs with |a × b|² below this never meet [m⁴].
        place: [7] receives the weights and the normal at this time.
    """
    cubic = coplanarity_cubic(edges, start, end)
    x = np.empty((4, 3))
    for k in range(3):
        time = unit_root(cubic, k)
        if time == NEVER:
            continue
        for i in range(4):
            for axis in range(3):
                x[i, axis] = start[i, axis] + time * (end[i, axis] - start[i, axis])
        square = frame_at(edges, x, place)
        if square > 0 and square >= smallest and abs(height(place, x)) <= _COPLANAR and covers(edges, place, _OUTSIDE):
            return time
    return NEVER


@kernel
def coplanarity_cubic(edges: int, start: Floats, end: Floats) -> tuple[float, float, float, float]:
    """Coefficients, constant first, of (a × b)·d over the time in [0, 1]: six times the volume of the four points [m³]."""
    if edges > 0:
        a, b, d = _span(start, 1, 0), _span(start, 3, 2), _span(start, 2, 0)
        da, db, dd = _change(start, end, 1, 0), _change(start, end, 3, 2), _change(start, end, 2, 0)
    else:
        a, b, d = _span(start, 2, 1), _span(start, 3, 1), _span(start, 0, 1)
        da, db, dd = _change(start, end, 2, 1), _change(start, end, 3, 1), _change(start, end, 0, 1)
    still, turning = cross3(a, b), cross3(da, db)
    first, second = cross3(a, db), cross3(da, b)
    mixed = (first[0] + second[0], first[1] + second[1], first[2] + second[2])
    return dot3(still, d), dot3(mixed, d) + dot3(still, dd), dot3(turning, d) + dot3(mixed, dd), dot3(turning, dd)


@kernel
def unit_root(cubic: tuple[float, float, float, float], number: int) -> float:
    """Root of a cubic in one (0, 1, 2) of the three intervals of [0, 1] in which it is monotone, or `NEVER`."""
    _, c1, c2, c3 = cubic
    # Critical points 3 c3 t² + 2 c2 t + c1 = 0, computed without cancellation and clamped to [0, 1].
    root = sqrt(max(c2 * c2 - 3 * c3 * c1, 0.0))
    q = -(c2 - root) if c2 < 0 else -(c2 + root)
    one, other = _unit(q, 3 * c3), _unit(c1, q)
    low = 0.0 if number == 0 else (min(one, other) if number == 1 else max(one, other))
    high = 1.0 if number == 2 else (min(one, other) if number == 0 else max(one, other))
    at_low, at_high = _value(cubic, low), _value(cubic, high)
    if (at_low > 0 and at_high > 0) or (at_low < 0 and at_high < 0) or not (high > low or at_low == 0):
        return NEVER
    if at_low != at_low or at_high != at_high:
        return NEVER
    rising, change = at_high > at_low, at_high - at_low
    time = low if change == 0 else low - at_low * (high - low) / change
    for _ in range(_ITERATIONS):
        value = _value(cubic, time)
        above = (value > 0) == rising
        if above or value == 0:
            high = time
        if not (above and value != 0):
            low = time
        slope = (3 * c3 * time + 2 * c2) * time + c1
        newton = time - value / slope if slope != 0 else NEVER
        following = newton if low <= newton <= high else 0.5 * (low + high)
        done = abs(following - time) <= _TIME
        time = following
        if done:
            break
    return time


@kernel
def _value(cubic: tuple[float, float, float, float], time: float) -> float:
    return ((cubic[3] * time + cubic[2]) * time + cubic[1]) * time + cubic[0]


@kernel
def _unit(part: float, whole: float) -> float:
    """part / whole clamped to [0, 1]; NaN gives 0."""
    if whole == 0:
        return 1.0 if part > 0 else 0.0
    time = part / whole
    if not time > 0:
        return 0.0
    return min(time, 1.0)


@kernel
def _span(x, i, j):  # type: ignore[no-untyped-def]
    return x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]


@kernel
def _change(x, y, i, j):  # type: ignore[no-untyped-def]
    return (
        (y[i, 0] - x[i, 0]) - (y[j, 0] - x[j, 0]),
        (y[i, 1] - x[i, 1]) - (y[j, 1] - x[j, 1]),
        (y[i, 2] - x[i, 2]) - (y[j, 2] - x[j, 2]),
    )
