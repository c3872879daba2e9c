"""PointNet++ with multi-scale grouping (Qi et al. 2017, appendix B.1; paper, section IV-B).

    SA(512; radii 0.1, 0.2, 0.4; 16, 32, 128 neighbours; [32, 32, 64], [64, 64, 128], [64, 96, 128])
    SA(128; radii 0.2, 0.4, 0.8; 32, 64, 128 neighbours; [64, 64, 128], [128, 128, 256], [128, 128, 256])
    global SA [256, 512, 1024] -> 512 -> 256 -> outputs, with dropout 0.5

The radii are for clouds inside the unit sphere.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from diffcloud.regressors.grouping import Order, ball_groups, farthest_points, gather_points
from diffcloud.regressors.layers import GlobalAbstraction, Head, LocalNetwork, thinned


@dataclass(frozen=True)
class Scales:
    """Layout of one set abstraction."""

    centroids: int
    radii: tuple[float, ...]
    neighbours: tuple[int, ...]
    widths: tuple[tuple[int, ...], ...]
    """Layer widths for each radius."""

    @property
    def outputs(self) -> int:
        return sum(widths[-1] for widths in self.widths)


ABSTRACTIONS = (
    Scales(512, (0.1, 0.2, 0.4), (16, 32, 128), ((32, 32, 64), (64, 64, 128), (64, 96, 128))),
    Scales(128, (0.2, 0.4, 0.8), (32, 64, 128), ((64, 64, 128), (128, 128, 256), (128, 128, 256))),
)
GLOBAL_WIDTHS = (256, 512, 1024)


class SetAbstraction(nn.Module):
    """Sample centroids, group points around them at several scales, and apply a network to each group."""

    def __init__(self, features: int, scales: Scales, *, order: Order, density: float) -> None:
        super().__init__()
        self.order = order
        (self.centroids,) = thinned((scales.centroids,), density)
        self.radii = scales.radii
        self.neighbours = thinned(scales.neighbours, density)
        self.networks = nn.ModuleList(LocalNetwork(3, features, widths) for widths in scales.widths)

    def forward(self, points: Tensor, features: Tensor | None) -> tuple[Tensor, Tensor]:
        """Map points [B, N, 3] and features [B, N, C] or None to centroids [B, M, 3] and features [B, M, C']."""
        centroids = gather_points(points, farthest_points(points, min(self.centroids, points.shape[1])))
        groups = ball_groups(points, centroids, self.radii, self.neighbours, order=self.order)
        found = [
            network(gather_points(points, group) - centroids[:, :, None], features, group)
            for network, group in zip(self.networks, groups, strict=True)
        ]
        return centroids, torch.cat(found, dim=-1)


class PointNet2(nn.Module):
    """Network from the points of one frame to outputs."""

    def __init__(self, outputs: int, *, dropout: float = 0.5, order: Order = "cloud", density: float = 1.0) -> None:
        """Create the network.

        Args:
            density: fraction of the published numbers of centroids and neighbours; the layers are the same.
        """
        super().__init__()
        first, second = ABSTRACTIONS
        self.first = SetAbstraction(0, first, order=order, density=density)
        self.second = SetAbstraction(first.outputs, second, order=order, density=density)
        self.overall = GlobalAbstraction(second.outputs, GLOBAL_WIDTHS)
        self.head = Head(GLOBAL_WIDTHS[-1], outputs, dropout=(dropout, dropout))

    def forward(self, clouds: Tensor) -> Tensor:
        """Map clouds [B, T, P, 3] to [B, outputs]. The points of all frames are one set."""
        points, features = self.second(*self.first(clouds.flatten(1, 2), None))
        outputs: Tensor = self.head(self.overall(points, features))
        return outputs
