"""Deviations and weights that outliers hardly move."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_TO_DEVIATION = 1.4826
"""From the median of absolute errors to the standard deviation of normal ones."""
_TUKEY = 4.685
"""Of the residuals' standard deviation: 95 % efficient on normal noise."""


def deviation(errors: Floats) -> float:
    """Standard deviation of errors [N], from the median of their sizes."""
    return _TO_DEVIATION * float(np.median(np.abs(errors)))


def tukey(errors: Floats, sigma: float) -> Floats:
    """[N] weights 0..1 of errors with this standard deviation (Tukey's biweight)."""
    weight: Floats = np.square(1 - np.minimum(np.abs(errors) / (_TUKEY * sigma), 1.0) ** 2)
    return weight
