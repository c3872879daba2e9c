"""Gauss–Newton with bounds and a trust region, from one start after the other.

With half of the loss's slope g and of its curvature H on the axis of `residuals.Axis`, a step s minimises

    g·s + s·(H + λ diag H) s / 2     between the bounds, no component longer than a radius

(Conn, Gould and Toint 2000, chapter 7). The trust region is a box, so that it and the bounds together are a box again. A
step that is computed without the bounds, and then cut off at one, may lead uphill: its other components were chosen to go
with what was cut off. Each start keeps its own radius. It may grow where a step brings at least half of the decrease that
was predicted, becomes half the step where it brings less than a quarter, and a fifth of it where it brings none. λ is small
and stays. Where derivatives are differences, losses to both sides of each place are known as well: a start that can go no
further goes on from the lowest place that it has passed by, if that is lower, as long as it has steps left.

The first start is the best of a screen of candidates spread over the box, with doubtful material as it most likely is. The
following ones are the best of a second screen, spread over doubtful material too: otherwise, the best ones might lie beside
each other, and their ends would say little of each other. The remaining ones are not followed, and the second screen is not
made, once one explains the recording. Two further ways lead to starts: one fits the recording's beginning, then more and
more of it; the other is a derivative-free search, from the best place so far, over the parameters asked for only. The
search comes after three candidates. So do growing starts, but the first of them comes after two where the best end is low
enough for the model to be right (with a threshold, all of them come right after the first candidate). They also wait while
an end from another candidate is as low as the best one.

In a joint fit without a given start, a growing start comes before all others: a descent in vain costs more there, and one
from a candidate goes astray more often. Of six cloths, the first candidate led to the truth for one (two folds), three (a
lift and a fold) and three (two of each, eight unknown parameters), the first growing start for all six. For two lifts both
did, and growing first takes 40 % more time.

Four equally low ends are taken for the minimum although they do not explain the recording; two are, where their loss is so
high that the model must be wrong, or where it is not known what cameras missed. Unless the recording is explained, losses
along the principal axes of the best place then tell whether another minimum is lower nearby; from there it goes on.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from diffcloud.errors import DivergedError
from diffcloud.fit.batches import batch_losses
from diffcloud.fit.bounded import lowest_within
from diffcloud.fit.joint import AnyObjective
from diffcloud.fit.names import plain_name
from diffcloud.fit.parameters import FitSpace
from diffcloud.fit.priors import INDEPENDENT
from diffcloud.fit.residuals import STEP, Axis, Linearisation, by_tangents, linearise
from diffcloud.fit.scan import Scan, scan
from diffcloud.fit.solvers.cma_es import CmaEsSettings, fit_cma_es
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
_MOST = 8
"""Candidates that are followed, unless fewer are enough."""
_BEFORE, _SEARCHED = 3, 64
"""Candidates that are followed before a search looks for one more start, and how many places that search simulates."""
_SOON = 2
"""Candidates followed before the first growing start where the best end is low enough for the model to be right."""
_DRAWS = 16
"""Places that are drawn before each next part of a growing recording, around where the part before ended."""
_GROWING = ((0.4, 0.6, 0.8), 0), ((0.5, 0.75), _DRAWS), ((0.4, 0.6, 0.8), _DRAWS)
"""For each start that is found so, the parts of the frames over which the recording grows, and how many places are drawn.
The first one takes a fifth of the others' simulations. Where one goes astray at the end, another seldom does."""
_WIDENING = (1.0, 2.0, 4.0)
"""Times the deviations of what is known so far, one after the other, while no draw is low enough: where a motion may go on
in two ways, the right one may be rare, and a beginning may have gone astray itself."""
_AS_LOW = 1.3
"""Times the loss at which the part before ended, if that did not explain its frames, or it is not known what would."""
_MISFIT = 26.0
"""Times what explains a recording; above that, it is the model that does not: no start will."""
EQUALLY, _ABOUT_EQUALLY = 1.01, 1.05
"""Losses within the first factor are equally low; within the second one, where the model must be wrong: what it cannot do
weighs more than such a difference."""
_WITNESSES, _FEW_WITNESSES = _BEFORE + 1, 2
"""Equally low ends of different candidates that are taken for the minimum although they do not explain the recording; fewer
where it is not known what cameras missed, or where the model must be wrong."""
_SCREENED, _SCREENED_POINTS = 0.5, 500
"""Part of the frames on which candidates are compared: the rest costs as much again, and has more wrong minima. And the
most points of a frame: compared by so few of a published scene's 3,500, the same candidates come out best, in a seventh of
the time."""
_HOPE = 10.0
"""Steps like the next one; where not even so many would get below what is of use, a start is given up."""


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
    starts: int | None = None
    """The best of them, followed one after the other as far as it takes; by default 8, three found by letting the recording
    grow, and one that a search finds."""
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
    of_use: float = math.inf,
) -> FitOutcome:
    """Minimise; the lowest iterate wins. Ctrl-C ends the fit and keeps the best so far.

    Args:
        of_use: loss that a start must be about to get below; else it is given up, and no lower minimum is looked for around
            it.

    Raises:
        DivergedError: every candidate diverged.
        KeyboardInterrupt: interrupted before the first loss with derivatives.
    """
    began = time.perf_counter()
    axis = Axis.of(space)
    most, when = settings.starts or _MOST, _Enough.of(objective, settings)
    places, simulations = _starts(objective, space, settings, axis, most)
    history = FitHistory(space.names)
    reason: StopReason = "iterations"
    candidates = [_Start(place, origin) for origin, place in enumerate(places)]
    waiting, others = candidates[:most], candidates[most:]

    early: _Way | None = None

    def tell(growing: _Way | None = None) -> None:
        """Of the best way; until the first one has begun, of the one by which a recording grows."""
        nonlocal early
        early = growing
        best = ways.best if ways.every or growing is None else growing
        if progress is not None:
            values = dict(zip(space.names, axis.bounded(best.place).tolist(), strict=True))
            progress(Progress(max(len(history.losses) - 1, 0), best.loss, best.loss, values))

    best = 1 if settings.init else 0  # of the screen; a first start that was given says little
    if settings.screen and bool(_spread_doubts(space).any()):
        screened = cache(lambda: _starts(objective, space, settings, axis, most, doubted=True))
        for index in range(best + 1, len(waiting)):
            waiting[index] = _Start(places[index], index, partial(_doubted, screened, index - best - 1))
    joint = len(objective.members) > 1 and all(map(by_tangents, objective.members)) and not settings.init
    growing = [
        _Start(
            places[best], best, partial(_grown, stages, draws, space, places[best], settings, index, axis, tell), grows=True
        )
        for index, (stages, draws) in enumerate(_growths(objective) if joint or settings.starts is None else [])
    ]
    first = growing[:1] if joint else []
    if settings.starts is None:
        search = _Start(places[0], -1, lambda: _searched(objective, space, ways.best, settings.seed, axis, tell))
        waiting.insert(_BEFORE, search)
        waiting[best + 1 : best + 1] = growing[len(first) :]
    waiting = [*first, *waiting][: settings.starts]
    scans, looked = 0, None
    ways = _Ways(waiting, settings.iterations, _laid(space, settings.init))
    try:
        while True:
            way = ways.going
            if way is not None:
                tried = way.propose(*axis.ends)
                if not way.may_get_below(of_use):
                    way.give_up()
                    continue
                found = linearise(objective, space, tried[None])
                simulations += found.simulations
                ways.judge(way, tried, found)
            elif ways.waiting and not ways.enough(when):
                start = ways.following(when)
                place, spent = start.found()
                found = linearise(objective, space, place[None])
                simulations += spent + found.simulations
                ways.begin(start, place, found)
            else:
                reason = ways.best.end or reason
                done = objective.knows_gaps and ways.best.loss <= when.explained
                if scans == settings.scans or reason == "iterations" or done or ways.best.loss > of_use:
                    break
                scans += 1
                seen, spent = scan(objective, space, ways.best.place, ways.best.normal)
                simulations += spent
                seen, lower, spent = _confirmed(objective, space, ways.best, seen)
                simulations += spent
                if lower is None:
                    looked = seen
                    break
                ways.go_on(*lower)
            if not math.isfinite(ways.best.loss):
                if others and not ways.waiting:  # they diverge after the frames that they were chosen by
                    ways.waiting.append(others.pop(0))
                if ways.waiting:
                    continue
                raise DivergedError(0, [], f"all {len(ways.every)} starts diverged")
            _remember(history, ways, axis)
            tell()
            if ways.best.loss < settings.threshold:
                reason = "threshold"
                break
    except KeyboardInterrupt:
        if not history.losses:
            if early is None:
                raise
            found = linearise(objective, space, early.place[None])  # what has grown is not given away
            simulations += found.simulations
            ways.begin(_Start(early.place, best, grows=True), early.place, found)
            if not math.isfinite(ways.best.loss):
                raise
            _remember(history, ways, axis)
        reason = "interrupted"
    return FitOutcome(
        values=dict(zip(space.names, axis.bounded(ways.best.place).tolist(), strict=True)),
        loss=ways.best.loss,
        best_start=ways.every.index(ways.best),
        simulations=simulations,
        stop_reason=reason,
        seconds=time.perf_counter() - began,
        history=history,
        scan=looked,
    )


