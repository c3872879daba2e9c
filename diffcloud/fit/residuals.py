"""How the loss of simulated points changes with what is fitted, to first and second order.

Variables are fitted on an axis of their own: the logarithm of a value whose lower bound is positive, else the part of its
range. Where the integrator's derivatives hold over finite distances (the implicit one: docs/results/gradients.md), the
motion is linearised by forward tangents, in one simulation. The linearised integrator's contact is rough: there, motions
a finite step to both sides give the differences.

With r = x - y of a simulated point x and the recorded point y nearest to it, the loss is the mean of |r|², and half of its
slope that of r · ∂x. For the curvature, Gauss and Newton would take |∂x|², as if x were bound to the point y. But y is
a sample of a surface, along which x may slide: with the surface's normal n at y, and r's own direction t along the surface,

    curvature = (n · ∂x)² + w (t · ∂x)²,      w = |r_t|² / (|r_t|² + s²),

where s is the distance between recorded points. So w is small inside of the recorded surface and near one where x lies
beyond its rim. (Chen and Medioni 1992 minimise the first part alone.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffcloud.fit.batches import without_diverged
from diffcloud.fit.objective import Objective
from diffcloud.fit.parameters import FitSpace
from diffcloud.sim.properties import Properties
from diffcloud.sim.simulate import rollout_tangents

STEP = 0.05
"""Of the differences, on the axis: 5 % of a value."""


@dataclass(frozen=True)
class Axis:
    """The axis [k] on which variables are fitted."""

    low: Tensor
    """[k] values."""
    high: Tensor
    logarithmic: Tensor
    """bool [k]"""

    @staticmethod
    def of(space: FitSpace) -> Axis:
        low, high = (
            torch.tensor([getattr(variable, end) for variable in space.variables], dtype=torch.float64)
            for end in ("low", "high")
        )
        return Axis(low, high, low > 0)

    @property
    def ends(self) -> tuple[Tensor, Tensor]:
        """[k] where the bounds lie."""
        return self.places(self.low), self.places(self.high)

    def places(self, values: Tensor) -> Tensor:
        """[..., k] values -> places on the axis."""
        safe = torch.where(self.logarithmic, values, 1.0)
        return torch.where(self.logarithmic, safe.log(), (values - self.low) / (self.high - self.low))

    def values(self, places: Tensor) -> Tensor:
        """The inverse of `places`. A place on a bound may be off it by rounding."""
        return torch.where(self.logarithmic, places.exp(), self.low + (self.high - self.low) * places)

    def bounded(self, places: Tensor) -> Tensor:
        """The same, no digit beyond a bound; a derivative would end there."""
        return torch.minimum(torch.maximum(self.values(places), self.low), self.high)


@dataclass(frozen=True)
class Linearisation:
    """The loss at B places, and how it changes."""

    losses: Tensor
    """[B], infinite where the motion diverges."""
    slope: Tensor
    """[B, k] half of the gradient by the places on the axis; zero where the motion diverges."""
    curvature: Tensor
    """[B, k, k] half of the Gauss–Newton matrix."""
    simulations: int


def linearise(objective: Objective, space: FitSpace, places: Tensor) -> Linearisation:
    """The loss at [B, k] places, by the rule that stands at the head of this module."""
    by_tangents = objective.scenario.scene.integrator == "implicit"
    rates_of = _by_tangents if by_tangents else _by_differences

    def run(index: Tensor) -> list[Tensor]:
        parts = [_terms(objective, space, places[index], rates_of, episode) for episode in range(objective.episode_count)]
        return [torch.stack(part).mean(0) for part in zip(*parts, strict=True)]

    with torch.no_grad():
        found, kept, _ = without_diverged(len(places), run)
    count, variables = places.shape
    losses = torch.full((count,), torch.inf, dtype=torch.float64)
    slope, curvature = places.new_zeros(count, variables), places.new_zeros(count, variables, variables)
    if found is not None:
        losses[kept], slope[kept], curvature[kept] = found
    each = 1 if by_tangents else 1 + 2 * variables
    return Linearisation(losses, slope, curvature, each * count * objective.episode_count)


Rates = Callable[[Objective, FitSpace, Tensor, int], tuple[Tensor, Tensor]]
"""Node positions [B, L, V, 3] at the loss frames of an episode, and their rates [k, B, L, V, 3]."""


def _by_tangents(objective: Objective, space: FitSpace, places: Tensor, episode: int) -> tuple[Tensor, Tensor]:
    axis = Axis.of(space)

    def properties(at: Tensor) -> tuple[Tensor, ...]:
        return objective.scenario.properties(objective.system, space.split(axis.values(at))[0]).tensors()

    rates = [_along(properties, places, way) for way in _ways(places)]
    run, moves = rollout_tangents(
        objective.system,
        objective.loss_steps,
        properties=Properties(*properties(places)),
        tangents=Properties(*(torch.cat(parts) for parts in zip(*rates, strict=True))),
        track=objective.track(episode),
    )
    times = objective.times(episode)
    return run.at(times), torch.stack([replace(run, positions=move).at(times) for move in moves])


def _by_differences(objective: Objective, space: FitSpace, places: Tensor, episode: int) -> tuple[Tensor, Tensor]:
    axis = Axis.of(space)
    low, high = axis.ends
    ways = _ways(places)
    above, below = (torch.minimum(torch.maximum(places + sign * STEP * ways, low), high) for sign in (1, -1))
    every = torch.cat([places[None], above, below]).flatten(0, 1)
    run = objective.simulate_to_loss(space.split(axis.values(every))[0], episode=episode)
    here, *others = run.at(objective.times(episode)).split(len(places))
    there = torch.stack(others).unflatten(0, (2, -1))
    width = ((above - below) * ways).sum(-1)  # halved at a bound
    return here, (there[0] - there[1]) / width[..., None, None, None]


def _terms(
    objective: Objective, space: FitSpace, places: Tensor, rates_of: Rates, episode: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Loss [B], slope [B, k] and curvature [B, k, k] of one episode."""
    axis = Axis.of(space)
    positions, rates = rates_of(objective, space, places, episode)

    def points(nodes: Tensor, at: Tensor) -> tuple[Tensor]:
        return (objective.points_of(nodes, space.split(axis.values(at))[1], episode=episode),)

    (simulated,) = points(positions, places)
    moves = torch.stack(
        [
            torch.func.jvp(points, (positions, places), (rate, way))[1][0]
            for rate, way in zip(rates, _ways(places), strict=True)
        ]
    )  # [k, B, L, N, 3]
    parts = []
    for frame, cloud in enumerate(objective.clouds(episode=episode)):
        here, along = simulated[:, frame], moves[:, :, frame]
        nearest = cloud.nearest_index(here)
        away, normal = here - cloud.points[nearest], cloud.normals[nearest]
        flat = away - (away * normal).sum(-1, keepdim=True) * normal
        squared = flat.square().sum(-1)
        rim = flat / (squared + cloud.spacing**2).sqrt()[..., None]  # sqrt(w) t
        rows = torch.stack([(along * one).sum(-1) for one in (normal, rim)])  # [2, k, B, N]
        count = here.shape[1]
        slope = torch.einsum("kbni,bni->bk", along, away) / count
        curvature = torch.einsum("rkbn,rlbn->bkl", rows, rows) / count
        parts.append((away.square().sum(-1).mean(-1), slope, curvature))
    loss, slope, curvature = (torch.stack(part).mean(0) for part in zip(*parts, strict=True))
    return loss, slope, curvature


def _ways(places: Tensor) -> Tensor:
    """[k, B, k] each variable's direction."""
    return torch.eye(places.shape[1], dtype=places.dtype)[:, None].expand(-1, len(places), -1)


def _along(function: Callable[[Tensor], tuple[Tensor, ...]], at: Tensor, way: Tensor) -> tuple[Tensor, ...]:
    """The directional derivative of tensors."""
    return tuple(torch.func.jvp(function, (at,), (way,))[1])
