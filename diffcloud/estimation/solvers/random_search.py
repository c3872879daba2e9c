"""Random search, the baseline for all other solvers: independent samples, uniform on the scale of `residuals.Axis`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffcloud.estimation.joint import AnyObjective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.solvers.outcome import FitOutcome, Progress
from diffcloud.estimation.solvers.search import SearchSettings, search

_BATCH = 16
"""Samples per batch: enough for the cores of a typical machine, and few enough to stop soon below a threshold."""


@dataclass(frozen=True)
class RandomSearchSettings(SearchSettings):
    """Settings of one random search."""


def fit_random_search(
    objective: AnyObjective,
    space: FitSpace,
    settings: RandomSearchSettings,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> FitOutcome:
    """Return the best of the initial values and of random samples.

    Samples are log-uniform where the lower bound is positive. A larger budget begins with the samples of a smaller one.
    Ctrl-C ends the fit and keeps the best so far.

    Raises:
        DivergedError: every sample diverged.
        KeyboardInterrupt: interrupted before the first loss.
    """
    return search(objective, space, settings, lambda first: _Draws(len(first), settings.seed), progress=progress)


class _Draws:
    """Uniform samples in the unit box, independent of the losses."""

    converged = False

    def __init__(self, variables: int, seed: int) -> None:
        self._variables, self._generator = variables, np.random.default_rng(seed)

    def ask(self) -> NDArray[np.float64]:
        return self._generator.random((_BATCH, self._variables))

    def tell(self, losses: NDArray[np.float64]) -> None:
        pass
