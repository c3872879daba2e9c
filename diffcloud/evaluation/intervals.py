"""What a fit says of the parameters: intervals with a level, a verdict for each, and what to improve first.

Variances come from `fit.uncertainty`. On the axis of the fit (a factor up and down for multipliers) an interval reaches to
both sides as far as the variance's root times the quantile of Student's t, with the degrees of freedom of Welch and
Satterthwaite: the noise is estimated from few clusters, the stated doubts are not. The effect of the simulator's step size
is known; how much of it a recording contains is not: all of it for a real cloth, none for a motion of this simulator. So
the interval reaches further by the whole effect, to the side to which finer steps would move the fit. Where that is far,
only one end of the interval can miss the truth. The quantile is the smallest with which the interval has its level for any
part of the effect (Imbens and Manski 2004). Intervals end at the bounds.

Gauss and Newton's next step, which the fit has not taken, is one of its sources. No interval is stated where a fit has not
arrived: that step is far longer than the deviations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import ConfigDict, ValidationError
from scipy.optimize import brentq
from scipy.special import stdtr, stdtrit

from diffcloud.errors import ConfigError
from diffcloud.fit.joint import AnyObjective
from diffcloud.fit.objective import Objective
from diffcloud.fit.parameters import FitSpace
from diffcloud.fit.record import FitRecord
from diffcloud.fit.residuals import Axis
from diffcloud.fit.result import physical_values
from diffcloud.fit.uncertainty import STEP_SIZE, Uncertainty, noise_mm, uncertainty
from diffcloud.io.files import read_json
from diffcloud.io.schema import Plain
from diffcloud.scene.scenarios import Scenario

Verdict = Literal[
    "identified",
    "only the ratio",
    "only a combination",
    "the prior speaks",
    "not identified",
    "the model does not explain the recording",
    "the fit has not arrived",
]
WITHIN = 2.0
"""A parameter counts as identified if its interval ends within this factor of the fitted value."""
LEVEL = 0.9
_PLAIN = 1e6
"""Below it numbers are written out."""
_DOUBTED = 1.3
"""Multiple of the loss that noise and spacing of the points leave, where it is known what the recording misses, from which
on a fit gets a remark (see `Objective.unexplained`)."""
_UNEXPLAINED_RMS = 2.0
"""RMS over a coarse allowance for noise and spacing, from which the model does not explain another recording."""
FOLLOWS = 4.0
"""Mean squared distance over what is accounted for, up to which the model follows a recording."""
_MANY = 1_000_000
"""Clusters of a variance that is not estimated from any."""
_STEP = 2.0
"""The largest next step of a fit that has arrived, in standard deviations."""
_PRIOR = 0.5
"""Part of the variance from which it is the prior that speaks."""
_SHARE = 1 / 3
"""A parameter has its part in a combination from this component on."""


class _Model(Plain):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=True)


class Interval(_Model):
    """Of one parameter; None where none is stated."""

    value: float
    low: float | None
    high: float | None
    physical: float
    physical_low: float | None
    physical_high: float | None
    physical_unit: str
    factor: float | None
    """To its farther end."""
    at_bounds: list[float]
    """Bounds at which it ends: it is one-sided there."""
    verdict: Verdict


class RatioInterval(_Model):
    """Of stretch to mass."""

    value: float
    low: float | None
    high: float | None
    factor: float | None


class Combination(_Model):
    """A product of powers of the parameters, and the factor within which it is known."""

    powers: dict[str, float]
    factor: float | None

    def __str__(self) -> str:
        return " · ".join(f"{name}^{power:+.2f}" for name, power in self.powers.items() if abs(power) > 0.05)


class Intervals(_Model):
    """Of one fit."""

    level: float
    within: float
    parameters: dict[str, Interval]
    ratio: RatioInterval | None
    best: Combination | None
    """The best-determined combination, of several parameters."""
    worst: Combination | None
    sources: dict[str, dict[str, float]]
    """Where the uncertainty comes from, the largest part first -> parameter (or `ratio`) -> standard deviation, of the
    logarithm, or of the part of the range where the lower bound is zero."""
    clusters: int
    covariance: list[list[float]]
    arrived: bool
    explains: bool
    """Whether the recordings' noise accounts for the misfit."""
    reason: str
    """Why there is no interval, or the verdict is not of the parameters; else empty."""
    remark: str = ""
    """Why intervals that are stated are doubtful all the same; else empty."""
    note: str = ""
    """Why the ratio is not what a motion identifies where the mass multiplier acts on a part of the cloth; else empty."""

    @property
    def sentences(self) -> list[str]:
        """Reason, remark and note, for people."""
        return [text[0].upper() + text[1:] + "." for text in (self.reason, self.remark, self.note) if text]


