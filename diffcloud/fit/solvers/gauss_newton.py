"""Gauss–Newton with bounds and a trust region, from one start after the other.

With half of the loss's slope g and of its curvature H on the axis of `residuals.Axis`, a step s minimises

    g·s + s·(H + λ diag H) s / 2     between the bounds, no component longer than a radius

(Conn, Gould and Toint 2000, chapter 7). The trust region is a box, so that it and the bounds together are a box again. A
step that is computed without the bounds, and then cut off at one, may lead uphill: its other components were chosen to go
with what was cut off. Each start keeps its own radius. It may grow where a step brings at least half of the decrease that
was predicted, becomes half the step where it brings less than a quarter, and a fifth of it where it brings none. λ is small
and stays. Where derivatives are differences, losses to both sides of each place are known as well: a start that can go no
further goes on from the lowest place that it has passed by, if that is lower, as long as it has steps left.

Starts are the best of a screen: candidates spread over the box, with doubtful material as it most likely is, compared on
the first half of the recording. What a cloth does before it has folded or touched something depends on the parameters in a
simple way, so they descend on that half first, and then on the whole. They are followed one after the other, until one
explains the recording or two end equally low.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from diffcloud.errors import DivergedError
from diffcloud.fit.batches import batch_losses
from diffcloud.fit.bounded import lowest_within
from diffcloud.fit.joint import AnyObjective
from diffcloud.fit.parameters import FitSpace
from diffcloud.fit.residuals import STEP, Axis, Linearisation, by_tangents, linearise
from diffcloud.fit.solvers.outcome import FitHistory, FitOutcome, Progress, StopReason

ROUGH_SCREEN, ROUGH_STARTS = 48, 2
"""Candidates and starts where the loss is too rough for derivatives: a candidate costs little, and a step takes several
simulations. On the published recordings, 96 and 3 cost a third more simulations, and lower the mean loss by 0.3 %."""
_DAMPING = 1e-4
"""λ: combinations of variables that the recording hardly tells do not move far."""
_LARGEST_STEP = 1.0
"""On the axis: a factor e, a standard deviation, or the whole range. The first radius, and the largest one."""
_GOOD, _POOR = 0.5, 0.25
"""Parts of the predicted decrease that a good step brings, and that a poor one does not."""
_GROWS, _HALVES, _SHRINKS = 3.0, 0.5, 0.2
"""Times a step: the next radius after a good one, unless it is larger already, after a poor one, and after one in vain."""
_SMALLEST_STEP = 1e-3
"""A step below 0.1 % of a value, or a predicted decrease below the first part of the loss, means that a start has arrived;
below the second one, if the step was in vain: over that length, the loss is rougher than its slope. By the second part a
place beside must be lower, too."""
_SMALLEST_DECREASE, _SMALLEST_IN_VAIN = 1e-4, 1e-3
_REACH = 2 * STEP
"""The least radius after a step to a place beside: twice the distance of the differences."""
_SAME = 0.02
"""A start that comes as close to a better one, on the axis, leaves the rest of the way to it."""
_MOST = 4
"""Starts that are followed, unless fewer are enough: from the first half of a recording, most come to the same end."""
_EQUALLY = 1.01
"""Losses within this factor are equally low."""
_SCREENED, _SCREENED_POINTS = 0.5, 500
"""Part of the frames on which candidates are compared: the rest costs as much again, and has more wrong minima. And the
most points of a frame: compared by so few of a published scene's 3,500, the same candidates come out best, in a seventh of
the time."""


@dataclass(frozen=True)
class GaussNewtonSettings:
    """Of one fit."""

    iterations: int = 20
    """Steps of each start at most."""
    threshold: float = 0.0
    """Stop below this loss; 0: never."""
    screen: int = 24
    """Candidates beside the first that are simulated once, without derivatives; 0: the starts are taken unseen."""
    starts: int | None = None
    """The best of them, followed one after the other: so many, or by default at most 4, as far as it takes."""
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
        KeyboardInterrupt: interrupted before the first loss with derivatives.
    """
    began = time.perf_counter()
    axis = Axis.of(space)
    most = settings.starts or _MOST
    early = objective.until(_SCREENED)
    places, simulations = _starts(early, space, settings, axis, most)
    history, ways = FitHistory(space.names), list[_Way]()
    reason: StopReason = "iterations"
    shorter = any(
        len(one.frames) < len(all_of.frames) for one, all_of in zip(early.members, objective.members, strict=True)
    )
    halved = settings.screen > 0 and shorter and all(map(by_tangents, objective.members))

    def looked(place: Tensor, of: AnyObjective = objective) -> Linearisation:
        nonlocal simulations
        found = linearise(of, space, place[None])
        simulations += found.simulations
        return found

    def begun(place: Tensor) -> Tensor:
        """Where a descent on the first half ends."""
        way = _Way(place, looked(place, early), settings.iterations)
        while way.end is None:
            way.judge(tried := way.propose(*axis.ends), looked(tried, early))
        return way.place

    def tell() -> None:
        if not math.isfinite(_best(ways).loss):
            return
        _remember(history, ways, places[len(ways) : most], axis)
        if progress is not None:
            values = dict(zip(space.names, axis.bounded(_best(ways).place).tolist(), strict=True))
            progress(Progress(len(history.losses) - 1, _best(ways).loss, _best(ways).loss, values))

    try:
        for place in places:
            started = sum(math.isfinite(way.loss) for way in ways)
            if started and (len(ways) >= most or _enough(ways, objective, settings)):
                break
            start = begun(place) if halved and not (settings.init and not ways) else place
            ways.append(way := _Way(start, looked(start), settings.iterations))
            tell()
            while way.end is None and _best(ways).loss >= settings.threshold:
                way.judge(tried := way.propose(*axis.ends), looked(tried))
                best = _best(ways)
                if way is not best and float((way.place - best.place).abs().max()) < _SAME and way.beside_loss >= best.loss:
                    way.give_up()
                tell()
            if _best(ways).loss < settings.threshold:
                reason = "threshold"
                break
        else:
            if not math.isfinite(_best(ways).loss):
                raise DivergedError(0, [], f"all {len(ways)} starts diverged")
        if reason != "threshold":
            reason = _best(ways).end or reason
    except KeyboardInterrupt:
        if not history.losses:
            raise
        reason = "interrupted"
    best = _best(ways)
    return FitOutcome(
        values=dict(zip(space.names, axis.bounded(best.place).tolist(), strict=True)),
        loss=best.loss,
        best_start=ways.index(best),
        simulations=simulations,
        stop_reason=reason,
        seconds=time.perf_counter() - began,
        history=history,
    )


