"""Chamfer distances between point clouds, with exact gradients.

    one-sided:  (1/N) Σ_x min_y |x - y|²      over N source points x, target points y   (paper, eq. 2, averaged)
    two-sided:  the sum of both directions                                               (paper, eq. 1)

The neighbour of a point is locally constant, so the gradient of each term is 2 (x - y) / N almost everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from diffcloud.clouds.neighbours import NeighbourIndex


def one_sided_chamfer(source: Tensor, target: NeighbourIndex) -> Tensor:
    """Mean squared distance [...] from the points of source clouds [..., N, 3] to one target [m²]."""
    return (source - target.nearest(source)).square().sum(-1).mean(-1)


def chamfer(source: Tensor, targets: Sequence[NeighbourIndex]) -> Tensor:
    """Two-sided Chamfer distance between a batch of clouds and targets of different lengths.

    Args:
        source: [B, N, 3].
        targets: B targets. Their points are differentiable too.

    Returns:
        [B] [m²].
    """
    values = []
    for cloud, target in zip(source, targets, strict=True):  # targets differ in length, so one at a time
        back = NeighbourIndex(cloud)
        points = target.points.to(cloud)
        forth = (cloud - target.nearest_to(back)).square().sum(-1).mean()
        values.append(forth + (points - back.nearest_to(target).to(points)).square().sum(-1).mean())
    return torch.stack(values)