def state_intervals(
    objective: AnyObjective,
    space: FitSpace,
    values: Mapping[str, float],
    *,
    level: float = LEVEL,
    within: float = WITHIN,
) -> Intervals:
    """
    Args:
        values: the fitted ones, of doubtful material too; intervals are of what was asked for.
        level: of the intervals.
        within: factor within which a parameter counts as identified.

    Raises:
        DivergedError: the fitted motion diverges.
    """
    found = uncertainty(objective, space, values)
    space = space.asked
    deviations = np.sqrt(np.maximum(found.covariance.diagonal(), 1e-300))
    arrived = bool((np.abs(found.step) <= _STEP * deviations).all())
    found = replace(found, sources={**found.sources, "next step": np.outer(found.step, found.step)})
    misfit = [_misfit(member, loss) for member, loss in zip(objective.members, found.losses.tolist(), strict=True)]
    rms, accounted, excess = max(misfit, key=lambda each: each[2])
    explains = objective.paper or excess <= 1
    reason = ""
    if explains and not arrived:
        reason = "the fit has not arrived: its next step is longer than the interval; fit again with more iterations"
    elif not explains:
        reason = (
            f"the misfit is {rms:.1f} mm RMS, but noise and spacing of the points account for only {accounted:.1f} mm; any "
            "interval says only how far this misfit lets the numbers go, and nothing about the cloth"
        )
        if not all(member.episode.viewpoints for member in objective.members):
            reason += "; if cameras saw only a part of it, import the clouds with `--camera NAME=x,y,z`"
    told = _Told(arrived, explains, reason, "" if reason else _remark(objective, found))
    return _intervals(found, space, values, objective.members[0].scenario, told, level=level, within=within)


@dataclass(frozen=True)
class _Told:
    """What is known of a fit beside its covariance, as `Intervals` has it."""

    arrived: bool
    explains: bool
    reason: str = ""
    remark: str = ""


