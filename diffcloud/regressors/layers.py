"""Building blocks of the regressors: shared layers, set abstractions, and the head.

A layer is linear, batch normalisation, ReLU; "shared" means that it acts on the last axis, alike for every point.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from diffcloud.regressors.grouping import gather_points


class Layer(nn.Module):
    """Linear, batch normalisation over all leading axes, ReLU: [..., inputs] -> [..., outputs]."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs)
        self.norm = nn.BatchNorm1d(outputs)

    def activate(self, linear: Tensor) -> Tensor:
        """What follows the linear part."""
        # in place: neither derivative needs what comes between
        return functional.relu(self.norm(linear.flatten(0, -2)), inplace=True).view_as(linear)

    def forward(self, values: Tensor) -> Tensor:
        return self.activate(self.linear(values))


def shared_layers(inputs: int, widths: Sequence[int]) -> nn.Sequential:
    """Layers in a row."""
    return nn.Sequential(*(Layer(a, b) for a, b in zip((inputs, *widths), widths, strict=False)))


class _Highest(torch.autograd.Function):
    """The maximum over the last axis but one, and the first place where it is taken."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        *batch, count, channels = values.shape
        # a pool over images of one column whose channels lie side by side: torch's own `max` over an axis that is not the
        # last one takes ten times as long on a CPU
        columns = values.reshape(-1, count, 1, channels).permute(0, 3, 1, 2)
        found, index = functional.max_pool2d(columns, (count, 1), return_indices=True)
        ctx.save_for_backward(index.reshape(*batch, channels))
        ctx.count = count
        return found.reshape(*batch, channels)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (gradient,), (index,) = gradients, ctx.saved_tensors
        spread = gradient.new_zeros(*gradient.shape[:-1], ctx.count, gradient.shape[-1])
        return spread.scatter_(-2, index.unsqueeze(-2), gradient.unsqueeze(-2))


def highest(values: Tensor) -> Tensor:
    """[..., N, C] -> [..., C] the maximum over N points; its derivative goes to the first of those that share it."""
    found: Tensor = _Highest.apply(values)
    return found


class LocalNetwork(nn.Module):
    """A PointNet of each group: layers shared by all neighbours, then the maximum over them."""

    def __init__(self, relative: int, features: int, widths: Sequence[int]) -> None:
        """
        Args:
            relative: channels that tell where a neighbour is from its centroid (3; 4 with time).
            features: channels of a point; 0 for none.
            widths: outputs of the layers.
        """
        super().__init__()
        self.relative = relative
        self.first = Layer(relative + features, widths[0])
        self.rest = shared_layers(widths[0], widths[1:])

    def forward(self, relative: Tensor, features: Tensor | None, index: Tensor) -> Tensor:
        """[B, M, K, relative], [B, N, features] or None, [B, M, K] indices -> [B, M, widths[-1]]."""
        linear = self.first.linear
        first = functional.linear(relative, linear.weight[:, : self.relative], linear.bias)
        if features is not None:
            # the first layer's product with a point's features is the same in every group that has the point: it is
            # taken before the grouping, which saves most of its cost and changes nothing else
            first = first + gather_points(functional.linear(features, linear.weight[:, self.relative :]), index)
        return highest(self.rest(self.first.activate(first)))


class GlobalAbstraction(nn.Module):
    """The last set abstraction: all points are one group around the origin."""

    def __init__(self, features: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.layers = shared_layers(3 + features, widths)

    def forward(self, points: Tensor, features: Tensor) -> Tensor:
        """[B, N, 3], [B, N, features] -> [B, widths[-1]]."""
        return highest(self.layers(torch.cat([points, features], dim=-1)))


class Head(nn.Sequential):
    """Fully connected 512 and 256, then the outputs: [B, inputs] -> [B, outputs]."""

    def __init__(self, inputs: int, outputs: int, *, dropout: Sequence[float]) -> None:
        """
        Args:
            dropout: after each of the two hidden layers.
        """
        parts: list[nn.Module] = []
        for (a, b), rate in zip(((inputs, 512), (512, 256)), dropout, strict=True):
            parts += [Layer(a, b), nn.Dropout(rate)]  # also at rate 0: names of weights must not depend on it
        super().__init__(*parts, nn.Linear(256, outputs))


def thinned(counts: Sequence[int], density: float) -> tuple[int, ...]:
    """Numbers of centroids or neighbours at a fraction of the published ones; at least four."""
    return tuple(max(4, round(density * count)) for count in counts)