@dataclass(frozen=True)
class _Start:
    """One that waits for its turn."""

    place: Tensor
    """[k]; of one that is looked for when its turn comes, where that begins."""
    origin: int
    """The candidate that it comes from; -1: none."""
    look: Callable[[], tuple[Tensor, int]] | None = None
    grows: bool = False
    """Whether it is looked for by letting the recording grow, which takes long, above all with draws."""

    def found(self) -> tuple[Tensor, int]:
        """The start [k], and how many simulations it took to find it."""
        return (self.place, 0) if self.look is None else self.look()


class _Way:
    """From one start, at its lowest place so far."""

    def __init__(
        self, place: Tensor, found: Linearisation, steps: int, origin: int = -1, held: Tensor | None = None
    ) -> None:
        """
        Args:
            place: [k]
            found: there.
            steps: it may take.
            origin: of its start.
            held: bool [k] what stays until it has arrived; then it goes on with all free, and as many steps again.
        """
        self.origin = origin
        self._most, self._held = steps, held
        self._beside, self.beside_loss = place, math.inf
        self._take(place, found)
        self._look_beside(found)
        self._begin()

    def _begin(self) -> None:
        self._steps, self._radius, self._in_vain = self._most, _LARGEST_STEP, False
        self._predicted = 0.0
        self.arrived = False

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
        return lower and self._held is None and self._stands is not None

    @property
    def end(self) -> StopReason | None:
        """Why it goes no further; None while it does."""
        if not self._aside and self._stands is not None:
            return self._stands
        return None if self._steps else "iterations"

    def may_get_below(self, loss: float) -> bool:
        """Whether many steps like the one that is proposed would. A step in vain says nothing against it, and neither does
        one with variables held."""
        return self._in_vain or self._held is not None or self.loss - _HOPE * self._predicted <= loss

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
        if self._held is not None:
            free &= ~self._held
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
        if self._held is not None and self.end is not None and math.isfinite(self.loss):
            self._held = None
            self._begin()


