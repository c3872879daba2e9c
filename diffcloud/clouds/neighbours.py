"""Nearest neighbours in a fixed target cloud: a KD-tree on the CPU, chunked brute force on a GPU."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from diffcloud.errors import EpisodeError

_CHUNK_BYTES = 256 * 2**20


def brute_force_neighbours(queries: Tensor, targets: Tensor) -> Tensor:
    """[Q, 3], [P, 3] -> [Q] index of the nearest target; memory bounded by chunks."""
    rows = max(1, _CHUNK_BYTES // (targets.element_size() * 3 * len(targets)))
    return torch.cat([(chunk[:, None] - targets).square().sum(-1).argmin(1) for chunk in queries.detach().split(rows)])


class NeighbourIndex:
    """A target cloud that answers nearest-neighbour queries. Its search structure is built once, on first use."""

    def __init__(self, points: Tensor) -> None:
        """
        Args:
            points: [P, 3], finite, at least one.

        Raises:
            EpisodeError: an empty cloud, a wrong shape, or NaN/Inf points.
        """
        if points.dim() != 2 or points.shape[1] != 3 or len(points) == 0:
            raise EpisodeError(f"A target cloud has shape [points, 3] with at least one point, got {list(points.shape)}.")
        if not bool(torch.isfinite(points).all()):
            raise EpisodeError("A target cloud holds NaN or infinite points; filter them before the loss.")
        self.points = points

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points.detach().cpu().numpy())

    def nearest_index(self, queries: Tensor) -> Tensor:
        """[..., 3] -> [...] index of the nearest target point."""
        flat = queries.detach().reshape(-1, 3)
        if flat.device.type == "cpu":
            # one worker: for a few thousand queries starting threads costs more than it gains
            workers = 1 if len(flat) < 20_000 else -1
            _, index = self._tree.query(flat.numpy(), workers=workers)
            # a query that is NaN or infinite has no neighbour: the loss is then NaN by itself
            found = torch.as_tensor(np.minimum(index, len(self.points) - 1))
        else:
            found = brute_force_neighbours(flat, self.points.to(flat))
        return found.view(queries.shape[:-1])

    def nearest(self, queries: Tensor) -> Tensor:
        """[..., 3] -> [..., 3]: the nearest target point of each query, in the queries' dtype."""
        return self.points.to(queries)[self.nearest_index(queries)]
