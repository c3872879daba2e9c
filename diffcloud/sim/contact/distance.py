"""Closest places of a point and a triangle and of two segments, as weights, region by region.

The weights are differentiable within a region (interior, edge, corner). The distance itself is continuously
differentiable across regions wherever it is not zero, except for parallel segments.
"""

from __future__ import annotations

import torch
from torch import Tensor

_TINY = 1e-300


def point_face_weights(corners: Tensor) -> Tensor:
    """Weights of the closest place of a triangle to a point.

    Args:
        corners: [C, 4, 3] the point, then the triangle [m].

    Returns:
        [C, 4] (1, -b0, -b1, -b2) with b >= 0 and sum 1.
    """
    point, a, b, c = corners.unbind(1)
    ab, ac, ap = b - a, c - a, point - a
    d00, d01, d11 = (ab * ab).sum(-1), (ab * ac).sum(-1), (ac * ac).sum(-1)
    d20, d21 = (ap * ab).sum(-1), (ap * ac).sum(-1)
    determinant = d00 * d11 - d01 * d01
    safe = torch.where(determinant > _TINY, determinant, 1.0)
    v, w = (d11 * d20 - d01 * d21) / safe, (d00 * d21 - d01 * d20) / safe
    interior = (v >= 0) & (w >= 0) & (v + w <= 1) & (determinant > _TINY)
    inside = torch.stack([1 - v - w, v, w], dim=-1)

    on_edges = [_on_segment(point, start, end) for start, end in ((a, b), (b, c), (c, a))]
    t = [fraction for fraction, _ in on_edges]
    zero = torch.zeros_like(v)
    options = torch.stack(
        [
            torch.stack([1 - t[0], t[0], zero], -1),
            torch.stack([zero, 1 - t[1], t[1]], -1),
            torch.stack([t[2], zero, 1 - t[2]], -1),
        ],
        dim=1,
    )
    nearest = torch.stack([square for _, square in on_edges], dim=-1).argmin(-1)
    outside = options.gather(1, nearest[:, None, None].expand(-1, 1, 3)).squeeze(1)
    weights = torch.where(interior[:, None], inside, outside)
    return torch.cat([torch.ones_like(weights[:, :1]), -weights], dim=-1)


def edge_edge_weights(corners: Tensor) -> Tensor:
    """Weights of the closest places of two segments.

    Args:
        corners: [C, 4, 3] ends of the first and of the second segment [m].

    Returns:
        [C, 4] (a0, a1, -b0, -b1) with a, b >= 0 and sum 1 each.
    """
    p0, p1, q0, q1 = corners.unbind(1)
    u, v, w = p1 - p0, q1 - q0, p0 - q0
    a, b, c = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    d, e = (u * w).sum(-1), (v * w).sum(-1)
    determinant = a * c - b * b
    crossing = determinant > 1e-14 * a * c
    safe = torch.where(crossing, determinant, 1.0)
    s, t = (b * e - c * d) / safe, (a * e - b * d) / safe
    interior = crossing & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)

    zero, one = torch.zeros_like(s), torch.ones_like(s)
    ends = [_on_segment(p0, q0, q1), _on_segment(p1, q0, q1), _on_segment(q0, p0, p1), _on_segment(q1, p0, p1)]
    choices_s = torch.stack([zero, one, ends[2][0], ends[3][0]], dim=-1)
    choices_t = torch.stack([ends[0][0], ends[1][0], zero, one], dim=-1)
    nearest = torch.stack([square for _, square in ends], dim=-1).argmin(-1, keepdim=True)
    s = torch.where(interior, s, choices_s.gather(1, nearest).squeeze(1))
    t = torch.where(interior, t, choices_t.gather(1, nearest).squeeze(1))
    return torch.stack([1 - s, s, t - 1, -t], dim=-1)


def _on_segment(point: Tensor, start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """(fraction [C] along the segment, squared distance [C]) of the closest place to a point."""
    along, arm = end - start, point - start
    fraction = ((arm * along).sum(-1) / (along * along).sum(-1).clamp(min=_TINY)).clamp(0, 1)
    return fraction, (arm - fraction[:, None] * along).square().sum(-1)
