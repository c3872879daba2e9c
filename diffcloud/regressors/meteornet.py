"""MeteorNet for whole sequences, with direct grouping (Liu et al. 2019, MeteorNet-cls, appendix D.2; paper, section
IV-B).

    three Meteor modules: 1,024, 512, 128 centroids of all frames' points joined; 32 neighbours within a radius that
        grows
    with the difference in time from r to 1.2 r (r = 0.5, 1, 2); [32, 32, 64], [64, 64, 128], [128, 128, 256]
    global set abstraction [256, 512, 1024] -> 512 -> 256 -> outputs

A neighbour's features are its position and time relative to the centroid, and the output of the previous module. The
radii are for sequences inside the unit sphere. Time runs from 0 to 1 over a sequence of the trained length.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from diffcloud.regressors.grouping import Order, farthest_points, gather_points, space_time_groups
from diffcloud.regressors.layers import GlobalAbstraction, Head, LocalNetwork, thinned

CENTROIDS = (1024, 512, 128)
NEIGHBOURS = 32
RADII = (0.5, 1.0, 2.0)
GROWTH = 0.2
WIDTHS = ((32, 32, 64), (64, 64, 128), (128, 128, 256))
GLOBAL_WIDTHS = (256, 512, 1024)


class MeteorModule(nn.Module):
    """Sample centroids in space and time, group points around them, and apply a network to each group."""

    def __init__(
        self, features: int, widths: tuple[int, ...], *, centroids: int, neighbours: int, radius: float, order: Order
    ) -> None:
        super().__init__()
        self.centroids, self.neighbours, self.radius, self.order = centroids, neighbours, radius, order
        self.network = LocalNetwork(4, features, widths)

    def forward(self, points: Tensor, times: Tensor, features: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Map points [B, N, 3], times [B, N] and features [B, N, C] or None to those of the centroids."""
        chosen = farthest_points(points, min(self.centroids, points.shape[1]))
        placed = torch.cat([points, times[..., None]], dim=-1)
        centroids = gather_points(placed, chosen)
        group = space_time_groups(
            points,
            times,
            centroids[..., :3],
            centroids[..., 3],
            radius=self.radius,
            growth=GROWTH,
            count=self.neighbours,
            order=self.order,
        )
        relative = gather_points(placed, group) - centroids[:, :, None]
        return centroids[..., :3], centroids[..., 3], self.network(relative, features, group)


class MeteorNet(nn.Module):
    """Network from the points of all frames to outputs."""

    def __init__(
        self, outputs: int, *, frames: int, dropout: float = 0.0, order: Order = "cloud", density: float = 1.0
    ) -> None:
        """Create the network.

        Args:
            frames: number of frames in a training sequence, which is one unit of time long.
            density: fraction of the published numbers of centroids and neighbours. Layer widths stay as published.
        """
        super().__init__()
        self.frames = frames
        centroids = thinned(CENTROIDS, density)
        (neighbours,) = thinned((NEIGHBOURS,), density)
        inputs = (0, *(widths[-1] for widths in WIDTHS))
        self.modules_in_time = nn.ModuleList(
            MeteorModule(
                inputs[level],
                WIDTHS[level],
                centroids=centroids[level],
                neighbours=neighbours,
                radius=RADII[level],
                order=order,
            )
            for level in range(len(WIDTHS))
        )
        self.overall = GlobalAbstraction(WIDTHS[-1][-1], GLOBAL_WIDTHS)
        self.head = Head(GLOBAL_WIDTHS[-1], outputs, dropout=(dropout, dropout))

    def forward(self, clouds: Tensor) -> Tensor:
        """Map clouds [B, T, P, 3] to [B, outputs]. The number of frames may differ from training, but not the frame
        rate."""
        batch, frames, count, _ = clouds.shape
        # frames alternate, so that the first points in a ball come from all of them
        points = clouds.transpose(1, 2).flatten(1, 2)
        time = torch.arange(frames, dtype=clouds.dtype, device=clouds.device) / max(self.frames - 1, 1)
        times, features = time.repeat(count).expand(batch, -1), None
        for module in self.modules_in_time:
            points, times, features = module(points, times, features)
        assert features is not None
        outputs: Tensor = self.head(self.overall(points, features))
        return outputs
