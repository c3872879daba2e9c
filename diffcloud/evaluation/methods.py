"""Methods that estimate the parameters of an episode, under equal conditions.

Each method gives one parameter set: the fit, a network's prediction, or a baseline without gradients or training.
Baselines that search are solvers of `estimation.solvers`. They use the objective of the fit (frames, sample points,
bounds) and the same threshold. Their budget is the number of simulations of the fit, or of one start of it with Adam.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from diffcloud.estimation.initial_state import variables_of
from diffcloud.estimation.names import of_recording
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace, Variable
from diffcloud.estimation.record import FitRecord
from diffcloud.estimation.solvers import (
    SOLVER_NAMES,
    SOLVERS,
    AdamSettings,
    CmaEsSettings,
    FitOutcome,
    RandomSearchSettings,
    SearchSettings,
    fit_adam,
    solve,
)

Phase = Literal["dataset", "training", "inference", "optimisation"]
PHASES: tuple[Phase, ...] = ("dataset", "training", "inference", "optimisation")


@dataclass(frozen=True)
class Estimate:
    """Result of one method for one episode."""

    method: str
    values: Mapping[str, float]
    """Estimated values, possibly outside the bounds."""
    simulations: int = 0
    """Number of simulator runs for this episode."""
    gradients: bool = False
    """Whether each run also computed derivatives, which takes two to three times as long."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Phase -> wall time, for known phases. Data set and training are shared by all episodes of a scenario."""
    intervals: Mapping[str, tuple[float, float]] | None = None
    """Intervals, for a method with a posterior."""


@dataclass(frozen=True)
class Gap:
    """A method without a result for an episode."""

    method: str
    reason: str
    expected: bool = True
    """Whether a result was expected, so that the comparison is incomplete."""


def space_of(fit: FitRecord) -> FitSpace:
    """Return the free variables of a fit with bounds and priors, and the fixed parameters."""
    variables, fixed = [], {}
    for name, entry in fit.parameters.items():
        if entry.bounds is None or entry.centre is None:
            fixed[name] = entry.multiplier
        else:
            low, high, centre = (one / entry.nominal for one in (*entry.bounds, entry.centre))
            variables.append(Variable(name, low, high, entry.prior, centre, entry.role))
    initial_state = variables_of([one.nuisance for one in fit.episodes], length_unit_m=fit.length_unit_m)
    return FitSpace((*variables, *initial_state), fixed)


def fitted(fit: FitRecord, recording: int) -> Estimate:
    """Return the fit as a method for one of its recordings, with its share of the total cost."""
    return Estimate(
        "diffcloud",
        of_recording(fit.simulated, recording),
        simulations=simulations_each(fit),
        gradients=not issubclass(SOLVERS[fit.solver], SearchSettings),
        seconds={} if fit.seconds is None else {"optimisation": fit.seconds / len(fit.episodes)},
    )


def simulations_each(fit: FitRecord) -> int:
    """Return the number of simulations per recording of a fit."""
    return math.ceil(fit.simulations / len(fit.episodes))


def middle(space: FitSpace) -> Estimate:
    """Return the mid-range baseline: the centre of each range on the paper's linear scale."""
    return Estimate("middle", {variable.name: 0.5 * (variable.low + variable.high) for variable in space.asked.variables})


def single_start(objective: Objective, space: FitSpace, settings: AdamSettings) -> Estimate:
    """Run the paper's own setting: Adam with plain gradients from the mid-range, one start."""
    found = fit_adam(objective, space, replace(settings, starts=1, smoothing=0.0, init={}))
    return _estimate("single_start", found, gradients=True)


def first_start(fit: FitRecord, space: FitSpace) -> Estimate | None:
    """Return the result of the paper's setting if it is part of the fit: its first start, from the mid-range. Starts
    are independent, so it need not be run again, but its wall time is unknown. None if another solver was used, the fit
    was smoothed or resampled, began elsewhere, or was stopped by another start."""
    if fit.solver != "adam":
        return None
    settings, history = fit.settings, fit.history
    losses = [row[0] for row in history.loss if row[0] is not None]
    begin = dict(zip(history.names, history.values[0][0], strict=True))
    same = all(math.isclose(begin[name] or math.nan, value, rel_tol=1e-6) for name, value in middle(space).values.items())
    ended = fit.stop_reason == "iterations" and len(losses) == len(history.loss)
    if not (same and ended and set(begin) == set(space.names)) or settings["smoothing"] or settings["resample"]:
        return None
    lowest = losses.index(min(losses))
    ended_at = zip(history.names, history.values[lowest][0], strict=True)
    values = {name: value for name, value in ended_at if value is not None}
    return Estimate("single_start", values, simulations=len(losses), gradients=True)


def searched(objective: Objective, space: FitSpace, settings: CmaEsSettings | RandomSearchSettings) -> Estimate:
    """Run a baseline without gradients.

    Raises:
        DivergedError: every candidate diverged.
    """
    return _estimate(SOLVER_NAMES[type(settings)], solve(objective, space, settings), gradients=False)


def _estimate(method: str, found: FitOutcome, *, gradients: bool) -> Estimate:
    found = found.uninterrupted()  # an interrupted search is not a valid baseline
    return Estimate(
        method,
        found.values,
        simulations=found.simulations,
        gradients=gradients,
        seconds={"optimisation": found.seconds},
    )


def predicted(
    method: str,
    values: Mapping[str, float],
    seconds: Mapping[str, float],
    intervals: Mapping[str, tuple[float, float]] | None = None,
) -> Estimate:
    """Return a network's prediction."""
    return Estimate(method, dict(values), seconds=seconds, intervals=intervals)


def published(meta: Mapping[str, Any]) -> list[Estimate]:
    """Return the predictions stored with a published episode."""
    return [Estimate(f"published_{model}", dict(pair)) for model, pair in (meta.get("predictions") or {}).items()]


def clipped(values: Mapping[str, float], space: FitSpace) -> dict[str, float]:
    """Return values clipped to the bounds, with the fixed parameters. Missing values are mid-range, or the prior's
    centre for uncertain material."""
    found = {**middle(space).values, **space.asked.fixed}
    for variable in space.variables:
        value = float(values.get(variable.name, found[variable.name]))
        found[variable.name] = min(max(value, variable.low), variable.high)
    return found