def _best(ways: Sequence[_Way]) -> _Way:
    return min(ways, key=lambda way: way.loss)


def _enough(ways: Sequence[_Way], objective: AnyObjective, settings: GaussNewtonSettings) -> bool:
    """Whether the best end explains the recording, or another one is as low. So many starts as are asked for are followed
    in any case, but where one explains it."""
    best = _best(ways).loss
    if settings.threshold:  # something is lower
        return False
    equal = sum(way.loss <= _EQUALLY * best for way in ways)
    return best <= objective.explained or (settings.starts is None and equal > 1)


class _Way:
    """From one start, at its lowest place so far."""

    def __init__(self, place: Tensor, found: Linearisation, steps: int) -> None:
        """
        Args:
            place: [k]
            found: there.
            steps: it may take.
        """
        self._steps, self._radius, self._in_vain = steps, _LARGEST_STEP, False
        self._predicted, self.arrived = 0.0, False
        self._beside, self.beside_loss = place, math.inf
        self._take(place, found)
        self._look_beside(found)

    def _take(self, place: Tensor, found: Linearisation) -> None:
        self.place, self.loss = place, float(found.losses[0])
        self.slope, self.normal = found.slope[0], found.curvature[0]

    def _look_beside(self, found: Linearisation) -> None:
        """Remember the lowest place beside those tried so far."""
        if found.beside is None:
            return
        places, losses = found.beside[0][:, 0], found.beside[1][:, 0]
        lowest = int(losses.argmin())
        if float(losses[lowest]) < self.beside_loss:
            self._beside, self.beside_loss = places[lowest], float(losses[lowest])

    @property
    def _stands(self) -> StopReason | None:
        """Why no further step from its place is of use; None while one may be."""
        if self.arrived:
            return "converged"
        return "rough" if self._radius < _SMALLEST_STEP or not math.isfinite(self.loss) else None

    @property
    def _aside(self) -> bool:
        """Whether it stands, but has passed by a lower place, where the next step goes."""
        lower = self.beside_loss < (1 - _SMALLEST_IN_VAIN) * self.loss
        return lower and self._stands is not None

    @property
    def end(self) -> StopReason | None:
        """Why it goes no further; None while it does."""
        if not self._aside and self._stands is not None:
            return self._stands
        return None if self._steps else "iterations"

    def give_up(self) -> None:
        """Go no further."""
        self.arrived, self.beside_loss = True, math.inf

    def propose(self, low: Tensor, high: Tensor) -> Tensor:
        """[k] the next place, between the bounds [k]."""
        if self._aside:
            self._predicted = self.loss - self.beside_loss
            return self._beside
        place, slope, normal = self.place, self.slope, self.normal
        free = normal.diagonal() > 0
        step = torch.zeros_like(place)
        if bool(free.any()):
            inner = normal[free][:, free]
            least, most = ((end - place)[free].clamp(-self._radius, self._radius) for end in (low, high))
            step[free] = lowest_within(inner + _DAMPING * inner.diagonal().diag(), slope[free], least, most)
        self._predicted = float(-2 * slope @ step - step @ normal @ step)
        return place + step

    def judge(self, tried: Tensor, found: Linearisation) -> None:
        """Take the step if it lowered the loss, and set the radius for the next."""
        aside, stood = self._aside, (self.arrived, self._radius)
        self._steps -= 1
        step, decrease = float((tried - self.place).abs().max()), self.loss - float(found.losses[0])
        self._in_vain = not decrease > 0
        least = _SMALLEST_IN_VAIN if self._in_vain else _SMALLEST_DECREASE
        self.arrived = step < _SMALLEST_STEP or self._predicted < least * self.loss
        if self._in_vain:
            self._radius = _SHRINKS * step
        elif decrease < _POOR * self._predicted:
            self._radius = _HALVES * step
        elif decrease >= _GOOD * self._predicted:
            self._radius = min(max(self._radius, _GROWS * step), _LARGEST_STEP)
        if not self._in_vain:
            self._take(tried, found)
        if aside:  # that was the step to the place beside: it goes on from there, or stands as it did
            self.arrived, self._radius = stood if self._in_vain else (False, max(self._radius, _REACH))
            self.beside_loss = math.inf
        self._look_beside(found)


