"""Intervals of the fitted parameters, a status for each, and the largest sources of uncertainty.

The covariance comes from `estimation.likelihood`. In fit coordinates (logarithms for multipliers), an interval is
symmetric. Its half-width is the standard deviation times the quantile of the normal distribution. Intervals end at the
bounds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import ConfigDict, ValidationError
from scipy.special import ndtri

from diffcloud.errors import ConfigError
from diffcloud.estimation.likelihood import FOLLOWS
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.record import FitRecord
from diffcloud.estimation.residuals import Axis
from diffcloud.estimation.result import physical_values
from diffcloud.estimation.settings import IDENTIFIED_FACTOR, LEVEL
from diffcloud.io.files import read_json
from diffcloud.io.schema import Plain
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.properties import PARAMETERS

ParameterStatus = Literal[
    "identified",
    "ratio_only",
    "combination_only",
    "prior_dominated",
    "mesh_dependent",
    "not_identified",
    "model_error",
]
_PLAIN = 1e6
"""Numbers below this are written without an exponent."""
_ENDLESS = 700.0
"""Largest logarithm of a factor, to avoid overflow."""
_UNFINISHED = "the descent took all its steps before it arrived: give it more with --max-steps"
_PRIOR = 0.5
"""Fraction of the variance above which a parameter is prior-dominated."""
_SHARE = 1 / 3
"""Minimum component of a parameter that belongs to a combination."""


def worded(status: str) -> str:
    """Return a status as readable text: `ratio_only` is "ratio only"."""
    return status.replace("_", " ")


class _Model(Plain):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=True)


class Interval(_Model):
    """Interval of one parameter."""

    value: float
    """Fitted value in `unit`, like both ends."""
    low: float
    high: float
    unit: str
    nominal: float
    """Value of the scene's own material, to which the multiplier refers; 1 if the parameter has no multiplier."""
    factor: float | None
    """Ratio of the value and the farther end, at least 1."""
    at_bounds: list[float]
    """Bounds at which the interval ends; it is one-sided there."""
    status: ParameterStatus


class RatioInterval(_Model):
    """Interval of the ratio of stretching to density [m²/s²]."""

    value: float
    low: float
    high: float
    nominal: float
    """Ratio of the scene's own material."""
    factor: float


class Combination(_Model):
    """A product of powers of the parameters, and the factor within which it is known."""

    powers: dict[str, float]
    factor: float | None

    def __str__(self) -> str:
        return " · ".join(f"{name}^{power:+.2f}" for name, power in self.powers.items() if abs(power) > 0.05)


class Intervals(_Model):
    """Intervals of one fit."""

    level: float
    within: float
    parameters: dict[str, Interval]
    ratio: RatioInterval | None
    best: Combination | None
    """Best-determined combination; None for a single parameter."""
    worst: Combination | None
    sources: dict[str, dict[str, float]]
    """Source of uncertainty, the largest first -> parameter (or `ratio`) -> standard deviation in fit coordinates.
    These are logarithms, or fractions of the range if the lower bound is zero."""
    covariance: list[list[float]]
    fits_to_noise: bool
    """Whether the model fits every recording to within noise in most of the used frames."""
    reason: str
    """Why the model does not fit; else empty."""
    warning: str = ""
    """Why the intervals may still be wrong; else empty."""
    note: str = ""
    """Why the ratio is not an exact invariant if the density acts on a part of the cloth; else empty."""
    mesh_note: str = ""
    """Why the bending stiffness depends on the mesh; else empty."""

    @property
    def sentences(self) -> list[str]:
        """Reason, warning and notes as sentences."""
        texts = (self.reason, self.warning, self.note, self.mesh_note)
        return [text[0].upper() + text[1:] + "." for text in texts if text]


@dataclass(frozen=True)
class _Known:
    """Covariance of k requested parameters."""

    sources: Mapping[str, NDArray[np.float64]]
    """Source -> its contribution [k, k] to the covariance, in fit coordinates."""
    quantile: float
    """Half-width of an interval in standard deviations."""

    @cached_property
    def covariance(self) -> NDArray[np.float64]:
        """[k, k] covariance."""
        return np.sum(list(self.sources.values()), axis=0)

    def reach(self, row: NDArray[np.float64]) -> float:
        """Return the half-width of the interval of a linear combination of the coordinates."""
        return self.quantile * math.sqrt(max(float(row @ self.covariance @ row), 0.0))