@dataclass(frozen=True)
class _Enough:
    """When no more starts are followed."""

    explained: float
    """One end at or below this loss (the threshold, if given) is enough."""
    misfit: float
    """Above this one, `_FEW_WITNESSES` equally low ends are enough: the model must be wrong. Zero where it is not known
    what cameras missed."""
    witnesses: float
    """Equally low ends that are needed at or below `misfit`."""

    @staticmethod
    def of(objective: AnyObjective, settings: GaussNewtonSettings) -> _Enough:
        known = objective.explained
        if settings.threshold:  # something is lower
            return _Enough(settings.threshold, math.inf, math.inf)
        misfit = _MISFIT * known if objective.knows_gaps else 0.0
        if settings.starts:  # so many are to be followed
            return _Enough(known, misfit, math.inf)
        return _Enough(known, misfit, _WITNESSES)


class _Ways:
    """From B starts, one after the other."""

    def __init__(self, starts: Sequence[_Start], steps: int, held: Tensor) -> None:
        """
        Args:
            starts: B, in their order.
            steps: each may take.
            held: bool [k] what the first one that does not grow leaves as it is at first.
        """
        self.waiting, self.every, self._steps = list(starts), list[_Way](), steps
        self._held = held if bool(held.any()) else None
        self._grown = 0

    @property
    def best(self) -> _Way:
        """Of those that have begun."""
        return min(self.every, key=lambda way: way.loss)

    @property
    def going(self) -> _Way | None:
        """The one under way."""
        return next((way for way in self.every if way.end is None), None)

    def enough(self, when: _Enough) -> bool:
        """Whether the best one explains the recording, or enough others have ended as low."""
        if not self.every or not math.isfinite(self.best.loss):
            return False
        needed = when.witnesses if self.best.loss <= when.misfit else _FEW_WITNESSES
        return self.best.loss <= when.explained or len(self._witnesses(when)) >= needed

    def following(self, when: _Enough) -> _Start:
        """The next start: at first, and where no number of equal ends would be enough, in their order. Else those that grow
        wait until three others were followed, and while the best end is not alone. The first of them needs to wait for only
        two where the best end is low enough for the model to be right."""
        place = 0
        if self.every and math.isfinite(when.witnesses):
            soon = not self._grown and self.best.loss <= when.misfit
            early = len(self.every) - self._grown < (_SOON if soon else _BEFORE)
            grows = not (early or len(self._witnesses(when)) > 1)
            place = next((place for place, start in enumerate(self.waiting) if start.grows == grows), 0)
        start = self.waiting.pop(place)
        self._grown += start.grows
        return start

    def _witnesses(self, when: _Enough) -> set[int]:
        """The candidates from which ends as low as the best one come."""
        equally = _ABOUT_EQUALLY if 0 < when.misfit < self.best.loss else EQUALLY
        return {way.origin for way in self.every if way.loss <= equally * self.best.loss}

    def begin(self, start: _Start, place: Tensor, found: Linearisation) -> None:
        """A start, at its place [k], with what was found there."""
        first = not start.grows and len(self.every) == self._grown
        self.every.append(_Way(place, found, self._steps, start.origin, self._held if first else None))

    def judge(self, way: _Way, tried: Tensor, found: Linearisation) -> None:
        """As of the way; one that comes close to a better one leaves it the rest, unless it has passed by a lower place."""
        way.judge(tried, found)
        near = way is not self.best and float((way.place - self.best.place).abs().max()) < _SAME
        if near and way.beside_loss >= self.best.loss:
            way.give_up()

    def go_on(self, place: Tensor, found: Linearisation) -> None:
        """From a lower place [k] than the best one's."""
        self.every[self.every.index(self.best)] = _Way(place, found, self._steps, self.best.origin)


