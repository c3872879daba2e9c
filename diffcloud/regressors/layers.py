"""Building blocks of the regressors: shared layers, set abstractions, and the head. A layer is linear, batch
normalisation, ReLU. "Shared" means that it acts on the last axis, with equal weights for every point."""

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
        """Apply batch normalisation and ReLU."""
        # in place, since no derivative needs the intermediate values
        return functional.relu(self.norm(linear.flatten(0, -2)), inplace=True).view_as(linear)

    def forward(self, values: Tensor) -> Tensor:
        return self.activate(self.linear(values))


def shared_layers(inputs: int, widths: Sequence[int]) -> nn.Sequential:
    """Return a sequence of layers."""
    return nn.Sequential(*(Layer(a, b) for a, b in zip((inputs, *widths), widths, strict=False)))


class _Highest(torch.autograd.Function):
    """Maximum over the second-to-last axis; the gradient goes to the first position of the maximum."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        *batch, count, channels = values.shape
        # max-pooling over images of one column with adjacent channels: torch's own `max` over an axis that is not the
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
    """Return the maximum over N points, [..., N, C] -> [..., C]. The first maximum gets the gradient."""
    found: Tensor = _Highest.apply(values)
    return found


class LocalNetwork(nn.Module):
    """A PointNet for each group: layers shared by all neighbours, then the maximum over them."""

    def __init__(self, relative: int, features: int, widths: Sequence[int]) -> None:
        """Create the layers.

        Args:
            relative: number of channels of a neighbour's position relative to its centroid (3; 4 with time).
            features: number of feature channels of a point; 0 for none.
            widths: output channels of the layers.
        """
        super().__init__()
        self.relative = relative
        self.first = Layer(relative + features, widths[0])
        self.rest = shared_layers(widths[0], widths[1:])

    def forward(self, relative: Tensor, features: Tensor | None, index: Tensor) -> Tensor:
        """Map [B, M, K, relative], [B, N, features] or None, and indices [B, M, K] to [B, M, widths[-1]]."""
        linear = self.first.linear
        first = functional.linear(relative, linear.weight[:, : self.relative], linear.bias)
        if features is not None:
            # the first layer's product with a point's features is the same in all groups that contain the point, so it is
            # computed before the grouping, which saves most of its cost
            first = first + gather_points(functional.linear(features, linear.weight[:, self.relative :]), index)
        return highest(self.rest(self.first.activate(first)))


class GlobalAbstraction(nn.Module):
    """The last set abstraction, with all points as one group around the origin."""

    def __init__(self, features: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.layers = shared_layers(3 + features, widths)

    def forward(self, points: Tensor, features: Tensor) -> Tensor:
        """Map [B, N, 3] and [B, N, features] to [B, widths[-1]]."""
        return highest(self.layers(torch.cat([points, features], dim=-1)))


class Head(nn.Sequential):
    """Fully connected layers of 512 and 256 channels, then the outputs: [B, inputs] -> [B, outputs]."""

    def __init__(self, inputs: int, outputs: int, *, dropout: Sequence[float]) -> None:
        """Create the layers.

        Args:
            dropout: rate after each of the two hidden layers.
        """
        parts: list[nn.Module] = []
        for (a, b), rate in zip(((inputs, 512), (512, 256)), dropout, strict=True):
            parts += [Layer(a, b), nn.Dropout(rate)]  # also at rate 0, so that names of weights do not change
        super().__init__(*parts, nn.Linear(256, outputs))


def thinned(counts: Sequence[int], density: float) -> tuple[int, ...]:
    """Scale published numbers of centroids or neighbours by a fraction; at least four each."""
    return tuple(max(4, round(density * count)) for count in counts)