def intervals_of(
    record: FitRecord, space: FitSpace, scenario: Scenario, *, level: float = LEVEL, within: float = IDENTIFIED_FACTOR
) -> Intervals:
    """Return the intervals of a fit by `likelihood`.

    Args:
        space: variables of the fit.
        scenario: scenario of its first recording.
        level: probability of the intervals.
        within: factor within which a parameter counts as identified.

    Raises:
        ConfigError: the fit is by another solver, which has no uncertainty.
    """
    told = record.estimate
    if told is None:
        raise ConfigError(f"Only a fit by the solver likelihood has intervals; this one is by {record.solver}.")
    space, values = space.asked, told.mean
    sources = {name: np.array(rows) for name, rows in told.sources.items()}
    found = _Known(sources, float(ndtri(0.5 + level / 2)))
    ratio_row = _ratio_row(space)
    ratio = None if ratio_row is None else _ratio(values, found.reach(ratio_row), scenario)
    combinations = _combinations(found, space)
    fits_to_noise, reason = _followed(record)
    mesh_note = _mesh_note(record, values, scenario) if fits_to_noise and "bending" in space.names else ""
    parameters = {}
    for index, variable in enumerate(space.variables):
        name = variable.name
        low, high, bounded = _ends(space, index, values[name], found.reach(np.eye(len(space.names))[index]))
        factor = _factor(values[name], low, high)
        prior = found.sources.get("prior")
        status: ParameterStatus
        if not fits_to_noise:
            status = "model_error"
        elif prior is not None and prior[index, index] > _PRIOR * found.covariance[index, index]:
            status = "prior_dominated"
        elif name == "bending" and mesh_note:
            status = "mesh_dependent"
        elif factor <= within and not bounded:
            status = "identified"
        elif name in ("stretching", "density") and ratio is not None and ratio.factor <= within:
            status = "ratio_only"
        elif any(name in _tied(one, space) for one in combinations if one.factor is not None and one.factor <= within):
            status = "combination_only"
        else:
            status = "not_identified"
        nominal = scenario.nominal(name)
        parameters[name] = Interval(
            value=values[name] * nominal,
            low=low * nominal,
            high=high * nominal,
            unit=PARAMETERS[name].unit,
            nominal=nominal,
            factor=factor if math.isfinite(factor) else None,
            at_bounds=[bound * nominal for bound in bounded],
            status=status,
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
        covariance=found.covariance.tolist(),
        fits_to_noise=fits_to_noise,
        reason=reason,
        warning=_UNFINISHED if fits_to_noise and record.stop_reason == "iterations" else "",
        note="" if ratio is None else _node_set_note(scenario),
        mesh_note=mesh_note,
    )


def stated_parameters(record: FitRecord, found: Intervals | None, scenario: Scenario) -> dict[str, dict[str, Any]]:
    """Return value, unit, low, high and status of each requested parameter, in SI units.

    Args:
        found: intervals of the fit; without them, low, high and status are None.
        scenario: scenario of the first recording.
    """
    if found is not None:
        kept = {"value", "unit", "low", "high", "status"}
        return {name: one.model_dump(include=kept) for name, one in found.parameters.items()}
    return {
        name: {"value": one.value, "unit": one.unit, "low": None, "high": None, "status": None}
        for name, one in physical_values(scenario, record.fitted).items()
    }


def _ratio(values: Mapping[str, float], reach: float, scenario: Scenario) -> RatioInterval:
    nominal = scenario.nominal("stretching") / scenario.nominal("density")
    value, factor = nominal * values["stretching"] / values["density"], math.exp(min(reach, _ENDLESS))
    return RatioInterval(value=value, low=value / factor, high=value * factor, nominal=nominal, factor=factor)


def _followed(record: FitRecord) -> tuple[bool, str]:
    """Return whether the model fits every recording in most of the used frames, and the reason if it does not."""
    assert record.estimate is not None
    for one, told in zip(record.episodes, record.estimate.recordings, strict=True):
        chi_squares = np.array(told.chi_squares)
        if np.median(chi_squares) > FOLLOWS:
            times = math.sqrt(float(np.median(chi_squares)))
            return False, (
                f"in {one.name} the cloth is {times:.1f} times as far from the recording as noise, spacing and mesh "
                "account for: check the size, the grasp, the gripper's track, and whether clouds hold more than the cloth"
            )
    return True, ""


def read_intervals(path: Path, space: FitSpace) -> Intervals:
    """Read the intervals of a fit.

    Args:
        space: variables of the fit.

    Raises:
        ConfigError: the file is missing or damaged, has no intervals, or belongs to a fit of other parameters.
    """
    try:
        found = Intervals.model_validate(read_json(path, error=ConfigError))
    except ValidationError as error:
        raise ConfigError(
            f"{path} holds no intervals, as `diffcloud fit` writes them. Run `diffcloud fit` again."
        ) from error
    shape, count = np.shape(np.array(found.covariance, dtype=object)), len(space.names)
    if tuple(found.parameters) != space.names or shape != (count, count) or not np.isfinite(found.covariance).all():
        told = ", ".join(found.parameters)
        raise ConfigError(f"{path} holds intervals of {told}; the fit is of {', '.join(space.names)}.")
    return found


