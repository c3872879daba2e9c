"""Solvers: from an objective and a space of bounded variables to the best place found. One file each."""

from __future__ import annotations

from collections.abc import Callable

from diffcloud.fit.objective import Objective
from diffcloud.fit.parameters import FitSpace
from diffcloud.fit.solvers.adam import AdamSettings, fit_adam
from diffcloud.fit.solvers.gauss_newton import GaussNewtonSettings, fit_gauss_newton
from diffcloud.fit.solvers.outcome import FitHistory, FitOutcome, Progress, StopReason

Settings = AdamSettings | GaussNewtonSettings

__all__ = [
    "AdamSettings",
    "FitHistory",
    "FitOutcome",
    "GaussNewtonSettings",
    "Progress",
    "Settings",
    "StopReason",
    "fit_adam",
    "fit_gauss_newton",
    "solve",
]


def solve(
    objective: Objective,
    space: FitSpace,
    settings: Settings,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> FitOutcome:
    """Minimise by the solver whose settings these are."""
    match settings:
        case AdamSettings():
            return fit_adam(objective, space, settings, progress=progress)
        case GaussNewtonSettings():
            return fit_gauss_newton(objective, space, settings, progress=progress)
