"""Methods that name the parameters of an episode, on equal terms.

Each gives one parameter set: the fit, a network's prediction, or a baseline without gradients or learning. Baselines that
search are the solvers of `estimation.solvers`; they see the objective that the fit sees (frames, points, common random
numbers, bounds), may simulate as often as the fit (as one start of it, where that was Adam's), and stop below the same
threshold.
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

Baseline = Literal["single_start", "middle", "random_search", "cma_es"]
"""What the comparison can run by itself."""
Phase = Literal["dataset", "training", "inference", "optimisation"]
PHASES: tuple[Phase, ...] = ("dataset", "training", "inference", "optimisation")


@dataclass(frozen=True)
class Estimate:
    """What one method says of one episode."""

    method: str
    values: Mapping[str, float]
    """As told by the method; may lie outside the bounds."""
    simulations: int = 0
    """Runs of the simulator spent on this episode."""
    gradients: bool = False
    """Whether each of these runs was differentiated too, which costs two to three times as much."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Phase -> wall time, of those that are known; data set and training serve all episodes of a scenario."""
    intervals: Mapping[str, tuple[float, float]] | None = None
    """Of a method that tells a posterior."""


@dataclass(frozen=True)
class Gap:
    """A method that says nothing of an episode."""

    method: str
    reason: str
    expected: bool = True
    """Whether it should have: then the comparison is incomplete."""


def space_of(fit: FitRecord) -> FitSpace:
    """The free parameters of a fit with their bounds and priors, and those that were given."""
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
    """The fit itself, of one of its recordings, with its share of what all of them took."""
    return Estimate(
        "diffcloud",
        of_recording(fit.simulated, recording),
        simulations=simulations_each(fit),
        gradients=not issubclass(SOLVERS[fit.solver], SearchSettings),
        seconds={} if fit.seconds is None else {"optimisation": fit.seconds / len(fit.episodes)},
    )


def simulations_each(fit: FitRecord) -> int:
    """That a fit took for each of its recordings."""
    return math.ceil(fit.simulations / len(fit.episodes))


def middle(space: FitSpace) -> Estimate:
    """The middle of each range on the paper's linear scale: what no learning and no search gives."""
    return Estimate("middle", {variable.name: 0.5 * (variable.low + variable.high) for variable in space.asked.variables})


def single_start(objective: Objective, space: FitSpace, settings: AdamSettings) -> Estimate:
    """The paper's own setting: Adam from the middle, plain gradient, one start."""
    found = fit_adam(objective, space, replace(settings, starts=1, smoothing=0.0, init={}))
    return _estimate("single_start", found, gradients=True)


def first_start(fit: FitRecord, space: FitSpace) -> Estimate | None:
    """What the paper's setting gives, if it is a part of the fit: its first start, from the middle with plain gradients.

    Starts do not touch one another, so it need not be run again. Its own wall time is not known then. None if the fit was
    smoothed, began elsewhere, was stopped by another start, or changed its points, or if another solver made it.
    """
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
    """A baseline without gradients: the solver that a fit can have too, under its name.

    Raises:
        DivergedError: every candidate diverged.
    """
    return _estimate(SOLVER_NAMES[type(settings)], solve(objective, space, settings), gradients=False)


def _estimate(method: str, found: FitOutcome, *, gradients: bool) -> Estimate:
    found = found.uninterrupted()  # half a search is no method; the fit itself keeps its best so far
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
    """A network's prediction."""
    return Estimate(method, dict(values), seconds=seconds, intervals=intervals)


def published(meta: Mapping[str, Any]) -> list[Estimate]:
    """Predictions that came with a published episode."""
    return [Estimate(f"published_{model}", dict(pair)) for model, pair in (meta.get("predictions") or {}).items()]


def clipped(values: Mapping[str, float], space: FitSpace) -> dict[str, float]:
    """Values within the bounds, with the given ones in place; what a method leaves out is the middle, or what is known of
    uncertain material."""
    found = {**middle(space).values, **space.asked.fixed}
    for variable in space.variables:
        value = float(values.get(variable.name, found[variable.name]))
        found[variable.name] = min(max(value, variable.low), variable.high)
    return found
