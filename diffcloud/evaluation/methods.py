"""Methods that name the parameters of an episode, on equal terms.

Each gives one parameter set: a gradient fit, a network's prediction, or a rival without gradients or learning. Rivals that
search see the objective that the fit sees (frames, points, common random numbers, bounds), may simulate as often as the fit
(as one start of it, where that was Adam's), and stop below the same threshold.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch

from diffcloud.errors import DivergedError
from diffcloud.fit import AdamSettings, FitSpace, Objective, fit_adam
from diffcloud.fit.batches import batch_losses
from diffcloud.fit.parameters import NUISANCE, Variable

Rival = Literal["single_start", "middle", "random_search", "cma_es"]
"""What the comparison can run by itself."""
Phase = Literal["dataset", "training", "inference", "optimisation"]
PHASES: tuple[Phase, ...] = ("dataset", "training", "inference", "optimisation")
_EDGE = 1e-9
_SPREAD = 0.3
"""First standard deviation of CMA-ES as a part of each logarithmic range, which its authors advise: 0.2 to 0.5."""


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


@dataclass(frozen=True)
class Gap:
    """A method that says nothing of an episode."""

    method: str
    reason: str
    expected: bool = True
    """Whether it should have: then the comparison is incomplete."""


def space_of(summary: Mapping[str, Any]) -> FitSpace:
    """The fitted parameters of a fit with their bounds, and those that were given.

    A rigid offset of the target that was fitted along counts as given: it belongs to the recording, and all methods are
    measured against the same clouds.
    """
    entries = summary["parameters"]
    free = {name: entry["bounds"] for name, entry in entries.items() if not entry["fixed"] and name not in NUISANCE}
    return FitSpace(
        tuple(Variable(name, float(low), float(high)) for name, (low, high) in free.items()),
        {name: float(entry["value"]) for name, entry in entries.items() if name not in free},
    )


def fitted(summary: Mapping[str, Any]) -> Estimate:
    """The gradient fit itself, as `fit.result.read_fit` has it."""
    return Estimate(
        "diffcloud",
        {name: float(entry["value"]) for name, entry in summary["parameters"].items()},
        simulations=int(summary["evaluations"]),
        gradients=True,
        seconds={"optimisation": float(summary["seconds"])},
    )


def middle(space: FitSpace) -> Estimate:
    """The middle of each range on the paper's linear scale: what no learning and no search gives."""
    return Estimate("middle", {variable.name: 0.5 * (variable.low + variable.high) for variable in space.variables})


def single_start(objective: Objective, space: FitSpace, settings: AdamSettings) -> Estimate:
    """The paper's own setting: Adam from the middle, plain gradient, one start."""
    found = fit_adam(objective, space, replace(settings, starts=1, smoothing=0.0, init={}))
    if found.stop_reason == "interrupted":
        raise KeyboardInterrupt  # half a search is no method; the fit itself keeps its best so far
    return Estimate(
        "single_start",
        found.values,
        simulations=found.evaluations,
        gradients=True,
        seconds={"optimisation": found.seconds},
    )


def first_start(summary: Mapping[str, Any], space: FitSpace) -> Estimate | None:
    """What the paper's setting gives, if it is a part of the fit: its first start, from the middle with plain gradients.

    Starts do not touch one another, so it need not be run again. Its own wall time is not known then. None if the fit was
    smoothed, began elsewhere, was stopped by another start, or changed its points, or if another solver made it.
    """
    if summary["solver"] != "adam":
        return None
    settings, history = summary["settings"], summary["history"]
    losses = [row[0] for row in history["loss"]]
    begin = dict(zip(history["names"], history["values"][0][0], strict=True))
    same = all(math.isclose(begin[name] or math.nan, value, rel_tol=1e-6) for name, value in middle(space).values.items())
    ended = summary["stop_reason"] == "iterations" and None not in losses
    if not (same and ended and set(begin) == set(space.names)) or settings["smoothing"] or settings["resample"]:
        return None
    lowest = losses.index(min(losses))
    values = dict(zip(history["names"], history["values"][lowest][0], strict=True))
    return Estimate("single_start", values, simulations=len(losses), gradients=True)


