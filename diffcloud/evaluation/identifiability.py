"""What an episode says about the parameters: Gauss-Newton matrix, intervals measured on the loss itself, and a verdict.

The loss is the mean of d_i², d_i the distance of sampled point i to the nearest recorded point. With u the logarithms of
the parameters (of those whose lower bound is zero: the value as a part of its range),

    loss(u + δ) - loss(u)  ≈  δᵀ H δ,      H = mean_i J_i J_iᵀ,      J_i = ∂d_i / ∂u

near an optimum: the Gauss-Newton matrix of the residuals d_i. Distances, not vectors to the nearest points: a cloth that
slides along itself changes the vectors, but no camera sees it. J is a central difference of batched simulations over a
few per cent, not a derivative: after contact the loss is rough, and its exact slope is right in the small only.

H gives directions and how fast the loss should rise along each. How far one can really go before the loss tells is
measured: a batch of simulations along each eigenvector, both ways, out to the bounds. The interval ends where the rise
is still within two standard deviations of what new sampled points change, while it is more from three times as far on.
The check then simulates the ends, and three times as far, with points that were not used before. Where contact makes the
loss so rough that no length is like that, no interval is stated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloud.fit import FitSpace, Objective
from diffcloud.fit.batches import without_diverged
from diffcloud.scene.scenarios import Scenario

Verdict = Literal["identified", "only the ratio", "only a combination", "not identified", "too rough to tell"]
IDENTIFIED_WITHIN = 1.5
"""A parameter or ratio counts as identified if the interval ends within this factor of the fitted value."""
_STEP = 0.05
"""Of the central differences, in logarithms."""
_SHORTEST = 0.0005
"""First step of the scan along a direction, in logarithms."""
_STEPS = (2, 4)
"""Steps of a scan to three times as far, and of a finer one, which has those of the coarse one among its own."""
_MORE = 4
"""How many times the draws of points that a loss is averaged over elsewhere."""
_FARTHER = 3.0
"""How many intervals away the loss must be clearly higher."""
_HARDLY, _CLEARLY = 0.7, 1.4
"""Rises in units of the noise that a scan takes for hidden and for told, so that the check agrees with points not seen
before. Between lengths of a quadratic loss that are so there is a factor of two: more than a step of the scan."""
_SPARE = 1.2
"""The least margin, as a factor on both sides of the noise, of an interval that is stated at all."""


@dataclass(frozen=True)
class Coordinates:
    """Logarithms of the fitted parameters, or parts of the range where the lower bound is zero."""

    space: FitSpace

    def of(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        """name -> value to [k]."""
        return np.array(
            [
                math.log(values[v.name]) if v.low > 0 else (values[v.name] - v.low) / (v.high - v.low)
                for v in self.space.variables
            ]
        )

    def values(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """[B, k] coordinates to values."""
        columns = [
            np.exp(column) if v.low > 0 else v.low + (v.high - v.low) * np.maximum(column, 0.0)
            for v, column in zip(self.space.variables, places.T, strict=True)
        ]
        return np.stack(columns, axis=-1)

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """[k] lowest and highest coordinates."""
        low, high = ({v.name: getattr(v, end) for v in self.space.variables} for end in ("low", "high"))
        return self.of(low), self.of(high)


def identify(
    objective: Objective, space: FitSpace, values: Mapping[str, float], *, draws: int = 4, seed: int = 2000
) -> dict[str, Any]:
    """What the loss at the optimum says about the parameters.

    Args:
        objective: of the fit, on one episode.
        space: the fitted parameters.
        values: the fitted ones.
        draws: of sampled points that a loss is averaged over elsewhere, whose noise is the measure. What is measured
            here is averaged over four times as many: one draw costs little beside a simulation.
        seed: of the first draw.

    Returns (all plain numbers):
        noise: what new points change: two standard deviations of the mean loss over `draws`;
        matrix [k][k], eigenvalues [k] (descending) and directions [k][k] (rows) in coordinates;
        predicted [k]: half-widths that the eigenvalues predict;
        interval [k][2]: measured, against and along each direction, None where the loss is too rough for one;
        open [k][2]: whether it ends at a bound;
        check: rises at each end of an interval and at three times as far, and whether they agree;
        half_widths (None without any interval), verdicts: by parameter; ratio_half_width; combination;
        lower: the lowest loss met, if it is lower;
        scale: see `_scale`.
    """
    probe = _Probe(objective, space, draws, seed)
    coordinates = Coordinates(space)
    centre = coordinates.of(values)
    noise, matrix = probe.noise(centre), _gauss_newton(probe, coordinates, centre)
    eigenvalues, columns = np.linalg.eigh(matrix)
    order = np.argsort(eigenvalues)[::-1]
    eigenvalues, directions = np.maximum(eigenvalues[order], 0.0), _signed(columns[:, order].T)
    predicted = np.sqrt(_HARDLY * noise / np.maximum(eigenvalues, 1e-300))
    interval, open_ends, lowest = _scan(probe, centre, directions, noise)
    widths = np.fmax(interval[:, 0], interval[:, 1])  # a direction that is rough on one side has that of the other
    half_widths = np.sqrt(((directions * widths[:, None]) ** 2).sum(axis=0))
    names = list(space.names)
    told: dict[str, Any] = {
        "parameters": names,
        "noise": noise,
        "matrix": matrix.tolist(),
        "eigenvalues": eigenvalues.tolist(),
        "directions": directions.tolist(),
        "predicted": [_finite(value) for value in predicted],
        "interval": [[_finite(end) for end in ends] for ends in interval],
        "open": open_ends.tolist(),
        "half_widths": {name: _finite(value) for name, value in zip(names, half_widths, strict=True)},
        "check": _check(probe, centre, directions, interval, noise),
        "lower": lowest,
        "scale": _scale(objective, space, values, probe, noise),
    }
    if {"stretch", "mass"} <= set(names):
        row = directions[:, names.index("stretch")] - directions[:, names.index("mass")]
        told["ratio_half_width"] = _finite(np.sqrt(((row * widths) ** 2).sum()))
    told["combination"] = _combination(names, directions[0])
    found = verdicts(names, half_widths, directions, widths, told.get("ratio_half_width"))
    told["verdicts"] = dict(zip(names, found, strict=True))
    return told


def verdicts(
    names: Sequence[str],
    half_widths: NDArray[np.float64],
    directions: NDArray[np.float64],
    widths: NDArray[np.float64],
    ratio: float | None,
) -> list[Verdict]:
    """A verdict per parameter from half-widths in logarithms.

    Args:
        half_widths: [k] of the parameters; NaN if the loss is too rough along a direction.
        directions: [k, k] eigenvectors, in rows.
        widths: [k] of the directions.
        ratio: of stretch to mass, if both are fitted.
    """
    near = math.log(IDENTIFIED_WITHIN)
    # a parameter has its part in a combination that is known: more than a third of the direction's length
    shared: NDArray[np.bool_] = np.any((np.abs(directions) > 1 / 3) & (widths <= near)[:, None], axis=0)
    found: list[Verdict] = []
    for index, name in enumerate(names):
        if math.isnan(half_widths[index]):
            found.append("too rough to tell")
        elif half_widths[index] <= near:
            found.append("identified")
        elif name in ("stretch", "mass") and ratio is not None and ratio <= near:
            found.append("only the ratio")
        else:
            found.append("only a combination" if shared[index] else "not identified")
    return found


class _Probe:
    """Mean losses of many places, over the same draws of points."""

    def __init__(self, objective: Objective, space: FitSpace, draws: int, seed: int) -> None:
        self._objective, self.space, self.draws, self.seed = objective, space, draws, seed
        self._coordinates = Coordinates(space)

    def losses(self, places: NDArray[np.float64], *, first: int = 0, draws: int | None = None) -> NDArray[np.float64]:
        """[draws, B] at coordinates [B, k]; infinite where the simulation diverges. `first`: draw to begin with."""
        values = torch.as_tensor(self._coordinates.values(places)).double()
        return self.losses_of(self.space.parameters(values), first=first, draws=draws)

    def losses_of(
        self, parameters: Mapping[str, Tensor], *, first: int = 0, draws: int | None = None
    ) -> NDArray[np.float64]:
        """[draws, B] of parameter sets."""
        count, draws = len(next(iter(parameters.values()))), draws or self.draws
        seeds = range(self.seed + first, self.seed + first + draws)

        def losses(part: Tensor, kept: Tensor) -> Tensor:
            index = part[kept]
            run = self._objective.simulate({name: value[index] for name, value in parameters.items()})
            self._objective.reseed(self.seed)
            pose, rows = self._objective.pose(run), []
            for seed in seeds:
                self._objective.reseed(seed)
                rows.append(self._objective.frame_losses(run, pose=pose).mean(-1))
            return torch.stack(rows)

        found = np.full((draws, count), np.inf)
        with torch.no_grad():
            for begin in range(0, count, _CHUNK):
                part = torch.arange(begin, min(begin + _CHUNK, count))
                rows, kept, _ = without_diverged(len(part), partial(losses, part))
                if rows is not None:
                    found[:, part[kept].numpy()] = rows.numpy()
        return found

    def distances(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """[B, N] distance of every sampled point to its nearest recorded one, of all frames and draws."""
        values = torch.as_tensor(self._coordinates.values(places)).double()
        found = []
        with torch.no_grad():
            run = self._objective.simulate(self.space.parameters(values))
            self._objective.reseed(self.seed)
            pose = self._objective.pose(run)
            for seed in range(self.seed, self.seed + self.draws):
                self._objective.reseed(seed)
                points = self._objective.points(run, pose=pose)
                for frame, cloud in enumerate(self._objective.clouds):
                    found.append((points[:, frame] - cloud.nearest(points[:, frame])).norm(dim=-1))
        return torch.cat(found, dim=-1).numpy()

    def noise(self, centre: NDArray[np.float64]) -> float:
        """Two standard deviations of the mean loss over `draws` draws."""
        losses = self.losses(centre[None], draws=_MORE * self.draws)[:, 0]
        return float(2.0 * losses.std(ddof=1) / math.sqrt(self.draws))


_CHUNK = 20
"""Parameter sets simulated together, as in `Objective`."""


def _gauss_newton(probe: _Probe, coordinates: Coordinates, centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """[k, k]"""
    count = len(centre)
    places = np.concatenate([centre + _STEP * np.eye(count), centre - _STEP * np.eye(count)])
    # what was clamped at a lower bound of zero has moved less
    moved = [coordinates.of(dict(zip(coordinates.space.names, row, strict=True))) for row in coordinates.values(places)]
    width = (np.stack(moved[:count]) - np.stack(moved[count:])).diagonal()
    distances = probe.distances(places)
    jacobian = (distances[:count] - distances[count:]) / width[:, None]  # [k, N]
    return jacobian @ jacobian.T / jacobian.shape[1]


def _signed(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """The largest component positive: the same direction has one name."""
    largest = np.abs(directions).argmax(axis=1)
    return directions * np.sign(directions[np.arange(len(directions)), largest])[:, None]


def _reach(centre: NDArray[np.float64], direction: NDArray[np.float64], coordinates: Coordinates) -> float:
    """How far one can go along a direction within the bounds."""
    low, high = coordinates.bounds()
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.where(direction > 0, (high - centre) / direction, (low - centre) / direction)
    return max(0.0, float(ends[np.abs(direction) > 1e-12].min()))


def _scan(
    probe: _Probe, centre: NDArray[np.float64], directions: NDArray[np.float64], noise: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_], dict[str, float] | None]:
    """[k, 2] intervals against and along each direction (NaN: too rough), whether each ends at a bound, and the lowest loss
    if it is lower than the centre's by more than the noise."""
    coordinates = Coordinates(probe.space)
    rays = np.stack([-directions, directions], axis=1).reshape(-1, len(centre))  # [2 k, k]
    reach = [_reach(centre, ray, coordinates) for ray in rays]
    lengths = [np.empty(0) for _ in rays]
    rises = [np.empty(0) for _ in rays]
    lowest, place = float("inf"), centre
    for steps in _STEPS:  # finer ones only where the coarse ones give no interval
        wanted = [
            np.setdiff1d(_lengths(far, steps), known) if _longest(known, rise) is None else np.empty(0)
            for far, known, rise in zip(reach, lengths, rises, strict=True)
        ]
        if not any(map(len, wanted)):
            break
        places = np.concatenate(
            [centre[None], *(centre + length[:, None] * ray for length, ray in zip(wanted, rays, strict=True))]
        )
        losses = probe.losses(places, draws=_MORE * probe.draws).mean(axis=0)
        if losses.min() < lowest:
            lowest, place = float(losses.min()), places[int(losses.argmin())]
        found = np.split((losses[1:] - losses[0]) / noise, np.cumsum([len(length) for length in wanted])[:-1])
        for index, (length, rise) in enumerate(zip(wanted, found, strict=True)):
            order = np.argsort(both := np.append(lengths[index], length))
            lengths[index], rises[index] = both[order], np.append(rises[index], rise)[order]
    ends = [_end(length, rise) for length, rise in zip(lengths, rises, strict=True)]
    interval = np.array([np.nan if end is None else length[end] for length, end in zip(lengths, ends, strict=True)])
    open_ = np.array([end == len(length) - 1 for length, end in zip(lengths, ends, strict=True)])
    lower = None
    if lowest < losses[0] - noise:
        found_values = coordinates.values(place[None])[0]
        lower = {"loss": lowest, "loss_fitted": float(losses[0])}
        lower |= dict(zip(probe.space.names, found_values.tolist(), strict=True))
    return interval.reshape(-1, 2), open_.reshape(-1, 2), lower