def _intervals(
    found: Uncertainty,
    space: FitSpace,
    values: Mapping[str, float],
    scenario: Scenario,
    fit: _Told,
    *,
    level: float,
    within: float,
) -> Intervals:
    """
    Args:
        space: of what was asked for.
        values: about which the intervals are.
    """
    total = found.covariance
    reaches = {name: _reach(found, row, level) for name, row in zip(space.names, np.eye(len(space.names)), strict=True)}
    ratio_row = _ratio_row(space)
    ratio_reach = None if ratio_row is None else _reach(found, ratio_row, level)
    combinations = _combinations(found, space, level)
    parameters = {}
    for index, variable in enumerate(space.variables):
        name = variable.name
        low, high, bounded = _ends(space, index, values[name], reaches[name])
        factor = _factor(values[name], low, high)
        prior = found.sources.get("prior")
        told: Verdict
        if not fit.explains:
            told = "the model does not explain the recording"
        elif not fit.arrived:
            told = "the fit has not arrived"
        elif prior is not None and prior[index, index] > _PRIOR * total[index, index]:
            told = "the prior speaks"
        elif factor <= within and not bounded:
            told = "identified"
        elif name in ("stretch", "mass") and ratio_reach is not None and math.exp(max(ratio_reach)) <= within:
            told = "only the ratio"
        elif any(name in _tied(one, space) for one in combinations if one.factor is not None and one.factor <= within):
            told = "only a combination"
        else:
            told = "not identified"
        stated = fit.arrived
        one = physical_values(scenario, {name: 1.0})[name]
        parameters[name] = Interval(
            value=values[name],
            low=low if stated else None,
            high=high if stated else None,
            physical=values[name] * one.physical,
            physical_low=low * one.physical if stated else None,
            physical_high=high * one.physical if stated else None,
            physical_unit=one.physical_unit,
            factor=factor if stated and math.isfinite(factor) else None,
            at_bounds=bounded,
            verdict=told,
        )
    ratio = None
    if ratio_reach is not None:
        value = values["stretch"] / values["mass"]
        below, above = (math.exp(min(reach, 700.0)) for reach in ratio_reach)
        ratio = RatioInterval(
            value=value,
            low=value / below if fit.arrived else None,
            high=value * above if fit.arrived else None,
            factor=max(below, above) if fit.arrived else None,
        )
    several = len(space.names) > 1
    return Intervals(
        level=level,
        within=within,
        parameters=parameters,
        ratio=ratio,
        best=combinations[0] if several else None,
        worst=combinations[-1] if several else None,
        sources=_sources(found, space, ratio_row),
        clusters=found.clusters,
        covariance=total.tolist(),
        arrived=fit.arrived,
        explains=fit.explains,
        reason=fit.reason,
        remark=fit.remark,
        note="" if ratio is None else _node_set_note(scenario),
    )


def intervals_of(
    record: FitRecord,
    objective: AnyObjective,
    space: FitSpace,
    *,
    level: float = LEVEL,
    within: float = WITHIN,
) -> Intervals:
    """Of a fit, as its solver knows them: `likelihood` has found them itself, for others see `state_intervals`.

    Args:
        objective: what the fit has minimised.
        level, within: as of `state_intervals`.

    Raises:
        DivergedError: the fitted motion diverges.
    """
    told = record.estimate
    if told is None:
        return state_intervals(objective, space, record.free, level=level, within=within)
    count = len(told.mean)
    sources = {name: np.array(rows) for name, rows in told.sources.items()}
    sources["noise"] = sources.pop("recording")
    nothing, flat = np.zeros(count), np.zeros((count, count))
    found = Uncertainty(
        names=tuple(told.mean),
        places=nothing,
        losses=np.zeros(len(record.episodes)),
        loss=0.0,
        sources={**sources, STEP_SIZE: flat},
        refined=nothing,
        clusters=_MANY,
        step=nothing,
        curvature=flat,
    )
    explains, reason = _followed(record)
    fit = _Told(arrived=True, explains=explains, reason=reason)
    asked = space.asked
    return _intervals(found, asked, told.mean, objective.members[0].scenario, fit, level=level, within=within)


def _followed(record: FitRecord) -> tuple[bool, str]:
    """Whether the model follows every recording for most of what counts, and else why not."""
    assert record.estimate is not None
    for one, told in zip(record.episodes, record.estimate.recordings, strict=True):
        misfits = np.array(told.misfits)
        if np.median(misfits) > FOLLOWS:
            times = math.sqrt(float(np.median(misfits)))
            return False, (
                f"in {one.name} the cloth is {times:.1f} times as far from the recording as noise, spacing and mesh "
                "account for: check the size, the grasp, the gripper's track, and whether clouds hold more than the cloth"
            )
    return True, ""


def _remark(objective: AnyObjective, found: Uncertainty) -> str:
    """On a loss that a right fit seldom has; else empty."""
    excess = max(
        _over_noise(member, loss) or 0.0 for member, loss in zip(objective.members, found.losses.tolist(), strict=True)
    )
    if excess < _DOUBTED:
        return ""
    return (
        f"the loss is {excess:.1f} times what noise and spacing of the points leave, and a right fit of an exact "
        "model stays below about 1.25 times: the fit may have ended in a wrong minimum, or the model lacks something"
    )


