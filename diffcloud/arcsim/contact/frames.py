"""Normal and weights at the contact of two primitives, as in ARCSim: projected along the common normal, not clamped.

Both kinds of pair use one formula. With two edge vectors a, b and an offset d,

    point and face    a = y1 - y0,  b = y2 - y0,  d = x - y0
    two edges         a = p1 - p0,  b = q1 - q0,  d = q0 - p0

the normal is c/|c| with c = a × b. The positions along a and b are α = (d × b)·c/|c|² and β = (a × d)·c/|c|². The four
points are coplanar if c·d = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import sqrt
from typing import Literal

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats
from diffcloud.sim.compiled.function import Function
from diffcloud.sim.compiled.trace import Scalar, Vector, absolute, cross, dot, held, larger, maximum, squareroot, where

Kind = Literal["point_face", "edge_edge"]
_TINY = 1e-300
_GRAZING = 1e-9


def spans(kind: Kind, corners: Sequence[Vector]) -> tuple[Vector, Vector, Vector]:
    """Vectors a, b, d of the four points."""
    first, second, third, fourth = corners
    if kind == "point_face":
        return third - second, fourth - second, first - second
    return second - first, fourth - third, third - first


def frame(kind: Kind, corners: Sequence[Vector]) -> tuple[list[Scalar], Vector]:
    """Signed weights of the four points, whose sum is zero, and the unit normal."""
    a, b, d = spans(kind, corners)
    c = cross(a, b)
    square = maximum(dot(c, c), _TINY)
    direction = c / square
    alpha, beta = dot(cross(d, b), direction), dot(cross(a, d), direction)
    one = alpha.of(1.0)
    weights = [one, alpha + beta - 1, -alpha, -beta] if kind == "point_face" else [1 - alpha, alpha, -(1 + beta), beta]
    return weights, c * (1.0 / squareroot(square))


def _meeting(kind: Kind, inputs: Sequence[Scalar], constants: Sequence[Scalar]) -> list[Scalar]:
    """Weights [4] and normal [3] at the time when four points moving straight from start to end, both [4, 3], are coplanar.
    The time is differentiated by the implicit function theorem."""
    points = [Vector(*inputs[3 * k : 3 * k + 3]) for k in range(8)]
    start, end = points[:4], points[4:]
    time = constants[0]
    at = [first + time * (last - first) for first, last in zip(start, end, strict=True)]
    a, b, d = spans(kind, at)
    da, db, dd = spans(kind, [last - first for first, last in zip(start, end, strict=True)])
    volume = dot(cross(a, b), d)
    rate = dot(cross(a, b), dd) + dot(cross(da, b) + cross(a, db), d)
    # The contact time of a grazing pair has no derivative, so it is treated as constant.
    sides = [absolute(second[axis] - first[axis]) for first, second in pairwise(at) for axis in range(3)]
    size = sides[0]
    for side in sides[1:]:
        size = larger(size, side)
    moves = absolute(rate) > _GRAZING * (size * size * size)
    slope = where(moves, rate, 1.0)
    change = where(moves, (volume - held(volume)) / held(slope), 0.0)
    moment = time - change
    return [
        number
        for part in _flat(*frame(kind, [p + moment * (q - p) for p, q in zip(start, end, strict=True)]))
        for number in part
    ]


def _flat(weights: list[Scalar], normal: Vector) -> tuple[list[Scalar], list[Scalar]]:
    return weights, [normal.x, normal.y, normal.z]


POINT_FACE_MEETING = Function(
    "point_face_meeting", 24, 1, lambda inputs, constants: _meeting("point_face", inputs, constants)
)
EDGE_EDGE_MEETING = Function("edge_edge_meeting", 24, 1, lambda inputs, constants: _meeting("edge_edge", inputs, constants))


@kernel
def frame_at(edges: int, x: Floats, found: Floats) -> float:
    """Compute weights and normal of four points x [4, 3] into `found` [7]. Return |c|² [m⁴]."""
    if edges > 0:
        a, b, d = _difference(x, 1, 0), _difference(x, 3, 2), _difference(x, 2, 0)
    else:
        a, b, d = _difference(x, 2, 1), _difference(x, 3, 1), _difference(x, 0, 1)
    c = cross3(a, b)
    square = dot3(c, c)
    safe = max(square, _TINY)
    alpha, beta = dot3(cross3(d, b), c) / safe, dot3(cross3(a, d), c) / safe
    if edges > 0:
        found[0], found[1], found[2], found[3] = 1 - alpha, alpha, -(1 + beta), beta
    else:
        found[0], found[1], found[2], found[3] = 1.0, alpha + beta - 1, -alpha, -beta
    length = sqrt(safe)
    found[4], found[5], found[6] = c[0] / length, c[1] / length, c[2] / length
    return square


@kernel
def covers(edges: int, weights: Floats, tolerance: float) -> bool:
    """Whether the contact point given by weights [4] is on both primitives."""
    if edges > 0:
        return (
            weights[0] >= -tolerance
            and weights[1] >= -tolerance
            and -weights[2] >= -tolerance
            and -weights[3] >= -tolerance
        )
    return -weights[1] >= -tolerance and -weights[2] >= -tolerance and -weights[3] >= -tolerance


@kernel
def height(found: Floats, x: Floats) -> float:
    """Height of the first primitive above the second along the normal [m], for `found` [7] from `frame_at` and x [4, 3]."""
    total = 0.0
    for k in range(4):
        total += found[k] * (found[4] * x[k, 0] + found[5] * x[k, 1] + found[6] * x[k, 2])
    return total


@kernel
def dot3(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def cross3(a, b):  # type: ignore[no-untyped-def]
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel
def _difference(x, i, j):  # type: ignore[no-untyped-def]
    return x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
