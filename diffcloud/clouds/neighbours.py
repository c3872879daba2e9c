"""Nearest neighbours in a fixed target cloud."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffcloud.errors import EpisodeError

if TYPE_CHECKING:
    from diffcloud.clouds.curve import Floats, Ints
    from diffcloud.clouds.tree import Tree


_NEIGHBOURS = 12
"""Number of neighbours for the plane that gives a point's normal."""
_FEWEST = 3
"""Smallest number of points that define a plane."""
_UNCLEAR = 1e-2
"""Cross products shorter than this fraction of the squared spread of a group have no accurate direction."""
_NO_GUESS = np.empty(0, np.int64)


class NeighbourIndex:
    """Nearest-neighbour index of a target cloud. The search tree is built on first use."""

    def __init__(self, points: Tensor) -> None:
        """Check and store the cloud.

        Args:
            points: [P, 3], finite, at least one.

        Raises:
            EpisodeError: the cloud is empty, has the wrong shape, or contains NaN or infinite points.
        """
        if points.dim() != 2 or points.shape[1] != 3 or len(points) == 0:
            raise EpisodeError(f"A target cloud has shape [points, 3] with at least one point, got {list(points.shape)}.")
        if not bool(torch.isfinite(points).all()):
            raise EpisodeError("A target cloud holds NaN or infinite points; filter them before the loss.")
        self.points = points

    @cached_property
    def normals(self) -> Tensor:
        """Unit normals [P, 3] of the sampled surface, from the plane through each point's neighbours. Their signs are
        arbitrary. Zero if there are fewer than three points."""
        index = self._beside[1]
        if index.shape[1] < _FEWEST:
            return torch.zeros_like(self.points)
        return torch.from_numpy(flattest_directions(_as_array(self.points), index)).to(self.points)

    @cached_property
    def spacing(self) -> float:
        """Median distance of neighbouring points [m]; zero if there are fewer than three points."""
        distance = self._beside[0]
        return 0.0 if distance.shape[1] < _FEWEST else float(np.median(distance[:, 1]))

    @cached_property
    def from_surface(self) -> tuple[float, float]:
        """Mean squared distances [m²] from the surface to the nearest point, and from a point to the surface. Surface
        positions are points projected to the plane of their neighbours, and a point is not its own neighbour. Zero if there
        are fewer than three points."""
        index = self._beside[1]
        if index.shape[1] < _FEWEST:
            return 0.0, 0.0
        points, normals = _as_array(self.points), _as_array(self.normals)
        others = points[index[:, 1:]]
        above = ((points - others.mean(axis=1)) * normals).sum(axis=-1)
        places = points - above[:, None] * normals
        nearest = np.square(others - places[:, None]).sum(axis=-1).min(axis=1)
        return float(nearest.mean()), float(np.square(above).mean())

    @cached_property
    def _beside(self) -> tuple[Floats, Ints]:
        """Distances [P, n] to the nearest points, starting with the point itself, and their indices."""
        from scipy.spatial import cKDTree  # slow to import, and only fits need it

        points = _as_array(self.points)
        distance, index = cKDTree(points).query(points, k=range(1, min(_NEIGHBOURS + 1, len(points)) + 1))
        return distance, index

    @cached_property
    def _tree(self) -> Tree:
        from diffcloud.clouds.tree import build_tree  # numba takes a moment to import, and not every command needs it

        return build_tree(_as_array(self.points))

    def _find(self, queries: Floats, order: Ints, guesses: Ints) -> Tensor:
        from diffcloud.clouds.tree import find_nearest

        return torch.from_numpy(find_nearest(queries, order, guesses, self._tree))

    def nearest_index(self, queries: Tensor, guesses: Tensor | None = None) -> Tensor:
        """Index [...] of the nearest target point for queries [..., 3], the lowest index of equally near ones.

        Distances are computed in float64. A query that is NaN or infinite gets index 0, so its distance is NaN or infinite.

        Args:
            guesses: [...] nearest points of similar queries. They save time, but do not change the result.
        """
        from diffcloud.clouds.curve import curve_order

        flat = _as_array(queries.reshape(-1, 3))
        known = _NO_GUESS if guesses is None else guesses.reshape(-1).numpy()
        return self._find(flat, curve_order(flat), known).to(queries.device).view(queries.shape[:-1])

    def nearest(self, queries: Tensor) -> Tensor:
        """Nearest target point [..., 3] of each query [..., 3], in the queries' dtype."""
        return self.points.to(queries)[self.nearest_index(queries)]

    def nearest_to(self, other: NeighbourIndex) -> Tensor:
        """Nearest target point [P', 3] of each point of another cloud. Fast, because the other cloud's tree has sorted its
        points."""
        found = self._find(_as_array(other.points), other._tree.order, _NO_GUESS)
        return self.points.to(other.points)[found.to(other.points.device)]


def compile_neighbours() -> None:
    """Compile the kernels for queries."""
    index = NeighbourIndex(torch.zeros((1, 3), dtype=torch.float64))
    index.nearest(index.points)


def _as_array(points: Tensor) -> Floats:
    return np.ascontiguousarray(points.detach().cpu().numpy(), dtype=np.float64)


def flattest_directions(points: Floats, groups: Ints) -> Floats:
    """Unit directions [G, 3] of the smallest spread of groups [G, n] of points [P, 3]. Eigenvectors of 3 × 3 matrices in
    closed form (Smith 1961), five times as fast as a general solver. The solver is used if two spreads are almost equal,
    for example for points on a line."""
    x, y, z = (np.ascontiguousarray(column)[groups] for column in points.T)
    for part in (x, y, z):
        part -= part.mean(axis=1, keepdims=True)
    xx, xy, xz, yy, yz, zz = ((a * b).sum(axis=1) for a, b in ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z)))
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    size = np.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    angle = np.arccos(np.clip(determinant / np.maximum(2 * size**3, 1e-300), -1, 1)) / 3
    least = 2 * size * np.cos(angle + 2 * np.pi / 3)
    first, second, third = (
        np.stack(row, axis=-1) for row in ((a - least, xy, xz), (xy, b - least, yz), (xz, yz, c - least))
    )
    across = np.stack([np.cross(first, second), np.cross(first, third), np.cross(second, third)], axis=1)
    lengths = (across * across).sum(axis=-1)
    longest, every = lengths.argmax(axis=1), np.arange(len(groups))
    across, length = across[every, longest], np.sqrt(lengths[every, longest])
    unclear = ~(length > _UNCLEAR * size**2)
    found: Floats = across / np.where(unclear, 1.0, length)[:, None]
    if unclear.any():
        spread = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=-1)[unclear].reshape(-1, 3, 3)
        found[unclear] = np.linalg.eigh(spread)[1][:, :, 0]
    return found