def _confirmed(
    objective: AnyObjective, space: FitSpace, best: _Way, seen: Scan
) -> tuple[Scan, tuple[Tensor, Linearisation] | None, int]:
    """The lowest place of a scan around the best one that is lower with its derivatives too, beside which no motion
    diverges: the scan without those that are not, that place [k] with what was found there, and the simulations taken."""
    spent = 0
    while (lower := seen.lower(best.place, best.loss)) is not None:
        found = linearise(objective, space, lower[None])
        spent += found.simulations
        if float(found.losses[0]) < best.loss:
            return seen, (lower, found), spent
        seen = seen.corrected(float(found.losses[0]))
    return seen, None, spent


def _starts(
    objective: AnyObjective,
    space: FitSpace,
    settings: GaussNewtonSettings,
    axis: Axis,
    most: int,
    *,
    doubted: bool = False,
) -> tuple[Tensor, int]:
    """Places [B, k] to start at, at least so many, the best ones first; and how many simulations it took to tell. A first
    start beyond a bound is taken to the bound.

    Args:
        doubted: whether to spread doubtful material too, and leave out the first start; else it is as most likely.

    Raises:
        DivergedError: all candidates, and nothing else has been followed yet.
    """
    count = max(1 + settings.screen, most)
    values = space.starts(count, seed=settings.seed, first=settings.init)[0].double().clamp(axis.low, axis.high)
    if not settings.screen:
        return axis.places(values), 0
    values = values[1:] if doubted else torch.where(_spread_doubts(space), values[0], values)
    count = len(values)
    losses = batch_losses(objective.until(_SCREENED).thinned(_SCREENED_POINTS), space, values)
    if not (doubted or math.isfinite(float(losses.min()))):
        raise DivergedError(0, [], f"all {count} candidates diverged")
    order = losses.argsort()
    if settings.init and not doubted:
        order = torch.cat([torch.zeros(1, dtype=torch.long), order[order > 0]])
    return axis.places(values[order]), count * len(objective.members)