def read_intervals(path: Path, space: FitSpace) -> Intervals:
    """
    Args:
        space: of the fit whose intervals they are.

    Raises:
        ConfigError: missing, damaged, not intervals, or those of a fit of other parameters.
    """
    try:
        found = Intervals.model_validate(read_json(path, error=ConfigError))
    except ValidationError as error:
        raise ConfigError(
            f"{path} holds no intervals; take intervals.json of `diffcloud identify`, or what `diffcloud evaluate "
            "intervals --json` prints."
        ) from error
    shape, count = np.shape(np.array(found.covariance, dtype=object)), len(space.names)
    if tuple(found.parameters) != space.names or shape != (count, count) or not np.isfinite(found.covariance).all():
        told = ", ".join(found.parameters)
        raise ConfigError(f"{path} holds intervals of {told}; the fit is of {', '.join(space.names)}.")
    return found


def draws(found: Intervals, space: FitSpace, count: int, seed: int) -> list[dict[str, float]]:
    """Parameter sets as probable as the data leave them: normal on the axis of the fit, none beyond its bounds.

    Raises:
        ConfigError: the fit has not arrived, or does not explain its recording; then its covariance says nothing.
    """
    if found.reason:
        raise ConfigError(f"Nothing can be drawn from these intervals: {found.reason}.")
    axis = Axis.of(space)
    values = torch.tensor([[entry.value for entry in found.parameters.values()]], dtype=torch.float64)
    spread = np.random.default_rng(seed).multivariate_normal(np.zeros(len(space.names)), found.covariance, count)
    drawn = axis.bounded(axis.places(values) + torch.from_numpy(spread))
    return [dict(zip(space.names, row, strict=True)) for row in drawn.tolist()]


def noise_quantile(clusters: int, level: float) -> float:
    """Deviations that an interval of this level reaches to both sides, if its variance is that of so many clusters."""
    return float(stdtrit(max(clusters - 1, 1), 0.5 + level / 2))


def significant(low: float | None, high: float | None) -> Callable[[float | None], str]:
    """What prints a number with as many digits as its interval bears: two where it is known within some tens of per cent,
    three within some per cent, and so on; three without an interval."""
    digits = 3
    if low is not None and high is not None and 0 < low < high:
        digits = 2 + min(max(math.floor(-math.log10((high - low) / (high + low))), 0), 4)

    def shown(value: float | None) -> str:
        if value is None:
            return "–"
        text = f"{value:.{digits}g}"
        return f"{float(text):.0f}" if "e+" in text and abs(value) < _PLAIN else text

    return shown


def _node_set_note(scenario: Scenario) -> str:
    """See `Intervals.note`."""
    nodes = scenario.node_sets.get("mass")
    if nodes is None:
        return ""
    return f"mass multiplies {len(nodes)} of {len(scenario.scene.mesh.nodes)} nodes, so stretch / mass is no exact scale"


def _reach(found: Uncertainty, row: NDArray[np.float64], level: float) -> tuple[float, float]:
    """How far the interval of the combination row · places goes below it and above."""
    total = float(row @ (found.covariance - found.sources[STEP_SIZE]) @ row)
    noise, refined = float(row @ found.sources["noise"] @ row), float(row @ found.refined)
    width = 0.0
    if total > 0:
        freedom = max(found.clusters - 1, 1) / max(noise / total, 1e-6) ** 2
        width = _quantile(freedom, abs(refined) / math.sqrt(total), level) * math.sqrt(total)
    return width + max(-refined, 0.0), width + max(refined, 0.0)