def _lengths(reach: float, steps: int) -> NDArray[np.float64]:
    """Distances to try: from the shortest on, each with its threefold among them, and at the bound (which may be where one
    stands)."""
    count = max(0, math.ceil(steps * math.log(max(reach, 1e-300) / _SHORTEST, _FARTHER)))
    threefold, part = np.divmod(np.arange(count), steps)
    inner = _SHORTEST * _FARTHER ** (part / steps) * _FARTHER ** threefold.astype(float)
    return np.append(inner[inner < 0.999 * reach], reach)


def _end(lengths: NDArray[np.float64], rise: NDArray[np.float64]) -> int | None:
    """Index of the length at which an interval ends, None where the loss is too rough for any.

    The longest that keeps, with something to spare for points not yet seen, what an interval promises: there the loss
    tells hardly, and three times as far, and anywhere beyond that, it does. If there is none, the one that keeps it with
    most to spare.

    Args:
        lengths: ascending.
        rise: of the loss at each length, in units of the noise.
    """
    longest = _longest(lengths, rise)
    if longest is not None:
        return longest
    spare = np.minimum(1 / np.maximum(rise, 1e-9), _beyond(lengths, rise))
    return int(spare.argmax()) if spare.max() > _SPARE else None


def _longest(lengths: NDArray[np.float64], rise: NDArray[np.float64]) -> int | None:
    kept = np.flatnonzero((rise <= _HARDLY) & (_beyond(lengths, rise) > _CLEARLY))
    return int(kept[-1]) if len(kept) else None


