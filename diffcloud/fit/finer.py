"""A fit that goes on with half the edge length and half the step, where the scenario's own cannot explain the recordings.

Cloth of large faces is too stiff: it can neither fold nor wrinkle within a face, and the fitted material makes up for that.
Of recordings whose cloth had half the edge length, the scenario's mesh leaves 5 to 40 times the loss of their noise, with
a stretch that is off by factors of 1.2 to 8. From there, descents with half the edge length find it within a few per cent.
Steps are halved too: with the coarse ones, the loss of a fold on the finer mesh is lowest beside the truth, not at it.
Where the scenario's own mesh explains the recordings, they say nothing about finer ones, and the fit ends.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice

import torch
from torch import Tensor

from diffcloud.errors import DivergedError
from diffcloud.fit.batches import batch_losses
from diffcloud.fit.joint import AnyObjective
from diffcloud.fit.parameters import FitSpace
from diffcloud.fit.residuals import Axis
from diffcloud.fit.solvers import FitOutcome, GaussNewtonSettings, Progress, Settings, fit_gauss_newton, solve
from diffcloud.fit.solvers.gauss_newton import EQUALLY

_CLEARLY = 0.9
"""Times the former loss, below which a finer mesh is worth what its simulations cost."""
_FOLLOWED = 3
"""Ends of the coarse fit from which descents on a finer mesh begin: its lowest one need not lead to the lowest there."""
_APART = 0.1
"""On the axis: ends that are closer are one."""
_MOST_NODES = 3000
"""Of a cloth; a motion of more takes minutes."""


@dataclass(frozen=True)
class FinerFit:
    """A fit, and the mesh and step that it ended with."""

    objective: AnyObjective
    """With these."""
    outcome: FitOutcome
    halvings: int
    """How often edges and step were halved."""
    finer_loss: float | None = None
    """With priors, after one more halving, which was tried and hardly lowers it."""


def solve_and_refine(
    objective: AnyObjective,
    space: FitSpace,
    settings: Settings,
    *,
    halvings: int,
    progress: Callable[[int, Progress], None] | None = None,
) -> FinerFit:
    """Minimise; while the recordings are not explained, halve edges and step and go on by Gauss–Newton from the places that
    the starts have reached. A finer mesh is kept if it lowers the loss clearly. Ctrl-C ends the fit and keeps the best so
    far.

    Args:
        settings: of the solver; no other than Gauss–Newton goes on.
        halvings: as often at most; never where it is not known what one of the recordings misses of the cloth, and thus how
            high a loss of a right motion may be.
        progress: takes how often edges and step have been halved, too.

    Raises:
        DivergedError, KeyboardInterrupt: as of `solve`.
    """
    told = [None if progress is None else partial(progress, done) for done in range(halvings + 1)]
    found = FinerFit(objective, solve(objective, space, settings, progress=told[0]), 0)
    while found.halvings < halvings and isinstance(settings, GaussNewtonSettings) and _asks_for_more(found):
        try:
            finer = found.objective.halved()
            outcome = _gone_on(finer, space, settings, found.outcome, told[found.halvings + 1])
        except KeyboardInterrupt:
            return replace(found, outcome=replace(found.outcome, stop_reason="interrupted"))
        if outcome.loss > _CLEARLY * found.outcome.loss:
            return _without(found, outcome)
        found = FinerFit(finer, outcome, found.halvings + 1)
    return found


def _asks_for_more(found: FinerFit) -> bool:
    nodes = max(4 * len(member.scenario.scene.mesh.nodes) for member in found.objective.members)  # about
    ended = found.outcome.stop_reason not in ("interrupted", "threshold")
    return ended and nodes <= _MOST_NODES and found.outcome.loss > found.objective.unexplained


def _gone_on(
    finer: AnyObjective,
    space: FitSpace,
    settings: GaussNewtonSettings,
    fitted: FitOutcome,
    progress: Callable[[Progress], None] | None,
) -> FitOutcome:
    """The fit with what came of its starts on a finer mesh. The best one goes on first. If that shows that a finer mesh
    helps, those with the lowest losses there follow, until one explains the recordings, or two end equally low. The loss is
    infinite if all of them diverge.

    Raises:
        KeyboardInterrupt: interrupted before one of them has gone on.
    """
    began, starts = time.perf_counter(), _Ends(finer, space, fitted)
    outcome, losses, interrupted = fitted, list[float](), False
    best = replace(fitted, loss=math.inf)
    try:
        for start, values in islice(starts, _FOLLOWED):
            of_use = min(_CLEARLY * fitted.loss, EQUALLY * best.loss)
            alone = replace(settings, starts=1, screen=0, init=values)
            try:
                further = fit_gauss_newton(finer, space, alone, progress=progress, of_use=of_use)
            except DivergedError:
                continue
            outcome = replace(outcome, best_start=start).gone_on(further)
            if outcome.loss < best.loss:
                best = outcome
            losses.append(further.loss)
            interrupted = further.stop_reason == "interrupted"
            equal = sum(loss <= EQUALLY * best.loss for loss in losses) > 1
            explained = best.loss <= finer.explained or further.stop_reason == "threshold"
            if interrupted or explained or equal or best.loss > _CLEARLY * fitted.loss:
                break
    except KeyboardInterrupt:
        if not losses:
            raise
        interrupted = True
    return replace(
        best,
        history=outcome.history,
        simulations=outcome.simulations + starts.simulations,
        seconds=fitted.seconds + time.perf_counter() - began,
        stop_reason="interrupted" if interrupted else best.stop_reason,
    )


class _Ends:
    """Where descents on a finer mesh begin: at the ends of a fit's starts, each as it is and with the cloth laid as the
    scenario says: what a coarse mesh cannot do, a turn may have made up for."""

    def __init__(self, finer: AnyObjective, space: FitSpace, fitted: FitOutcome) -> None:
        self.simulations = 0
        self._finer, self._space, self._fitted = finer, space, fitted

    def __iter__(self) -> Iterator[tuple[int, dict[str, float]]]:
        """(start, values), the best start's first, then those with the lowest loss on the finer mesh; places that are close
        to an earlier one are left out."""
        losses, values = self._fitted.history.losses[-1], self._fitted.history.values[-1]
        starts = losses.isfinite().nonzero()[:, 0]
        laid = torch.tensor([one.deviation is not None for one in self._space.variables])
        askew = starts[(self._places(values[starts]) * laid).abs().amax(-1) >= _APART]
        ends = torch.cat([values[starts], torch.where(laid, 0.0, values[askew])])
        starts = torch.cat([starts, askew])
        places, followed = self._places(ends), list[int]()
        there, best = torch.full((len(ends),), math.inf, dtype=torch.float64), starts == int(losses.argmin())
        for group in (best, ~best):
            if not bool(group.any()):
                continue
            there[group] = batch_losses(self._finer, self._space, ends[group])
            self.simulations += int(group.sum()) * len(self._finer.members)
            for index in there.argsort()[: int(there.isfinite().sum())].tolist():
                if any(float((places[index] - places[other]).abs().max()) < _APART for other in followed):
                    continue
                followed.append(index)
                yield int(starts[index]), dict(zip(self._space.names, ends[index].tolist(), strict=True))
                if group is best:
                    break

    def _places(self, values: Tensor) -> Tensor:
        return Axis.of(self._space).places(values)


def _without(found: FinerFit, further: FitOutcome) -> FinerFit:
    """The fit as it was, with what a finer mesh has cost in vain."""
    outcome = replace(found.outcome, simulations=further.simulations, seconds=further.seconds)
    if further.stop_reason == "interrupted":
        return replace(found, outcome=replace(outcome, stop_reason="interrupted"))
    return replace(found, outcome=outcome, finer_loss=further.loss if math.isfinite(further.loss) else None)
