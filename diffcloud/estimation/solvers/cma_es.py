"""CMA-ES: a normal distribution of candidates that moves, widens and turns with the better ones (Hansen 2016, "The CMA
evolution strategy: a tutorial"), on the axis of `residuals.Axis`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffcloud.estimation.joint import AnyObjective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.solvers.outcome import FitOutcome, Progress
from diffcloud.estimation.solvers.search import SearchSettings, search

_SPREAD = 0.3
"""First standard deviation as a part of each range, which its authors advise: 0.2 to 0.5."""
_EDGE = 1e-9
"""Part of a range by which the first mean stays off a bound."""
_DIVERGED = 1e300
"""Loss of a diverged candidate: worse than all others, and a number; CMA-ES only ranks."""


@dataclass(frozen=True)
class CmaEsSettings(SearchSettings):
    """Of one search by CMA-ES."""


def fit_cma_es(
    objective: AnyObjective,
    space: FitSpace,
    settings: CmaEsSettings,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> FitOutcome:
    """Minimise from the first parameter set, a generation at a time; the lowest candidate wins.

    Ctrl-C ends the fit and keeps the best so far.

    Raises:
        DivergedError: every candidate diverged.
        KeyboardInterrupt: interrupted before the first loss.
    """
    return search(objective, space, settings, lambda first: _Generations(first, settings.seed), progress=progress)


class _Generations:
    """The candidates of the package `cma`, with random numbers of their own: its default are numpy's global ones."""

    def __init__(self, first: NDArray[np.float64], seed: int) -> None:
        from cma import CMAEvolutionStrategy  # takes a second to import

        self._variables = len(first)
        mean = np.clip(first, _EDGE, 1 - _EDGE)
        if len(mean) < 2:
            # the covariance of one variable adapts nothing, and the package refuses it: a second one that changes nothing
            mean = np.append(mean, 0.5)
        generator = np.random.default_rng(seed)
        options = {
            "bounds": [0.0, 1.0],
            "randn": lambda *shape: generator.standard_normal(shape),
            "seed": np.nan,  # none
            "verbose": -9,
            "verb_log": 0,
        }
        self._strategy = CMAEvolutionStrategy(mean, _SPREAD, options)
        self._asked: list[NDArray[np.float64]] = []

    @property
    def converged(self) -> bool:
        return bool(self._strategy.stop())

    def ask(self) -> NDArray[np.float64]:
        self._asked = self._strategy.ask()
        return np.array(self._asked)[:, : self._variables]

    def tell(self, losses: NDArray[np.float64]) -> None:
        if not np.isfinite(losses).any():
            return  # they rank nothing, and equal losses would be taken for the end: drawn anew
        self._strategy.tell(self._asked, np.nan_to_num(losses, posinf=_DIVERGED).tolist())
