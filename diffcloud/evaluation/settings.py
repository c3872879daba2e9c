"""Settings of the comparison of methods. Reading them imports no simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from diffcloud.estimation.settings import IDENTIFIED_FACTOR, LEVEL

Baseline = Literal["single_start", "middle", "random_search", "cma_es"]
"""Baselines that the comparison runs itself."""
BASELINES: tuple[Baseline, ...] = ("single_start", "middle", "random_search", "cma_es")


@dataclass(frozen=True)
class ComparisonSettings:
    """Settings of `compare_episode`."""

    baselines: Sequence[Baseline] = BASELINES
    draws: int = 4
    """Number of new point samples over which losses are averaged."""
    seed: int = 1000
    """Seed of the first sample, and of the searches."""
    level: float | None = LEVEL
    """Probability of the intervals; None: no intervals."""
    within: float = IDENTIFIED_FACTOR
    """Factor within which a parameter counts as identified."""
    landscape_size: int = 0
    """Number of points along each axis of the loss landscape; 0: none."""