def _quantile(freedom: float, length: float, level: float) -> float:
    """Deviations c that an interval reaches beyond both ends of a range, so that it holds a truth at either end with this
    probability.

    Args:
        freedom: degrees of freedom of Student's t.
        length: of the range, in deviations. Of none, c is the two-sided quantile; of an endless one, the one-sided.
    """

    def too_much(c: float) -> float:
        return float(stdtr(freedom, c + length) - stdtr(freedom, -c) - level)

    if too_much(0.0) >= 0:
        return 0.0
    most = 1.001 * stdtrit(freedom, 0.5 + level / 2)  # that of no length, and a little more for rounding
    return float(brentq(too_much, 0.0, most))


def _ends(space: FitSpace, index: int, value: float, reach: tuple[float, float]) -> tuple[float, float, list[float]]:
    """The interval of one parameter, and the bounds at which it ends."""
    variable, axis = space.variables[index], Axis.of(space)
    values = torch.tensor([[v.low for v in space.variables]] * 3, dtype=torch.float64)
    values[:, index] = value
    places = axis.places(values)
    below, above = (min(one, 700.0) for one in reach)
    places[:, index] += torch.tensor([-below, 0.0, above], dtype=torch.float64)
    low, _, high = axis.values(places)[:, index].tolist()
    bounded = [bound for bound, out in ((variable.low, low <= variable.low), (variable.high, high >= variable.high)) if out]
    return max(low, variable.low), min(high, variable.high), bounded


def _factor(value: float, low: float, high: float) -> float:
    return max(high / value, value / low) if low > 0 else math.inf


def _ratio_row(space: FitSpace) -> NDArray[np.float64] | None:
    if not {"stretch", "mass"} <= set(space.names):
        return None
    row = np.zeros(len(space.names))
    row[space.names.index("stretch")], row[space.names.index("mass")] = 1.0, -1.0
    return row


def _combinations(found: Uncertainty, space: FitSpace, level: float) -> list[Combination]:
    """Principal axes of the covariance, the best-determined first."""
    told = []
    for direction in np.linalg.eigh(found.covariance)[1].T:
        powers = direction / direction[np.abs(direction).argmax()]
        factor = math.exp(min(max(_reach(found, powers, level)), 700.0))
        told.append(
            Combination(
                powers=dict(zip(space.names, powers.tolist(), strict=True)), factor=factor if factor < 1e100 else None
            )
        )
    return told


def _tied(combination: Combination, space: FitSpace) -> set[str]:
    """The parameters whose product a combination is: none where it is one alone, or where one has no logarithm."""
    named = [one for one in space.variables if abs(combination.powers[one.name]) > _SHARE]
    return {one.name for one in named} if len(named) > 1 and all(one.low > 0 for one in named) else set()


def _sources(found: Uncertainty, space: FitSpace, ratio: NDArray[np.float64] | None) -> dict[str, dict[str, float]]:
    rows = dict(zip(space.names, np.eye(len(space.names)), strict=True)) | ({} if ratio is None else {"ratio": ratio})
    main = rows.get("ratio", rows[space.names[0]])
    told = {
        source: {name: math.sqrt(max(float(row @ covariance @ row), 0.0)) for name, row in rows.items()}
        for source, covariance in sorted(found.sources.items(), key=lambda item: -float(main @ item[1] @ main))
    }
    return told


def _misfit(objective: Objective, loss: float) -> tuple[float, float, float]:
    """RMS of one recording beside the fitted motion, what noise and spacing of its points account for [mm], and the RMS as
    a multiple of the largest one at which the model still explains the recording."""
    to_mm = 1e3 * objective.length_unit_m
    rms, over = to_mm * loss**0.5, _over_noise(objective, loss)
    if over is None:
        accounted = noise_mm(objective)
        return rms, accounted, rms / (_UNEXPLAINED_RMS * accounted)
    return rms, to_mm * objective.noise_loss**0.5, (loss / objective.unexplained) ** 0.5


def _over_noise(objective: Objective, loss: float) -> float | None:
    """A loss over what noise and spacing of the points leave; None where it is not known what the recording misses."""
    known = objective.knows_gaps and objective.noise_loss > 0
    return loss / objective.noise_loss if known else None
