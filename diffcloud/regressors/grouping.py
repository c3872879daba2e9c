"""Choice of centroids and their neighbours in point clouds, for PointNet++ and MeteorNet.

Everything is plain batched torch. Dtype and device follow the inputs, and indices have no gradient. Both original
implementations take the first points inside a ball in the order of the cloud. This is a random choice only if the order
is random. `order="nearest"` takes the nearest points instead, so the result does not depend on the order. If a ball has
too few points, its first one is repeated, which does not affect the maximum over the group.

Sources: Qi et al. 2017, "PointNet++", section 3.2; Liu et al. 2019, "MeteorNet", section 3.2 (direct grouping).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from diffcloud.errors import ConfigError

Order = Literal["cloud", "nearest"]
"""Points of a ball that form its group: the first ones in the cloud's order, or the nearest ones."""
_CHUNK_BYTES = 256 * 2**20


def gather_points(values: Tensor, index: Tensor) -> Tensor:
    """Gather values [B, N, C] at indices [B, ...] to [B, ..., C]; differentiable."""
    batch, points, channels = values.shape
    first = torch.arange(batch, device=values.device).view(-1, *[1] * (index.dim() - 1)) * points
    # index_select on joined clouds has the fastest backward pass of the equivalents on a CPU
    return values.reshape(-1, channels).index_select(0, (index + first).flatten()).view(*index.shape, channels)


@torch.no_grad()
def canonical_start(points: Tensor) -> Tensor:
    """Return the index [B] of the point farthest from the centre of the bounding box of points [B, N, 3]. Ties are
    resolved by the largest x, then y, then z. Unlike the mean, the box does not depend on the order of the points, not
    even in the last bits."""
    middle = 0.5 * (points.amin(1, keepdim=True) + points.amax(1, keepdim=True))
    distance = (points - middle).square().sum(-1, keepdim=True)
    candidate = torch.ones_like(distance[..., 0], dtype=torch.bool)
    for key in torch.cat([distance, points], dim=-1).unbind(-1):  # four keys
        among = key.masked_fill(~candidate, -torch.inf)
        candidate = among == among.amax(1, keepdim=True)
    return candidate.int().argmax(1)


@torch.no_grad()
def farthest_points(points: Tensor, count: int) -> Tensor:
    """Return the indices [B, M] of farthest point sampling: each next point is the one farthest from those already
    chosen. The first is `canonical_start`. Ties depend on the device.

    Args:
        points: [B, N, 3].
        count: M, at most N.

    Raises:
        ConfigError: more points are requested than there are.
    """
    available = points.shape[1]
    if not 1 <= count <= available:
        raise ConfigError(f"{count} centroids cannot be taken from clouds of {available} points; sample more points.")
    x, y, z = points.movedim(-1, 0).contiguous()
    last = canonical_start(points)[:, None]
    chosen = [last]
    nearest = torch.full_like(x, torch.inf)
    distance, along = torch.empty_like(x), torch.empty_like(x)  # reused buffers
    for _ in range(count - 1):  # each centroid depends on the one before
        torch.sub(x, x.gather(1, last), out=distance).square_()
        distance.addcmul_(torch.sub(y, y.gather(1, last), out=along), along)
        distance.addcmul_(torch.sub(z, z.gather(1, last), out=along), along)
        torch.minimum(nearest, distance, out=nearest)
        last = nearest.argmax(1, keepdim=True)
        chosen.append(last)
    return torch.cat(chosen, dim=1)


@torch.no_grad()
def ball_groups(
    points: Tensor, centroids: Tensor, radii: Sequence[float], counts: Sequence[int], *, order: Order
) -> list[Tensor]:
    """Return the neighbours of each centroid in several balls at once (multi-scale grouping).

    Args:
        points: [B, N, 3].
        centroids: [B, M, 3].
        radii: radius of each ball.
        counts: number of neighbours K of each ball.

    Returns:
        Indices [B, M, K] for each ball. An empty ball has the nearest point.
    """
    found = [
        [_members(squared, radius**2, count, order) for radius, count in zip(radii, counts, strict=True)]
        for squared in (squared_distances(part, points) for part in _chunks(centroids, points))
    ]
    return [torch.cat(parts, dim=1) for parts in zip(*found, strict=True)]


@torch.no_grad()
def space_time_groups(
    points: Tensor,
    times: Tensor,
    centroids: Tensor,
    centroid_times: Tensor,
    *,
    radius: float,
    growth: float,
    count: int,
    order: Order,
) -> Tensor:
    """Return the neighbours within a radius that grows linearly with the time difference (MeteorNet's direct grouping).

    A point at distance d and time difference t is inside if d <= radius (1 + growth |t|). The nearest points have the
    smallest d / (radius (1 + growth |t|)).

    Args:
        points: [B, N, 3] points of all frames.
        times: [B, N], from 0 to 1 over a sequence.
        centroids: [B, M, 3].
        centroid_times: [B, M].
        growth: relative growth of the radius over a whole sequence, e.g. 0.2.
        count: number of neighbours K.

    Returns:
        Indices [B, M, K]; an empty group has the nearest point.
    """
    found = []
    parts = zip(_chunks(centroids, points), _chunks(centroid_times, points), strict=True)
    for part, part_times in parts:
        reach = (part_times[:, :, None] - times[:, None]).abs().mul_(growth).add_(1.0).mul_(radius)
        found.append(_members(squared_distances(part, points).div_(reach.square_()), 1.0, count, order))
    return torch.cat(found, dim=1)


def squared_distances(queries: Tensor, points: Tensor) -> Tensor:
    """Return squared distances [B, M, N] of queries [B, M, 3] to points [B, N, 3]. They are computed from differences,
    which is accurate for nearby points."""
    total = torch.zeros(*queries.shape[:2], points.shape[1], dtype=points.dtype, device=points.device)
    for a, b in zip(queries.unbind(-1), points.unbind(-1), strict=True):  # three axes
        total += (a[:, :, None] - b[:, None]).square_()
    return total


def _chunks(queries: Tensor, points: Tensor) -> tuple[Tensor, ...]:
    """Split queries [B, M, ...] into parts whose distances to all points fit in bounded memory."""
    batch, count, _ = points.shape
    return queries.split(max(1, _CHUNK_BYTES // (3 * points.element_size() * batch * count)), dim=1)


def _members(squared: Tensor, limit: float, count: int, order: Order) -> Tensor:
    """Return indices [B, M, K] of points within the limit, from squared distances [B, M, N]."""
    nearest = squared.topk(min(count, squared.shape[-1]) if order == "nearest" else 1, dim=-1, largest=False)
    if order == "nearest":
        index = torch.where(nearest.values <= limit, nearest.indices, nearest.indices[..., :1])
        missing = count - index.shape[-1]
        return torch.cat([index, index[..., :1].expand(-1, -1, missing)], dim=-1) if missing else index
    inside = squared <= limit
    rank = inside.cumsum(-1)
    # ranks start at 1; points outside or beyond the count go to an extra column, which is dropped
    place = torch.where(inside & (rank <= count), rank - 1, count)
    everyone = torch.arange(squared.shape[-1], device=squared.device).expand_as(place)
    index = place.new_zeros(*place.shape[:-1], count + 1).scatter_(-1, place, everyone)[..., :count]
    first = torch.where(rank[..., -1:] > 0, index[..., :1], nearest.indices)
    return torch.where(torch.arange(count, device=squared.device) < rank[..., -1:], index, first)
