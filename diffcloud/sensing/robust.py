"""Robust standard deviations and weights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_TO_DEVIATION = 1.4826
"""Ratio of the standard deviation to the median absolute error, for normal errors."""
_TUKEY = 4.685
"""Cutoff of Tukey's biweight in standard deviations, with 95 % efficiency for normal noise."""


def deviation(errors: Floats) -> float:
    """Estimate the standard deviation of errors [N] from their median absolute value."""
    return _TO_DEVIATION * float(np.median(np.abs(errors)))


def tukey(errors: Floats, sigma: float) -> Floats:
    """Return Tukey biweights [N], 0 to 1, of errors with this standard deviation."""
    weight: Floats = np.square(1 - np.minimum(np.abs(errors) / (_TUKEY * sigma), 1.0) ** 2)
    return weight