def _beyond(lengths: NDArray[np.float64], rise: NDArray[np.float64]) -> NDArray[np.float64]:
    """The lowest rise three times as far, or farther, than each length; infinite where that lies beyond the bounds."""
    return np.array([rise[lengths > 0.999 * _FARTHER * length].min(initial=np.inf) for length in lengths])


def _check(
    probe: _Probe,
    centre: NDArray[np.float64],
    directions: NDArray[np.float64],
    interval: NDArray[np.float64],
    noise: float,
) -> list[dict[str, Any]]:
    """Rises at the ends of all intervals that are stated, and three times as far, with points that nothing above has
    seen."""
    coordinates = Coordinates(probe.space)
    low, high = coordinates.bounds()
    ends = np.stack([-interval[:, 0], interval[:, 1]], axis=1)  # [k, 2], signed
    places = centre + np.stack([ends, _FARTHER * ends], axis=-1)[..., None] * directions[:, None, None]  # [k, 2, 2, k]
    inside: NDArray[np.bool_] = np.all((places >= low - 1e-9) & (places <= high + 1e-9), axis=-1)
    # beyond the bounds nothing is asked of the loss, and a simulation may take minutes to resolve its contacts
    losses = probe.losses(np.concatenate([centre[None], places[inside]]), first=10_000, draws=_MORE * probe.draws).mean(
        axis=0
    )
    rise = np.full(inside.shape, np.nan)
    rise[inside] = losses[1:] - losses[0]
    return [
        {
            "direction": int(index),
            "end": float(ends[index, side]),
            "rise": _finite(rise[index, side, 0]),
            "rise_farther": _finite(rise[index, side, 1]),
            "farther_within_bounds": bool(inside[index, side, 1]),
            "agrees": bool(rise[index, side, 0] <= noise and (rise[index, side, 1] > noise or not inside[index, side, 1])),
        }
        for index, side in np.argwhere(np.abs(ends) > 0)  # nothing to check for a fit on a bound, or without an interval
    ]