def _doubted(screened: Callable[[], tuple[Tensor, int]], rank: int) -> tuple[Tensor, int]:
    """One of the places of a second screen, and the simulations of that, which the first one of them pays."""
    places, simulations = screened()
    return places[rank], 0 if rank else simulations


def _spread_doubts(space: FitSpace) -> Tensor:
    """bool [k] which variables are doubtful material."""
    return torch.tensor([one.doubtful and one.deviation is None for one in space.variables])


def _searched(
    objective: AnyObjective, space: FitSpace, best: _Way, seed: int, axis: Axis, tell: Callable[[], None]
) -> tuple[Tensor, int]:
    """The place [k] that a search from the best one over what is asked for ends at, doubtful material as it is known; and
    how many simulations it took.

    Raises:
        KeyboardInterrupt: interrupted.
    """
    asked = space.asked
    values = dict(zip(space.names, axis.bounded(best.place).tolist(), strict=True))
    budget = _SEARCHED * len(objective.members)
    init = {name: values[name] for name in asked.names}
    settings = CmaEsSettings(simulations=budget, seed=seed, init=init)
    found = fit_cma_es(objective, asked, settings, progress=lambda _: tell()).uninterrupted()
    whole = {**asked.fixed, **found.values}
    return axis.places(torch.tensor([whole[name] for name in space.names], dtype=torch.float64)), found.simulations


def _growths(objective: AnyObjective) -> list[tuple[list[AnyObjective], int]]:
    """For each of `_GROWING`, the recordings as they grow, up to the whole, and how many places to draw; none where there
    are too few frames."""
    growths = dict[tuple[tuple[int, ...], int], list[AnyObjective]]()
    for parts, draws in _GROWING:
        stages = {_frames(one): one for one in (*(objective.until(part) for part in parts), objective)}
        if len(stages) > 1:
            growths.setdefault((tuple(stages), draws), list(stages.values()))
    return [(stages, draws) for (_, draws), stages in growths.items()]


def _grown(
    stages: Sequence[AnyObjective],
    draws: int,
    space: FitSpace,
    place: Tensor,
    settings: GaussNewtonSettings,
    stream: int,
    axis: Axis,
    tell: Callable[[_Way], None],
) -> tuple[Tensor, int]:
    """The place [k] that a descent from this one comes to on the first frames alone, then on more of them; and how many
    simulations it took. What a cloth does early, before it has folded over or touched something, depends on the parameters
    in a simple way: there, far fewer minima are wrong. With draws, it goes on between two stages from the best of the
    place reached and of places drawn from what the frames so far leave open, which the next ones may tell apart.

    Args:
        stages: the recordings as they grow; on the last one, the whole, the descent is the caller's.
        draws: places drawn between two stages; with 0, it goes on from the place reached.
        place: [k]
        stream: number of the random stream.
    """
    seed = int(np.random.default_rng([settings.seed, stream]).integers(2**31))
    generator, simulations = torch.Generator().manual_seed(seed), 0
    for early, later in pairwise(stages):
        found = linearise(early, space, place[None])
        way, simulations = _Way(place, found, settings.iterations), simulations + found.simulations
        while way.end is None:
            tell(way)
            tried = way.propose(*axis.ends)
            found = linearise(early, space, tried[None])
            simulations += found.simulations
            way.judge(tried, found)
        if not math.isfinite(way.loss):
            break
        place = way.place
        if draws:
            place, spent = _goes_on(way, early, later, space, axis, draws, generator, tell)
            simulations += spent
    return place, simulations


