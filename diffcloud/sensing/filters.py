"""Cleaning a merged cloud: crop, statistical outliers, even thinning."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from diffcloud.errors import EpisodeError


@dataclass(frozen=True)
class FilterReport:
    """How many points each filter left."""

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
    limit: int | None = None,
    rng: np.random.Generator,
) -> tuple[NDArray[np.int64], FilterReport]:
    """Indices of the points of one frame to keep.

    Args:
        points: [N, 3].
        crop: lowest and highest corner of a box.
        neighbours, deviations: a point is an outlier if its mean distance to this many neighbours exceeds the mean over
            the cloud by this many standard deviations (the rule of PCL's StatisticalOutlierRemoval); 0 neighbours: off.
        limit: keep at most this many points, drawn at random without repetition.

    Raises:
        EpisodeError: nothing is left; says after which filter.
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
    inliers = len(keep)
    if limit is not None and len(keep) > limit:
        keep = np.sort(rng.choice(keep, limit, replace=False))
    return keep, FilterReport(len(points), cropped, inliers, len(keep))


def _span(points: NDArray[np.float32]) -> str:
    return f"{points.min(axis=0).round(3).tolist()} to {points.max(axis=0).round(3).tolist()}"
