"""CMA-ES, an evolution strategy with an adapted normal distribution of candidates, in fit coordinates
(`residuals.Axis`). Source: Hansen 2016, "The CMA evolution strategy: a tutorial"."""

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
"""Initial standard deviation as a fraction of each range; Hansen recommends 0.2 to 0.5."""
_EDGE = 1e-9
"""Minimum distance of the initial mean from a bound, as a fraction of the range."""
_DIVERGED = 1e300
"""Loss of a diverged candidate. It must be finite and larger than all others, since CMA-ES only ranks losses."""


@dataclass(frozen=True)
class CmaEsSettings(SearchSettings):
    """Settings of one search with CMA-ES."""


def fit_cma_es(
    objective: AnyObjective,
    space: FitSpace,
    settings: CmaEsSettings,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> FitOutcome:
    """Minimise from the first parameter set, one generation at a time, and return the best candidate.

    Ctrl-C ends the fit and keeps the best result so far.

    Raises:
        DivergedError: every candidate diverged.
        KeyboardInterrupt: Ctrl-C before the first loss.
    """
    return search(objective, space, settings, lambda first: _Generations(first, settings.seed), progress=progress)


class _Generations:
    """Candidates from the package `cma`, with their own random generator instead of numpy's global one."""

    def __init__(self, first: NDArray[np.float64], seed: int) -> None:
        from cma import CMAEvolutionStrategy  # takes a second to import

        self._variables = len(first)
        mean = np.clip(first, _EDGE, 1 - _EDGE)
        if len(mean) < 2:
            # the package does not accept a single variable, so add a second one without effect
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
            return  # equal losses would look like convergence; sample again instead
        self._strategy.tell(self._asked, np.nan_to_num(losses, posinf=_DIVERGED).tolist())