def random_search(
    objective: Objective, space: FitSpace, *, simulations: int, threshold: float = 0.0, seed: int = 0
) -> Estimate:
    """The best of independent draws, log-uniform over the box where the lower bound is positive.

    Raises:
        DivergedError: every draw diverged.
    """
    rng = np.random.default_rng(seed)
    search = _Search(objective, space, simulations, threshold)
    while search.goes_on:
        search.try_(rng.random((min(search.left, 16), len(space.variables))))
    return search.estimate("random_search")


def cma_es(objective: Objective, space: FitSpace, *, simulations: int, threshold: float = 0.0, seed: int = 0) -> Estimate:
    """Covariance matrix adaptation (Hansen 2016) from the middle, on the logarithmic scale, a generation at a time.

    Raises:
        DivergedError: every candidate diverged.
    """
    from cma import CMAEvolutionStrategy  # takes a second to import

    start = space.unbounded(space.starts(1, seed=0)[0], torch.ones(1, dtype=torch.bool))
    first = torch.sigmoid(start)[0].tolist()
    search = _Search(objective, space, simulations, threshold)
    if len(first) < 2:
        # the covariance of one variable adapts nothing, and the package refuses it: a second one that changes nothing
        first = [*first, 0.5]
    options = {"bounds": [0.0, 1.0], "seed": seed + 1, "verbose": -9, "verb_log": 0}  # a seed of 0 means the clock
    strategy = CMAEvolutionStrategy(first, _SPREAD, options)
    while search.goes_on and not strategy.stop():
        candidates = np.array(strategy.ask())
        losses = search.try_(candidates[:, : len(space.variables)])
        if len(losses) < len(candidates):
            break  # the budget ended within a generation
        # a diverged candidate is worse than all others, and a number: CMA-ES only ranks
        strategy.tell(list(candidates), np.nan_to_num(losses, posinf=1e300).tolist())
    return search.estimate("cma_es")


def predicted(method: str, values: Mapping[str, float], seconds: Mapping[str, float]) -> Estimate:
    """A network's prediction."""
    return Estimate(method, dict(values), seconds=seconds)


def published(meta: Mapping[str, Any]) -> list[Estimate]:
    """Predictions that came with a published episode."""
    return [Estimate(f"published_{model}", dict(pair)) for model, pair in (meta.get("predictions") or {}).items()]


def clipped(values: Mapping[str, float], space: FitSpace) -> dict[str, float]:
    """Values within the bounds, with the given ones in place; what a method leaves out is the middle."""
    found = {**middle(space).values, **space.fixed}
    for variable in space.variables:
        value = float(values.get(variable.name, found[variable.name]))
        found[variable.name] = min(max(value, variable.low), variable.high)
    return found


class _Search:
    """The best so far of a search in the unit box, and what is left of its budget."""

    def __init__(self, objective: Objective, space: FitSpace, simulations: int, threshold: float) -> None:
        self._objective, self._space, self._threshold = objective, space, threshold
        self._budget, self._spent = simulations, 0
        self._best, self._values = math.inf, torch.empty(0)
        self._began = time.perf_counter()

    @property
    def left(self) -> int:
        return self._budget - self._spent

    @property
    def goes_on(self) -> bool:
        return self.left > 0 and not self._best < self._threshold

    def try_(self, fractions: np.ndarray) -> np.ndarray:
        """Losses of places [b, k] in the unit box, of the first ones if the budget ends within them."""
        places = torch.as_tensor(fractions[: self.left], dtype=torch.float64).clamp(_EDGE, 1 - _EDGE)
        logarithmic = torch.ones(len(places), dtype=torch.bool)
        values = self._space.values(torch.logit(places), logarithmic).double()
        losses = batch_losses(self._objective, self._space, values)
        self._spent += len(places)
        lowest = int(losses.argmin())
        if float(losses[lowest]) < self._best:
            self._best, self._values = float(losses[lowest]), values[lowest]
        return losses.numpy()

    def estimate(self, method: str) -> Estimate:
        if not math.isfinite(self._best):
            raise DivergedError(0, [], f"all {self._spent} parameter sets of {method} diverged")
        return Estimate(
            method,
            dict(zip(self._space.names, self._values.tolist(), strict=True)),
            simulations=self._spent,
            seconds={"optimisation": time.perf_counter() - self._began},
        )