def _goes_on(
    way: _Way,
    early: AnyObjective,
    later: AnyObjective,
    space: FitSpace,
    axis: Axis,
    draws: int,
    generator: torch.Generator,
    tell: Callable[[_Way], None],
) -> tuple[Tensor, int]:
    """The place [k] at which to continue with the later frames, the lowest of the way's end and of places drawn around it,
    ever farther from it while none is low enough; and how many simulations that took.

    Args:
        early, later: the recordings on which the way went, and those that come next.
    """
    explains = later.knows_gaps and way.loss <= early.explained
    enough = later.explained if explains else _AS_LOW * way.loss
    place, lowest, simulations, tried = way.place, math.inf, 0, way.place[None]
    for widening in _WIDENING:
        tell(way)
        tried = torch.cat([tried, _drawn(way, draws, len(early.members), axis, widening, generator)])
        losses = batch_losses(later, space, axis.bounded(tried))
        simulations += len(tried) * len(early.members)
        if float(losses.min()) < lowest:
            place, lowest = tried[losses.argmin()], float(losses.min())
        if lowest <= enough:
            break
        tried = tried[:0]
    return place, simulations


def _drawn(way: _Way, draws: int, recordings: int, axis: Axis, widening: float, generator: torch.Generator) -> Tensor:
    """[n, k] places drawn from what a way's end says of all variables (`fit.priors`: the logarithm of the loss), with so
    many times its deviations.

    Each is a sum of steps along principal axes, the best known one first. A step that would leave the box goes to the side
    with more room, as far as the bound; the steps along better known axes stay, and with them a combination that is known.
    """
    spread, axes = torch.linalg.eigh(way.normal)
    reach = (way.loss / (INDEPENDENT * recordings * spread.clamp(min=max(1e-9 * float(spread[-1]), 1e-300)))).sqrt()
    lengths = widening * reach * torch.randn(draws, len(reach), generator=generator, dtype=torch.float64)
    places = way.place.expand(draws, -1)
    for along, direction in zip(lengths.T.flip(0), axes.T.flip(0), strict=True):
        step = along[:, None] * direction
        forth, back = (axis.room(places, sign * step).clamp(max=1.0) for sign in (1, -1))
        places = places + torch.where(forth < back, -back, forth)[:, None] * step
    return places


def _frames(objective: AnyObjective) -> int:
    """Compared, of all recordings."""
    return sum(len(one.frames) for one in objective.members)


def _laid(space: FitSpace, init: Mapping[str, float]) -> Tensor:
    """bool [k] which variables tell how a cloth lies, but for those of which it is known where to begin. With all of them
    free from the beginning, a motion that may go in several ways finds more wrong minima; without them, a cloth that lies
    askew leads to wrong places. So one start has them wait, the others do not. A turn alone never waits: with it, the same
    ends are reached in fewer steps, whether the cloth lies askew or not."""
    alone = {plain_name(one.name) for one in space.variables if one.deviation is not None} == {"turn"}
    return torch.tensor([one.deviation is not None and not alone and one.name not in init for one in space.variables])


def _remember(history: FitHistory, ways: _Ways, axis: Axis) -> None:
    """A row of all starts; those that have not begun have no loss yet."""
    begun, waiting = ways.every, len(ways.waiting)
    history.losses.append(torch.tensor([way.loss for way in begun] + [math.inf] * waiting, dtype=torch.float64))
    history.values.append(
        axis.bounded(torch.stack([*(way.place for way in begun), *(start.place for start in ways.waiting)]))
    )
    slopes = torch.stack([way.slope for way in begun])
    history.gradients.append(2 * torch.nn.functional.pad(slopes, (0, 0, 0, waiting)))
