"""Smoothing of stereo depth that keeps borders where they are.

What a stereo camera measures is disparity, the inverse of depth, with the same noise at all distances; along a plane it is
linear in the image. So the mean of a pixel's two opposite neighbours estimates the pixel without flattening a slope. Pairs
whose mean is farther from the pixel than noise explains, such as those across a border, do not count. At a border the
pairs that would reach over it are missing on both sides; nothing is pulled inwards.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_DEVIATIONS = 3.0


def smooth_depth(depth_m: Floats, use: NDArray[np.bool_], radius_px: int, sigma_per_m: float) -> Floats:
    """Depth [H, W] [m] with the pixels in `use` averaged over their surroundings; the others are unchanged.

    Args:
        use: [H, W] pixels that are smoothed, and that smooth; they have depth.
        radius_px: half the side of the square of neighbours.
        sigma_per_m: standard deviation of the inverse depth [1/m].
    """
    inverse = np.zeros_like(depth_m)
    inverse[use] = 1 / depth_m[use]
    padded, allowed = np.pad(inverse, radius_px), np.pad(use, radius_px)
    height, width = depth_m.shape
    total, count = inverse.copy(), np.ones_like(depth_m)
    # a pair's mean has half the variance of one pixel; it is compared with one
    tolerance = _DEVIATIONS * np.sqrt(1.5) * sigma_per_m

    span = range(-radius_px, radius_px + 1)
    for row, column in ((r, c) for r in span for c in span if (r, c) > (0, 0)):  # half the square: one of each pair
        there, opposite = (
            (slice(radius_px + r, radius_px + r + height), slice(radius_px + c, radius_px + c + width))
            for r, c in ((row, column), (-row, -column))
        )
        pair = padded[there] + padded[opposite]
        good = allowed[there] & allowed[opposite] & (np.abs(0.5 * pair - inverse) <= tolerance)
        total += np.where(good, pair, 0.0)
        count += 2 * good
    return np.where(use, count / np.where(use, total, 1.0), depth_m)
