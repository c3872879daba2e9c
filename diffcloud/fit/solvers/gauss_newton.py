"""Gauss–Newton with Levenberg–Marquardt damping and bounds, over several starts at once.

With half of the loss's slope g and of its curvature H on the axis of `residuals.Axis`, a step s solves

    (H + λ diag H) s = -g

over the variables that no bound holds (Marquardt 1963; Madsen, Nielsen and Tingleff 2004, section 3.2). Each start keeps
its own λ: it falls by how much of the predicted decrease a step brings, and grows, faster and faster, where it brings
none. Starts are the best of a screen of candidates spread over the box. Where they have ended, losses along the principal
axes of the best place tell whether another minimum is lower nearby; from there a start goes on.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from diffcloud.errors import DivergedError
from diffcloud.fit.batches import batch_losses
from diffcloud.fit.joint import AnyObjective
from diffcloud.fit.parameters import FitSpace
from diffcloud.fit.residuals import Axis, Linearisation, linearise
from diffcloud.fit.scan import scan
from diffcloud.fit.solvers.outcome import FitHistory, FitOutcome, Progress, StopReason

ROUGH_SCREEN = 96
"""Candidates where the loss is too rough for derivatives: more minima, and their simulations cost a tenth."""
_FIRST_DAMPING = 1e-2
_LARGEST_STEP = 1.0
"""On the axis: a factor e, or the whole range."""
_SMALLEST_STEP = 1e-3
"""A step below 0.1 % of a value, or a predicted decrease below this part of the loss, means that a start has arrived."""
_SMALLEST_DECREASE = 1e-3
_SAME = 0.02
"""A start that comes as close to the best one, on the axis, leaves the rest of the way to it."""
_GIVE_UP = 6
"""Steps in vain, one after the other: the loss is rougher than its slope."""


@dataclass(frozen=True)
class GaussNewtonSettings:
    """Of one fit."""

    iterations: int = 20
    """Steps of each start at most."""
    threshold: float = 0.0
    """Stop below this loss; 0: never."""
    scans: int = 2
    """Times that a lower minimum is looked for around the best place; 0: never."""
    screen: int = 24
    """Candidates beside the first that are simulated once, without derivatives; 0: the starts are taken unseen."""
    starts: int = 3
    """The best of them, which are followed."""
    seed: int = 0
    """Of the candidates."""
    init: Mapping[str, float] = field(default_factory=dict)
    """Values of the first candidate, which is followed in any case; the middle of the range where not given."""


def fit_gauss_newton(
    objective: AnyObjective,
    space: FitSpace,
    settings: GaussNewtonSettings,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> FitOutcome:
    """Minimise; the lowest iterate wins. Ctrl-C ends the fit and keeps the best so far.

    Raises:
        DivergedError: every candidate diverged.
        KeyboardInterrupt: interrupted before the first loss.
    """
    began = time.perf_counter()
    axis = Axis.of(space)
    start, simulations = _starts(objective, space, settings, axis)
    history = FitHistory(space.names)
    reason: StopReason = "iterations"
    scans, looked = 0, None
    try:
        at = linearise(objective, space, start)
        simulations += at.simulations
        if not bool(torch.isfinite(at.losses).any()):
            raise DivergedError(0, [], f"all {len(start)} starts diverged")
        search = _Search(start, at)
        for iteration in range(settings.iterations + 1):
            _remember(history, search, axis)
            if progress is not None:
                best = axis.bounded(search.places[search.best]).tolist()
                loss = float(search.losses.min())
                progress(Progress(iteration, loss, loss, dict(zip(space.names, best, strict=True))))
            if float(search.losses.min()) < settings.threshold:
                reason = "threshold"
                break
            going = search.going
            if not len(going):
                reason = "converged" if bool(search.arrived[search.best]) else "rough"
                if scans == settings.scans or iteration == settings.iterations:
                    break
                scans += 1
                place = search.places[search.best]
                found_near, spent = scan(objective, space, place, search.normal[search.best])
                simulations += spent
                lower = found_near.lower(place, float(search.losses.min()))
                if lower is None:
                    looked = found_near
                    break
                at = linearise(objective, space, lower[None])
                simulations += at.simulations
                going = search.restart(lower, at)
                reason = "iterations"
            if iteration < settings.iterations:
                tried = search.propose(going, *axis.ends)
                found = linearise(objective, space, tried)
                simulations += found.simulations
                search.judge(going, tried, found)
    except KeyboardInterrupt:
        if not history.losses:
            raise
        reason = "interrupted"
    values = axis.bounded(search.places[search.best]).tolist()
    return FitOutcome(
        values=dict(zip(space.names, values, strict=True)),
        loss=float(search.losses.min()),
        best_start=search.best,
        simulations=simulations,
        stop_reason=reason,
        seconds=time.perf_counter() - began,
        history=history,
        scan=looked,
    )


class _Search:
    """B starts, each at its lowest place so far."""

    def __init__(self, places: Tensor, found: Linearisation) -> None:
        self.places, self.losses = places.clone(), found.losses.clone()
        self.slope, self.normal = found.slope.clone(), found.curvature.clone()
        count = len(places)
        self._damping = torch.full((count,), _FIRST_DAMPING, dtype=torch.float64)
        self._growth = torch.full((count,), 2.0, dtype=torch.float64)
        self._in_vain = torch.zeros(count, dtype=torch.long)
        self.arrived = torch.zeros(count, dtype=torch.bool)
        self._predicted = torch.zeros(count, dtype=torch.float64)

    @property
    def best(self) -> int:
        return int(self.losses.argmin())

    @property
    def going(self) -> Tensor:
        """Starts [b] that have neither arrived nor given up."""
        return (~self.arrived & (self._in_vain < _GIVE_UP) & torch.isfinite(self.losses)).nonzero().flatten()

    def restart(self, place: Tensor, found: Linearisation) -> Tensor:
        """Another place [k] in that of the highest loss, which has ended; its index [1]."""
        row = int(self.losses.argmax()) if len(self.losses) > 1 else 0
        self.places[row], self.losses[row] = place, found.losses[0]
        self.slope[row], self.normal[row] = found.slope[0], found.curvature[0]
        self._damping[row], self._growth[row], self._in_vain[row] = _FIRST_DAMPING, 2.0, 0
        self.arrived[row] = False
        return torch.tensor([row])

    def propose(self, going: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """[b, k] the next places of some starts, between the bounds [k]."""
        tried = []
        for start in going.tolist():
            place, slope, normal = self.places[start], self.slope[start], self.normal[start]
            free = ~(((place <= low) & (slope > 0)) | ((place >= high) & (slope < 0))) & (normal.diagonal() > 0)
            step = torch.zeros_like(place)
            if bool(free.any()):
                inner = normal[free][:, free]
                damped = inner + self._damping[start] * inner.diagonal().diag()
                step[free] = -torch.linalg.solve(damped, slope[free])
            step *= min(1.0, _LARGEST_STEP / max(float(step.abs().max()), 1e-300))
            step = torch.minimum(torch.maximum(place + step, low), high) - place
            self._predicted[start] = float(-2 * slope @ step - step @ normal @ step)
            tried.append(place + step)
        return torch.stack(tried)

    def judge(self, going: Tensor, tried: Tensor, found: Linearisation) -> None:
        """Take the steps that lowered a loss, and set each damping for the next."""
        for row, start in enumerate(going.tolist()):
            before, predicted = float(self.losses[start]), float(self._predicted[start])
            decrease = before - float(found.losses[row])
            step = float((tried[row] - self.places[start]).abs().max())
            small = step < _SMALLEST_STEP or predicted < _SMALLEST_DECREASE * before
            if decrease > 0:
                ratio = decrease / max(predicted, 1e-300)
                self._damping[start] *= max(1 / 3, 1 - (2 * min(ratio, 1.0) - 1) ** 3)
                self._growth[start], self._in_vain[start] = 2.0, 0
                self.places[start], self.losses[start] = tried[row], found.losses[row]
                self.slope[start], self.normal[start] = found.slope[row], found.curvature[row]
            else:
                self._damping[start] *= self._growth[start]
                self._growth[start] *= 2
                self._in_vain[start] += 1
            self.arrived[start] = small
        beside = (self.places - self.places[self.best]).abs().amax(-1) < _SAME
        beside[self.best] = False
        self.arrived |= beside


def _starts(objective: AnyObjective, space: FitSpace, settings: GaussNewtonSettings, axis: Axis) -> tuple[Tensor, int]:
    """Places [B, k] to start at, and how many simulations it took to choose them."""
    count = max(1 + settings.screen, settings.starts)
    values = space.starts(count, seed=settings.seed, first=settings.init)[0].double()
    if not settings.screen:
        return axis.places(values), 0
    losses = batch_losses(objective, space, values)
    if not math.isfinite(float(losses.min())):
        raise DivergedError(0, [], f"all {count} candidates diverged")
    order = losses.argsort()
    if settings.init:
        order = torch.cat([torch.zeros(1, dtype=torch.long), order[order > 0]])
    return axis.places(values[order[: settings.starts]]), count * len(objective.members)


def _remember(history: FitHistory, search: _Search, axis: Axis) -> None:
    history.losses.append(search.losses.clone())
    history.values.append(axis.bounded(search.places))
    history.gradients.append(2 * search.slope.clone())