def draws(found: Intervals, space: FitSpace, count: int, seed: int) -> list[dict[str, float]]:
    """Sample sets of multipliers from the estimated distribution: normal in fit coordinates, clipped to the bounds.

    Raises:
        ConfigError: the model does not fit its recording, so the covariance is invalid.
    """
    if found.reason:
        raise ConfigError(f"Nothing can be drawn from these intervals: {found.reason}.")
    axis = Axis.of(space)
    values = torch.tensor([[one.value / one.nominal for one in found.parameters.values()]], dtype=torch.float64)
    spread = np.random.default_rng(seed).multivariate_normal(np.zeros(len(space.names)), found.covariance, count)
    drawn = axis.bounded(axis.places(values) + torch.from_numpy(spread))
    return [dict(zip(space.names, row, strict=True)) for row in drawn.tolist()]


def significant(low: float | None, high: float | None) -> Callable[[float | None], str]:
    """Return a function that formats a number with as many digits as its interval justifies. It uses two digits if the
    number is known within tens of percent, three within a few percent, and so on. Without an interval it uses three."""
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
    """Return `Intervals.note`."""
    nodes = scenario.node_sets.get("density")
    if nodes is None:
        return ""
    return f"density multiplies {len(nodes)} of {len(scenario.scene.mesh.nodes)} nodes, so their ratio is no exact scale"


def _mesh_note(record: FitRecord, values: Mapping[str, float], scenario: Scenario) -> str:
    """Return `Intervals.mesh_note`. Recordings that this simulator made on the same mesh need none.

    Under its weight, a cloth folds with radii of about its bending length, (B / (ρ g))^(1/3) (Peirce, The "handle" of cloth
    as a measurable quantity, J. Textile Institute 1930). Longer edges cannot bend like that, and act stiffer.
    """
    assert record.estimate is not None
    gravity = float(np.linalg.norm(scenario.scene.surrounding.gravity)) * scenario.length_unit_m
    if gravity == 0 or not np.any(record.estimate.sources.get("mesh", 0.0)):
        return ""
    density = record.parameters["density"].value if "density" in record.parameters else scenario.nominal("density")
    folds = (values["bending"] * scenario.nominal("bending") / (density * gravity)) ** (1 / 3)
    edges = math.sqrt(2 * float(scenario.scene.mesh.face_area.mean())) * scenario.length_unit_m
    if folds >= edges:
        return ""
    return (
        f"the bending stiffness holds for this mesh only: its edges are {1e3 * edges:.0f} mm long, and the bending length "
        f"of the cloth is {1e3 * folds:.0f} mm; use more nodes"
    )


def _ends(space: FitSpace, index: int, value: float, reach: float) -> tuple[float, float, list[float]]:
    """Return the interval of one parameter, and the bounds at which it ends."""
    variable, axis = space.variables[index], Axis.of(space)
    values = torch.tensor([[v.low for v in space.variables]] * 3, dtype=torch.float64)
    values[:, index] = value
    places = axis.places(values)
    places[:, index] += min(reach, _ENDLESS) * torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    low, _, high = axis.values(places)[:, index].tolist()
    bounded = [bound for bound, out in ((variable.low, low <= variable.low), (variable.high, high >= variable.high)) if out]
    return max(low, variable.low), min(high, variable.high), bounded


def _factor(value: float, low: float, high: float) -> float:
    return max(high / value, value / low) if low > 0 else math.inf


def _ratio_row(space: FitSpace) -> NDArray[np.float64] | None:
    if not {"stretching", "density"} <= set(space.names):
        return None
    row = np.zeros(len(space.names))
    row[space.names.index("stretching")], row[space.names.index("density")] = 1.0, -1.0
    return row


def _combinations(found: _Known, space: FitSpace) -> list[Combination]:
    """Return the principal axes of the covariance, the best-determined first."""
    told = []
    for direction in np.linalg.eigh(found.covariance)[1].T:
        powers = direction / direction[np.abs(direction).argmax()]
        factor = math.exp(min(found.reach(powers), _ENDLESS))
        told.append(
            Combination(
                powers=dict(zip(space.names, powers.tolist(), strict=True)), factor=factor if factor < 1e100 else None
            )
        )
    return told


def _tied(combination: Combination, space: FitSpace) -> set[str]:
    """Return the parameters of a combination; empty for a single parameter, or if a parameter has no logarithm."""
    named = [one for one in space.variables if abs(combination.powers[one.name]) > _SHARE]
    return {one.name for one in named} if len(named) > 1 and all(one.low > 0 for one in named) else set()


def _sources(found: _Known, space: FitSpace, ratio: NDArray[np.float64] | None) -> dict[str, dict[str, float]]:
    rows = dict(zip(space.names, np.eye(len(space.names)), strict=True)) | ({} if ratio is None else {"ratio": ratio})
    main = rows.get("ratio", rows[space.names[0]])
    told = {
        source: {name: math.sqrt(max(float(row @ covariance @ row), 0.0)) for name, row in rows.items()}
        for source, covariance in sorted(found.sources.items(), key=lambda item: -float(main @ item[1] @ main))
    }
    return told
