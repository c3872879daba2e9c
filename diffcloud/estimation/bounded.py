"""Minimisation of quadratic functions between bounds."""

from __future__ import annotations

import torch
from torch import Tensor

_LEAST_SPREAD = 1e-12
"""Smallest allowed ratio of an eigenvalue to the largest one."""


def lowest_within(matrix: Tensor, slope: Tensor, least: Tensor, most: Tensor) -> Tensor:
    """Return the minimiser [k] of slope · s + s · matrix s / 2 between `least` and `most` [k]. `matrix` [k, k] must be
    positive semidefinite."""
    from scipy.optimize import lsq_linear  # slow to import

    spread, axes = torch.linalg.eigh(matrix)
    root = spread.clamp(min=_LEAST_SPREAD * float(spread[-1])).sqrt()
    found = lsq_linear(
        (root * axes).T.numpy(), (-(axes.T @ slope) / root).numpy(), (least.numpy(), most.numpy()), method="bvls"
    )
    return torch.from_numpy(found.x)