def _starts(
    early: AnyObjective, space: FitSpace, settings: GaussNewtonSettings, axis: Axis, most: int
) -> tuple[Tensor, int]:
    """Places [B, k] to start at, at least so many, the best ones first, but a given one before all; and how many
    simulations it took to tell. A first start beyond a bound is taken to the bound.

    Args:
        early: the recordings as far as candidates are compared.

    Raises:
        DivergedError: all candidates.
    """
    count = max(1 + settings.screen, most)
    values = space.starts(count, seed=settings.seed, first=settings.init)[0].double().clamp(axis.low, axis.high)
    if not settings.screen:
        return axis.places(values), 0
    doubtful = torch.tensor([one.doubtful and one.deviation is None for one in space.variables])
    values = torch.where(doubtful, values[0], values)
    losses = batch_losses(early.thinned(_SCREENED_POINTS), space, values)
    if not math.isfinite(float(losses.min())):
        raise DivergedError(0, [], f"all {count} candidates diverged")
    order = losses.argsort()
    if settings.init:
        order = torch.cat([torch.zeros(1, dtype=torch.long), order[order > 0]])
    return axis.places(values[order]), count * len(early.members)


def _remember(history: FitHistory, ways: Sequence[_Way], waiting: Tensor, axis: Axis) -> None:
    """A row of all starts; those that have not begun [n, k] have no loss yet."""
    losses = [way.loss for way in ways] + [math.inf] * len(waiting)
    history.losses.append(torch.tensor(losses, dtype=torch.float64))
    history.values.append(axis.bounded(torch.cat([torch.stack([way.place for way in ways]), waiting])))
    slopes = torch.stack([way.slope for way in ways])
    history.gradients.append(2 * torch.nn.functional.pad(slopes, (0, 0, 0, len(waiting))))
