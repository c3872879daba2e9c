"""Compiled kernel of the sums over all pairs for the pose search. `estimation.matching` explains the terms."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats, Ints


class Surfaces(NamedTuple):
    """B motions of V nodes at L frames, with V / C nodes for each of C clocks. Axis B or L of the velocities has length
    one if all motions or frames share them."""

    nodes: Floats
    """[B, L, V, 3] node positions."""
    velocities: Floats
    """[B, L, V, 3], or empty without velocities."""


class Placements(NamedTuple):
    """B poses x' = matrix (x + lag v - centre) + shift, and their derivatives by the d pose variables
    (`estimation.pose`)."""

    centre: Floats
    """[3] centre of the recording."""
    matrix: Floats
    """[B, 3, 3] scaled rotations."""
    shift: Floats
    """[B, 3] shifts, including the centre."""
    lag: Floats
    """[B, C] lag of each clock relative to its stated offset [s]."""
    matrix_rates: Floats
    """[d, B, 3, 3] derivatives of `matrix`."""
    shift_rates: Floats
    """[d, 3] derivatives of `shift`."""
    lag_rates: Floats
    """[d, C] derivatives of `lag`."""


class Partners(NamedTuple):
    """N pairs of a surface point and a recorded point per frame. Shared values have length one along axis B or L."""

    corners: Ints
    """[B, L, N, 3] nodes of the face that contains the surface point, all of one clock."""
    barycentric: Floats
    """[B, L, N, 3] barycentric coordinates of the surface point in its face."""
    points: Floats
    """[B, L, N, 3] recorded points."""
    normals: Floats
    """[B, L, N, 3] normals of the recorded surface, along which a pair may slide. Empty: use the face normals."""
    weights: Floats
    """[B, L, N] weights of the pairs."""
    spacing: Floats
    """[L] distance between neighbouring recorded points."""


@kernel
def sum_terms(
    surfaces: Surfaces,
    placements: Placements,
    pairs: Partners,
    cap: float,
    hidden: float,
    loss: Floats,
    slope: Floats,
    curvature: Floats,
) -> None:
    """Add the loss [B], half its gradient [B, d] and half its Hessian approximation [B, d, d] in the pose to the
    outputs.

    Args:
        cap: distances are capped at this value.
        hidden: loss of a frame whose pairs all have zero weight.
    """
    each, count = surfaces.nodes.shape[2] // placements.lag.shape[1], len(placements.shift_rates)
    moves, own_normals = surfaces.velocities.size > 0, pairs.normals.size == 0
    c0, c1, c2 = placements.centre[0], placements.centre[1], placements.centre[2]
    along, beside = np.empty(count), np.empty(count)
    for b in range(surfaces.nodes.shape[0]):
        matrix, matrix_rates = placements.matrix[b], placements.matrix_rates[:, b]
        m00, m01, m02 = matrix[0, 0], matrix[0, 1], matrix[0, 2]
        m10, m11, m12 = matrix[1, 0], matrix[1, 1], matrix[1, 2]
        m20, m21, m22 = matrix[2, 0], matrix[2, 1], matrix[2, 2]
        for f in range(surfaces.nodes.shape[1]):
            nodes = surfaces.nodes[b, f]
            velocities = _of(surfaces.velocities, b, f) if moves else nodes
            corners, barycentric = _of(pairs.corners, b, f), _of(pairs.barycentric, b, f)
            points, weights = _of(pairs.points, b, f), _of(pairs.weights, b, f)
            normals = points if own_normals else _of(pairs.normals, b, f)
            total = found = 0.0
            for pair in range(len(weights)):
                weight = weights[pair]
                if weight == 0.0:
                    continue
                total += weight
                i, j, k = corners[pair, 0], corners[pair, 1], corners[pair, 2]
                clock = i // each
                lag = placements.lag[b, clock]
                u, v, w = barycentric[pair, 0], barycentric[pair, 1], barycentric[pair, 2]
                p0, p1, p2 = _inside(nodes, i, j, k, u, v, w)
                v0 = v1 = v2 = 0.0
                if moves:
                    v0, v1, v2 = _inside(velocities, i, j, k, u, v, w)
                p0, p1, p2 = p0 + lag * v0 - c0, p1 + lag * v1 - c1, p2 + lag * v2 - c2
                x = m00 * p0 + m01 * p1 + m02 * p2 + placements.shift[b, 0] - points[pair, 0]
                y = m10 * p0 + m11 * p1 + m12 * p2 + placements.shift[b, 1] - points[pair, 1]
                z = m20 * p0 + m21 * p1 + m22 * p2 + placements.shift[b, 2] - points[pair, 2]
                squared = x * x + y * y + z * z
                if not squared < cap * cap:
                    found += weight * (cap * cap if squared == squared else squared)
                    continue
                found += weight * squared
                if own_normals:
                    f0, f1, f2 = _across(nodes, velocities, lag, i, j, k)
                    n0 = m00 * f0 + m01 * f1 + m02 * f2
                    n1 = m10 * f0 + m11 * f1 + m12 * f2
                    n2 = m20 * f0 + m21 * f1 + m22 * f2
                    size = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
                    if size > 0.0:  # else the face has no area
                        n0, n1, n2 = n0 / size, n1 / size, n2 / size
                else:
                    n0, n1, n2 = normals[pair, 0], normals[pair, 1], normals[pair, 2]
                height = x * n0 + y * n1 + z * n2
                t0, t1, t2 = x - height * n0, y - height * n1, z - height * n2  # becomes sqrt(w) t after the division
                size = np.sqrt(t0 * t0 + t1 * t1 + t2 * t2 + pairs.spacing[f] * pairs.spacing[f])
                if size > 0.0:
                    t0, t1, t2 = t0 / size, t1 / size, t2 / size
                for row in range(count):
                    turn, shift = matrix_rates[row], placements.shift_rates[row]
                    late = placements.lag_rates[row, clock]
                    r0 = turn[0, 0] * p0 + turn[0, 1] * p1 + turn[0, 2] * p2 + shift[0]
                    r1 = turn[1, 0] * p0 + turn[1, 1] * p1 + turn[1, 2] * p2 + shift[1]
                    r2 = turn[2, 0] * p0 + turn[2, 1] * p1 + turn[2, 2] * p2 + shift[2]
                    r0 += late * (m00 * v0 + m01 * v1 + m02 * v2)
                    r1 += late * (m10 * v0 + m11 * v1 + m12 * v2)
                    r2 += late * (m20 * v0 + m21 * v1 + m22 * v2)
                    slope[b, row] += weight * (r0 * x + r1 * y + r2 * z)
                    along[row], beside[row] = r0 * n0 + r1 * n1 + r2 * n2, r0 * t0 + r1 * t1 + r2 * t2
                    for column in range(row + 1):
                        curvature[b, row, column] += weight * (along[row] * along[column] + beside[row] * beside[column])
            loss[b] += found if total > 0.0 else hidden
        for row in range(count):
            for column in range(row):
                curvature[b, column, row] = curvature[b, row, column]


@kernel
def _of(values: Any, motion: int, frame: int) -> Any:
    """Return the values [N, ...] of one frame of one motion; axes of length one are shared."""
    return values[min(motion, values.shape[0] - 1), min(frame, values.shape[1] - 1)]


@kernel
def _inside(values: Floats, i: int, j: int, k: int, u: float, v: float, w: float) -> tuple[float, float, float]:
    """Interpolate values [V, 3] of three nodes with barycentric coordinates."""
    return (
        u * values[i, 0] + v * values[j, 0] + w * values[k, 0],
        u * values[i, 1] + v * values[j, 1] + w * values[k, 1],
        u * values[i, 2] + v * values[j, 2] + w * values[k, 2],
    )


@kernel
def _across(nodes: Floats, velocities: Floats, lag: float, i: int, j: int, k: int) -> tuple[float, float, float]:
    """Return the normal of a face after a lag, with twice the face's area as its length."""
    a0, a1, a2 = nodes[j, 0] - nodes[i, 0], nodes[j, 1] - nodes[i, 1], nodes[j, 2] - nodes[i, 2]
    b0, b1, b2 = nodes[k, 0] - nodes[i, 0], nodes[k, 1] - nodes[i, 1], nodes[k, 2] - nodes[i, 2]
    if lag != 0.0:
        a0, a1 = a0 + lag * (velocities[j, 0] - velocities[i, 0]), a1 + lag * (velocities[j, 1] - velocities[i, 1])
        b0, b1 = b0 + lag * (velocities[k, 0] - velocities[i, 0]), b1 + lag * (velocities[k, 1] - velocities[i, 1])
        a2, b2 = a2 + lag * (velocities[j, 2] - velocities[i, 2]), b2 + lag * (velocities[k, 2] - velocities[i, 2])
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


def compile_terms() -> None:
    """Compile the kernel for the pose search."""
    points = np.zeros((1, 1, 3, 3))
    surfaces = Surfaces(points, points)
    placements = Placements(
        np.zeros(3), np.eye(3)[None], np.zeros((1, 3)), np.zeros((1, 1)), np.eye(3)[None, None], np.eye(3)[:1], np.eye(1)
    )
    pairs = Partners(np.zeros((1, 1, 3, 3), np.int64), points, points, points, np.ones((1, 1, 3)), np.ones(1))
    sum_terms(surfaces, placements, pairs, 1.0, 1.0, np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1, 1)))
