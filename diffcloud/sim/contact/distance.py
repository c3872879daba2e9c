"""Compute the closest points of a point and a triangle, and of two segments, as weights of the four given points.

The weights are differentiable within a region (interior, edge, corner). The distance itself is continuously
differentiable across regions wherever it is not zero, except for parallel segments.
"""

from __future__ import annotations

from math import sqrt

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats

_TINY = 1e-300
_CROSSING = 1e-14
"""Squared sine of the angle between two segments above which their closest points are unique."""


@kernel
def closest(edges: int, x: Floats, found: Floats) -> float:
    """Return the distance of a point and a face, or of two edges (`edges` > 0), given by four points x [4, 3] [m].

    `found` [6] receives the four weights and the region of the closest points. For a point and a face, the region is one
    number: 0 for the interior, 1..3 for the edges 01, 12, 20, and 4..6 for the corners. For two edges, the region is one
    number per edge: 0 or 1 for an end, and below zero for a point between the ends.
    """
    if edges > 0:
        _edge_edge(x, found)
    else:
        _point_face(x, found)
    square = 0.0
    for axis in range(3):
        gap = found[0] * x[0, axis] + found[1] * x[1, axis] + found[2] * x[2, axis] + found[3] * x[3, axis]
        square += gap * gap
    return sqrt(square)


@kernel
def on_segment(x: Floats, p: int, a: int, b: int) -> tuple[float, float, float]:
    """Find the point on segment ab that is closest to p.

    Returns:
        Its fraction along ab, clamped to [0, 1]; the fraction without clamping; its squared distance from p [m²].
    """
    along = arm = 0.0
    for axis in range(3):
        side = x[b, axis] - x[a, axis]
        along += side * side
        arm += (x[p, axis] - x[a, axis]) * side
    fraction = arm / max(along, _TINY)
    kept = min(max(fraction, 0.0), 1.0)
    square = 0.0
    for axis in range(3):
        part = x[p, axis] - x[a, axis] - kept * (x[b, axis] - x[a, axis])
        square += part * part
    return kept, fraction, square


@kernel
def _dot(x: Floats, a: int, b: int, c: int, d: int) -> float:
    """(x_a - x_b) · (x_c - x_d)"""
    return (
        (x[a, 0] - x[b, 0]) * (x[c, 0] - x[d, 0])
        + (x[a, 1] - x[b, 1]) * (x[c, 1] - x[d, 1])
        + (x[a, 2] - x[b, 2]) * (x[c, 2] - x[d, 2])
    )


@kernel
def _point_face(x: Floats, found: Floats) -> None:
    d00, d01, d11 = _dot(x, 2, 1, 2, 1), _dot(x, 2, 1, 3, 1), _dot(x, 3, 1, 3, 1)
    d20, d21 = _dot(x, 0, 1, 2, 1), _dot(x, 0, 1, 3, 1)
    determinant = d00 * d11 - d01 * d01
    found[0] = 1.0
    if determinant > _TINY:
        v, w = (d11 * d20 - d01 * d21) / determinant, (d00 * d21 - d01 * d20) / determinant
        if v >= 0 and w >= 0 and v + w <= 1:
            found[1], found[2], found[3], found[4] = v + w - 1, -v, -w, 0.0
            return
    best = -1.0
    for k in range(3):
        a, b = 1 + k, 1 + (k + 1) % 3
        kept, fraction, square = on_segment(x, 0, a, b)
        if k == 0 or square < best:
            best = square
            found[1] = found[2] = found[3] = 0.0
            found[a], found[b] = kept - 1, -kept
            found[4] = 3.0 + a if fraction < 0 else (3.0 + b if fraction > 1 else 1.0 + k)


@kernel
def _edge_edge(x: Floats, found: Floats) -> None:
    a, b, c = _dot(x, 1, 0, 1, 0), _dot(x, 1, 0, 3, 2), _dot(x, 3, 2, 3, 2)
    d, e = _dot(x, 1, 0, 0, 2), _dot(x, 3, 2, 0, 2)
    determinant = a * c - b * b
    if determinant > _CROSSING * a * c:
        s, t = (b * e - c * d) / determinant, (a * e - b * d) / determinant
        if 0 <= s <= 1 and 0 <= t <= 1:
            found[0], found[1], found[2], found[3] = 1 - s, s, t - 1, -t
            found[4] = found[5] = -1.0
            return
    best = -1.0
    for k in range(4):
        if k < 2:
            kept, fraction, square = on_segment(x, k, 2, 3)
        else:
            kept, fraction, square = on_segment(x, k, 0, 1)
        if k == 0 or square < best:
            best = square
            end = float(k % 2)
            where = 0.0 if fraction < 0 else (1.0 if fraction > 1 else -1.0)
            s, t = (end, kept) if k < 2 else (kept, end)
            found[0], found[1], found[2], found[3] = 1 - s, s, t - 1, -t
            found[4], found[5] = (end, where) if k < 2 else (where, end)
