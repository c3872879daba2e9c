"""Smooth contact of one pair in torch: all places where it may touch, with their shares."""

from __future__ import annotations

import torch
from torch import Tensor

from tests.sim.twins.terms import norm

_PARALLEL = 1e-3


def energy(distance: Tensor, scale: float, thickness: float) -> Tensor:
    """φ per area [J/m²]: -(k_c/6) (d - d̂)² ln(d / d̂), zero beyond d̂."""
    ratio = distance / thickness
    inside = thickness**2 * (ratio - 1).square() * ratio.log()
    return torch.where(ratio < 1, -scale / 6 * inside, 0.0)


def fraction_along(point: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Where a segment is closest to a point, in [0, 1]."""
    along = end - start
    return ((point - start) @ along / (along @ along)).clamp(0, 1)


def point_face_weights(corners: Tensor) -> Tensor:
    """[4] (1, -b0, -b1, -b2) of the closest place of a triangle to a point: corners [4, 3], the point first."""
    point, a, b, c = corners
    ab, ac, ap = b - a, c - a, point - a
    gram = torch.stack([torch.stack([ab @ ab, ab @ ac]), torch.stack([ab @ ac, ac @ ac])])
    v, w = torch.linalg.solve(gram, torch.stack([ap @ ab, ap @ ac]))
    one = torch.ones_like(v)
    if v >= 0 and w >= 0 and v + w <= 1:
        return torch.stack([one, v + w - 1, -v, -w])
    best: tuple[float, Tensor] | None = None
    for first, second in ((0, 1), (1, 2), (2, 0)):
        start, end = corners[1 + first], corners[1 + second]
        t = fraction_along(point, start, end)
        square = float((point - start - t * (end - start)).square().sum())
        weights = torch.zeros(4, dtype=corners.dtype).index_put((torch.tensor([0]),), one[None])
        weights = weights.index_put((torch.tensor([1 + first, 1 + second]),), torch.stack([t - 1, -t]))
        if best is None or square < best[0]:
            best = square, weights
    assert best is not None
    return best[1]


def edge_edge_weights(corners: Tensor) -> Tensor:
    """[4] (a0, a1, -b0, -b1) of the closest places of two segments."""
    p0, p1, q0, q1 = corners
    u, v, w = p1 - p0, q1 - q0, p0 - q0
    a, b, c, d, e = u @ u, u @ v, v @ v, u @ w, v @ w
    determinant = a * c - b * b
    if determinant > 1e-14 * a * c:
        s, t = (b * e - c * d) / determinant, (a * e - b * d) / determinant
        if 0 <= s <= 1 and 0 <= t <= 1:
            return torch.stack([1 - s, s, t - 1, -t])
    zero, one = torch.zeros_like(a), torch.ones_like(a)
    options = [
        (zero, fraction_along(p0, q0, q1)),
        (one, fraction_along(p1, q0, q1)),
        (fraction_along(q0, p0, p1), zero),
        (fraction_along(q1, p0, p1), one),
    ]
    s, t = min(options, key=lambda o: float((p0 + o[0] * u - q0 - o[1] * v).square().sum()))
    return torch.stack([1 - s, s, t - 1, -t])


def place_force(
    weights: Tensor, share: Tensor | float, corners: Tensor, velocities: Tensor, law: Tensor, friction: Tensor
) -> Tensor:
    """[4, 3] on the points of a pair at one place: law (k_c, d̂, v_s), velocities [4, 3] of the step."""
    scale, thickness, sticking = law
    gap = weights @ corners
    distance = norm(gap)
    if float(distance) >= float(thickness):
        return torch.zeros_like(corners)
    normal, ratio = gap / distance, distance / thickness
    pressure = scale / 6 * thickness * (2 * (ratio - 1) * ratio.log() + (ratio - 1).square() / ratio)
    velocity = weights @ velocities
    sliding = velocity - (velocity @ normal) * normal
    speed = norm(sliding)
    per_speed = (2 - speed / sticking) / sticking if float(speed) < float(sticking) else 1 / speed
    push = share * pressure * (normal - friction * per_speed * sliding)
    return weights[:, None] * push


def edge_edge_force(corners: Tensor, velocities: Tensor, area: float, law: Tensor, friction: Tensor) -> Tensor:
    """Of two edges; fades out as they become parallel."""
    u, v = corners[1] - corners[0], corners[3] - corners[2]
    ratio = torch.linalg.cross(u, v).square().sum() / (_PARALLEL * (u @ u) * (v @ v))
    fading = ratio * (2 - ratio) if float(ratio) < 1 else torch.ones_like(ratio)
    return place_force(edge_edge_weights(corners), area * fading, corners, velocities, law, friction)


def point_face_force(
    corners: Tensor,
    velocities: Tensor,
    area: float,
    edge_share: Tensor,
    corner_share: Tensor,
    law: Tensor,
    friction: Tensor,
) -> Tensor:
    """Of a point and a face: the face, less its inner edges, and its inner corners again (inclusion, exclusion)."""
    total = place_force(point_face_weights(corners), area, corners, velocities, law, friction)
    one = torch.ones((), dtype=corners.dtype)
    for number, (first, second) in enumerate(((1, 2), (2, 3), (3, 1))):
        t = fraction_along(corners[0], corners[first], corners[second])
        weights = torch.zeros(4, dtype=corners.dtype)
        weights = weights.index_put((torch.tensor([0, first, second]),), torch.stack([one, t - 1, -t]))
        total = total + place_force(weights, -area * edge_share[number], corners, velocities, law, friction)
        weights = torch.zeros(4, dtype=corners.dtype)
        weights[0], weights[1 + number] = 1.0, -1.0
        total = total + place_force(weights, area * corner_share[number], corners, velocities, law, friction)
    return total
