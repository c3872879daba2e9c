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
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from diffcloud.errors import DivergedError
from diffcloud.fit.batches import batch_losses
from diffcloud.fit.joint import AnyObjective
from diffcloud.fit.parameters import FitSpace
from diffcloud.fit.residuals import Axis
from diffcloud.fit.solvers import (
    FitOutcome,
    GaussNewtonSettings,
    LikelihoodSettings,
    Progress,
    Settings,
    fit_gauss_newton,
    solve,
)
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
    """With priors, where a fit after one more halving, which hardly helped, ended or was given up."""


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
    if isinstance(settings, LikelihoodSettings):  # which looks at the finer mesh itself
        outcome = solve(objective, space, settings, progress=None if progress is None else partial(progress, 0))
        assert outcome.estimate is not None
        return FinerFit(objective.earliest(outcome.estimate.horizons), outcome, 0)
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
    """The fit with what came of its starts on a finer mesh, each as it ended and with the cloth laid as the scenario says:
    what a coarse mesh cannot do, a turn may have made up for. Those with the lowest losses there go on, until one explains
    the recordings, or two end equally low, or the first one shows that a finer mesh does not help. The loss is infinite if
    none of them has got anywhere.

    Raises:
        KeyboardInterrupt: interrupted while the losses of the starts are found there.
    """
    began = time.perf_counter()
    begun, ends = _ends(fitted, space)
    places = Axis.of(space).places(ends)
    there = batch_losses(finer, space, ends)
    outcome = replace(fitted, simulations=fitted.simulations + len(ends) * len(finer.members))
    best, losses, followed, interrupted = replace(outcome, loss=math.inf), list[float](), list[int](), False
    for end in there.argsort()[: int(there.isfinite().sum())].tolist():
        if len(followed) == _FOLLOWED:
            break
        if any(float((places[end] - places[other]).abs().max()) < _APART for other in followed):
            continue
        followed.append(end)
        alone = replace(settings, starts=1, screen=0, init=dict(zip(space.names, ends[end].tolist(), strict=True)))
        of_use = min(_CLEARLY * fitted.loss, EQUALLY * best.loss)
        try:
            further = fit_gauss_newton(finer, space, alone, progress=progress, of_use=of_use)
        except DivergedError:
            continue
        except KeyboardInterrupt:
            interrupted = True
            break
        outcome = replace(outcome, best_start=int(begun[end])).gone_on(further)
        if outcome.loss < best.loss:
            best = outcome
        losses.append(further.loss)
        interrupted = further.stop_reason == "interrupted"
        equal = sum(loss <= EQUALLY * best.loss for loss in losses) > 1
        explained = best.loss <= finer.explained or further.stop_reason == "threshold"
        if interrupted or explained or equal or best.loss > _CLEARLY * fitted.loss:
            break
    return replace(
        best,
        history=outcome.history,
        simulations=outcome.simulations,
        seconds=fitted.seconds + time.perf_counter() - began,
        stop_reason="interrupted" if interrupted else best.stop_reason,
    )


def _ends(fitted: FitOutcome, space: FitSpace) -> tuple[Tensor, Tensor]:
    """Starts [n], and values [n, k] of where they ended; then once more those that ended with a cloth that lies otherwise
    than the scenario says, now laid so."""
    begun = fitted.history.losses[-1].isfinite().nonzero()[:, 0]
    ends = fitted.history.values[-1][begun]
    laid = torch.tensor([one.deviation is not None for one in space.variables])
    askew = (Axis.of(space).places(ends) * laid).abs().amax(-1) >= _APART
    return torch.cat([begun, begun[askew]]), torch.cat([ends, torch.where(laid, 0.0, ends[askew])])


def _without(found: FinerFit, further: FitOutcome) -> FinerFit:
    """The fit as it was, with what a finer mesh has cost in vain."""
    outcome = replace(found.outcome, simulations=further.simulations, seconds=further.seconds)
    if further.stop_reason == "interrupted":
        return replace(found, outcome=replace(outcome, stop_reason="interrupted"))
    return replace(found, outcome=outcome, finer_loss=further.loss if math.isfinite(further.loss) else None)