def _scale(
    objective: Objective, space: FitSpace, values: Mapping[str, float], probe: _Probe, noise: float
) -> dict[str, float] | None:
    """What doubling and halving everything that has mass in its unit changes, in units of the noise.

    Under gravity and Coulomb friction the motion of a cloth held by rigid grippers does not change if its stiffnesses, its
    mass and the air are all multiplied by one factor. What still changes the loss then has a stiffness of its own: the
    soft handles, and the contact. An identification of the scale that rests on it is an artefact of the simulator.

    Returns:
        fitted: only stretch and mass together; with_bending: bending along; everything: with air and with the mass of all
        nodes. None unless stretch and mass are fitted.
    """
    if not {"stretch", "mass"} <= set(space.names) or "stretch" in objective.scenario.node_sets:
        return None
    scaled = (("stretch", "mass"), ("stretch", "mass", "bending"), ("stretch", "bending", "drag", "density", "body_mass"))
    base = dict.fromkeys(scaled[1] + scaled[2], 1.0) | dict(values) | dict(space.fixed)
    sets = [base] + [base | {name: factor * base[name] for name in group} for group in scaled for factor in (0.5, 2.0)]
    tensors = {name: torch.tensor([one[name] for one in sets], dtype=torch.float64) for name in base}
    losses = probe.losses_of(tensors).mean(axis=0)
    change = np.abs(losses[1:] - losses[0]).reshape(3, 2).max(axis=1) / max(noise, 1e-300)
    labels = ("fitted", "with_bending", "everything")
    return {label: float(min(value, 1e9)) for label, value in zip(labels, change, strict=True)}


def _combination(names: Sequence[str], direction: NDArray[np.float64]) -> str:
    """The best-seen direction as a product of powers, the largest power 1."""
    powers = direction / np.abs(direction).max()
    return " · ".join(f"{name}^{power:+.2f}" for name, power in zip(names, powers, strict=True) if abs(power) > 0.05)


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) and value < 1e100 else None


def node_set_note(scenario: Scenario) -> str:
    """Why the ratio is not what a motion identifies where the mass multiplier acts on a part of the cloth; else empty."""
    nodes = scenario.node_sets.get("mass")
    if nodes is None:
        return ""
    return f"mass multiplies {len(nodes)} of {len(scenario.scene.mesh.nodes)} nodes, so stretch / mass is no exact scale"
