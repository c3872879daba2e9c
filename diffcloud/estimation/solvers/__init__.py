"""Solvers: minimise an objective over bounded variables. Each solver has its own file.

`likelihood` estimates parameters and their uncertainty. `adam` descends along the gradient of the loss, as in the
paper. `cma_es` and `random_search` are searches without derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from diffcloud.estimation.joint import AnyObjective
from diffcloud.estimation.likelihood import LikelihoodSettings
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.solvers.adam import AdamSettings, fit_adam
from diffcloud.estimation.solvers.cma_es import CmaEsSettings, fit_cma_es
from diffcloud.estimation.solvers.likelihood import fit_likelihood
from diffcloud.estimation.solvers.outcome import FitHistory, FitOutcome, Progress, StopReason
from diffcloud.estimation.solvers.random_search import RandomSearchSettings, fit_random_search
from diffcloud.estimation.solvers.search import SearchSettings

Settings = LikelihoodSettings | AdamSettings | CmaEsSettings | RandomSearchSettings

SOLVERS: Mapping[str, type[Settings]] = {
    "likelihood": LikelihoodSettings,
    "adam": AdamSettings,
    "cma_es": CmaEsSettings,
    "random_search": RandomSearchSettings,
}
"""Name of a solver -> type of its settings."""
SOLVER_NAMES: Mapping[type[Settings], str] = {kind: name for name, kind in SOLVERS.items()}
"""Type of the settings -> name of the solver."""

__all__ = [
    "SOLVERS",
    "SOLVER_NAMES",
    "AdamSettings",
    "CmaEsSettings",
    "FitHistory",
    "FitOutcome",
    "LikelihoodSettings",
    "Progress",
    "RandomSearchSettings",
    "SearchSettings",
    "Settings",
    "StopReason",
    "fit_adam",
    "fit_cma_es",
    "fit_likelihood",
    "fit_random_search",
    "solve",
]


def solve(
    objective: AnyObjective,
    space: FitSpace,
    settings: Settings,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> FitOutcome:
    """Minimise with the solver to which the settings belong.

    Ctrl-C ends the fit and keeps the best result so far.

    Raises:
        DivergedError: every start, or every candidate of a search, diverged.
        KeyboardInterrupt: Ctrl-C before the first loss.
    """
    match settings:
        case LikelihoodSettings():
            return fit_likelihood(objective, space, settings, progress=progress)
        case AdamSettings():
            return fit_adam(objective, space, settings, progress=progress)
        case CmaEsSettings():
            return fit_cma_es(objective, space, settings, progress=progress)
        case RandomSearchSettings():
            return fit_random_search(objective, space, settings, progress=progress)
