"""Filters for a merged cloud: crop, outlier removal, downsampling."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from diffcloud.errors import EpisodeError
from diffcloud.io.clouds import import_open3d
from diffcloud.io.episodes import Episode
from diffcloud.sensing.cameras import transform

Downsampling = Literal["random", "voxel", "farthest"]
"""`random`: random points. `voxel`: the most central point of each voxel. `farthest`: farthest-point sampling."""

_BISECTIONS = 20


@dataclass(frozen=True)
class FilterReport:
    """Number of points after each filter."""

    recorded: int
    cropped: int
    inliers: int
    kept: int


def clean_frame(
    points: NDArray[np.float32],
    *,
    crop: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None,
    neighbours: int = 20,
    deviations: float = 2.0,
    radius_m: float | None = None,
    radius_neighbours: int = 4,
    limit: int | None = None,
    downsampling: Downsampling = "random",
    rng: np.random.Generator,
) -> tuple[NDArray[np.int64], FilterReport]:
    """Return the indices of the points of one frame that pass all filters.

    Args:
        points: [N, 3].
        crop: lowest and highest corner of a box.
        neighbours, deviations: a point is an outlier if its mean distance to this many neighbours exceeds the mean over
            the cloud by this many standard deviations (PCL's StatisticalOutlierRemoval); 0 neighbours: off.
        radius_m, radius_neighbours: a point is an outlier if fewer than this many others are within the radius; None:
            off.
        limit: maximum number of points to keep.
        downsampling: method to choose them.

    Raises:
        EpisodeError: no point is left; names the filter.
    """
    keep = np.arange(len(points))
    if crop is not None:
        low, high = np.array(crop[0]), np.array(crop[1])
        keep = keep[((points >= low) & (points <= high)).all(axis=1)]
        if not len(keep):
            raise EpisodeError(
                f"No point lies in the crop box {crop}; the cloud spans {_span(points)}. Check frame and unit."
            )
    cropped = len(keep)
    if neighbours > 0 and len(keep) > neighbours:
        distance, _ = cKDTree(points[keep]).query(points[keep], k=neighbours + 1)
        mean = distance[:, 1:].mean(axis=1)
        keep = keep[mean <= mean.mean() + deviations * mean.std()]
    if radius_m is not None:
        around = cKDTree(points[keep]).query_ball_point(points[keep], radius_m, return_length=True)
        keep = keep[around > radius_neighbours]  # a point is in its own ball
        if not len(keep):
            raise EpisodeError(
                f"No point has {radius_neighbours} others within {radius_m:g}: the cloud is sparser. Widen the radius."
            )
    inliers = len(keep)
    if limit is not None and len(keep) > limit:
        keep = np.sort(keep[thin(points[keep], limit, downsampling, rng)])
    return keep, FilterReport(len(points), cropped, inliers, len(keep))


def thin(
    points: NDArray[np.float32], limit: int, downsampling: Downsampling, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Return the indices of at most `limit` different points of [N, 3]; `voxel` may keep fewer."""
    if downsampling == "random":
        return rng.choice(len(points), limit, replace=False)
    if downsampling == "farthest":
        open3d = import_open3d()
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
        kept = np.asarray(cloud.farthest_point_down_sample(limit).points)
        return np.unique(cKDTree(points.astype(np.float64)).query(kept)[1])
    small, large = 0.0, float(np.ptp(points, axis=0).max()) * 1.01 + 1e-9  # one voxel holds all
    chosen = np.zeros(1, dtype=np.int64)
    for _ in range(_BISECTIONS):  # find the smallest voxel size that keeps at most `limit`
        size = 0.5 * (small + large)
        candidate = _one_per_voxel(points, size)
        if len(candidate) > limit:
            small = size
        else:
            large, chosen = size, candidate
    return chosen


def in_large_clusters(points: NDArray[np.floating[Any]], gap: float, least_part: float) -> NDArray[np.bool_]:
    """Return which points belong to a cluster with at least `least_part` of the largest cluster's points, bool [N].
    Points in adjacent voxels of side `gap`, also diagonally, belong to one cluster, so clusters are at least `gap`
    apart. Points have three coordinates, or time as a fourth one."""
    if not len(points):
        return np.zeros(0, dtype=bool)
    cell = np.floor(points / gap).astype(np.int64)
    voxels, place = np.unique(cell, axis=0, return_inverse=True)
    pairs = cKDTree(voxels).query_pairs(1.8, output_type="ndarray")  # between 3 ** 0.5 and 2
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(voxels), len(voxels)))
    _, label = connected_components(graph, directed=False)
    cluster = label[place.reshape(-1)]
    size = np.bincount(cluster)
    kept: NDArray[np.bool_] = size[cluster] >= least_part * size.max()
    return kept


def transformed(episode: Episode, matrix: NDArray[np.float64]) -> Episode:
    """Apply a rigid transform [4, 4] to the clouds of an episode, but not to grippers and viewpoints."""
    points = transform(matrix, episode.points.astype(np.float64))
    return replace(episode, points=points.astype(np.float32))


def cropped(episode: Episode, low: NDArray[np.float64], high: NDArray[np.float64]) -> Episode:
    """Remove the points outside a box with these corners [3].

    Raises:
        EpisodeError: a frame has no points in the box.
    """
    kept = np.all((episode.points >= low) & (episode.points <= high), axis=1)
    counts = np.add.reduceat(kept, episode.offsets[:-1], dtype=np.int64)
    if len(empty := np.flatnonzero(counts == 0)):
        raise EpisodeError(
            f"{len(empty)} of {len(counts)} frames have no points in the box from {low.tolist()} to {high.tolist()} m. "
            f"The first one is frame {empty[0]}. Its points span {_span(episode.frame(int(empty[0])))} m."
        )
    return episode.select(kept)


def without_strays(episode: Episode, gap: float) -> Episode:
    """Remove clusters that are never connected with the cloth, such as parts of robot and background.

    Clusters are those of `in_large_clusters` in space and time: points of neighbouring frames are connected like points
    of one frame. The largest cluster is the cloth. So a corner of the cloth that is only connected with the rest in a
    later frame is kept. A frame without points of the largest cluster keeps all its points.

    Args:
        gap: minimum distance between clusters, in the episode's length unit.

    Returns:
        An episode. `quality` in its meta has `strays`, the number of removed points in each frame.
    """
    frame = np.repeat(np.arange(episode.frame_count), np.diff(episode.offsets))
    kept = in_large_clusters(np.column_stack([episode.points, gap * (frame + 0.5)]), gap, 1.0)
    seen = np.bincount(frame, weights=kept) > 0
    kept |= ~seen[frame]
    strays = np.bincount(frame[~kept], minlength=episode.frame_count).tolist()
    quality = {**episode.meta.get("quality", {}), "strays": strays}
    return replace(episode.select(kept), meta={**episode.meta, "quality": quality})


def _one_per_voxel(points: NDArray[np.float32], size: float) -> NDArray[np.int64]:
    """Return the index of the point nearest the centre of each occupied voxel."""
    place = (points.astype(np.float64) - points.min(axis=0)) / size
    cell = np.floor(place).astype(np.int64)
    off = np.square(place - cell - 0.5).sum(axis=1)
    order = np.lexsort((off, cell[:, 2], cell[:, 1], cell[:, 0]))
    first = np.ones(len(order), dtype=bool)
    first[1:] = (np.diff(cell[order], axis=0) != 0).any(axis=1)
    return order[first]


def _span(points: NDArray[np.float32]) -> str:
    return f"{points.min(axis=0).round(3).tolist()} to {points.max(axis=0).round(3).tolist()}"
