"""Edge-preserving smoothing of stereo depth.

A stereo camera measures disparity, the inverse of depth, with the same noise at all distances. Disparity of a plane is
linear in the image. So the mean of two opposite neighbours estimates a pixel without flattening a slope. Pairs whose
mean differs from the pixel by more than noise are skipped, such as those across a border. At a border, pairs are
missing on both sides, so the border does not shift.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_DEVIATIONS = 3.0


def smooth_depth(depth_m: Floats, use: NDArray[np.bool_], radius_px: int, sigma_per_m: float) -> Floats:
    """Return depth [H, W] [m] with the pixels in `use` averaged over their neighbourhood; other pixels are unchanged.

    Args:
        use: [H, W] pixels with depth that are smoothed and averaged.
        radius_px: half the side of the square neighbourhood.
        sigma_per_m: standard deviation of the inverse depth [1/m].
    """
    inverse = np.zeros_like(depth_m)
    inverse[use] = 1 / depth_m[use]
    padded, allowed = np.pad(inverse, radius_px), np.pad(use, radius_px)
    height, width = depth_m.shape
    total, count = inverse.copy(), np.ones_like(depth_m)
    # the variances of the pair's mean (1/2) and of the pixel (1) add up
    tolerance = _DEVIATIONS * np.sqrt(1.5) * sigma_per_m

    span = range(-radius_px, radius_px + 1)
    for row, column in ((r, c) for r in span for c in span if (r, c) > (0, 0)):  # one offset of each pair
        there, opposite = (
            (slice(radius_px + r, radius_px + r + height), slice(radius_px + c, radius_px + c + width))
            for r, c in ((row, column), (-row, -column))
        )
        pair = padded[there] + padded[opposite]
        good = allowed[there] & allowed[opposite] & (np.abs(0.5 * pair - inverse) <= tolerance)
        total += np.where(good, pair, 0.0)
        count += 2 * good
    return np.where(use, count / np.where(use, total, 1.0), depth_m)
