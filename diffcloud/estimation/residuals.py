"""How a motion changes with what is fitted.

Variables are fitted on an axis of their own: the logarithm of a value whose lower bound is positive, the standard
deviations off zero of one with a normal prior, else the part of its range. Where the integrator's derivatives hold over
finite distances (the implicit one: docs/results/gradients.md), they are forward tangents, from one simulation. The
arcsim integrator's contact is rough: there, motions a finite step to both sides give the differences.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffcloud.errors import DivergedError
from diffcloud.estimation.inputs import Inputs
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.sim.integrators import load_integrator
from diffcloud.sim.simulate import Rollout

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
    zero: Tensor
    """[k] value at place zero of those that are not."""
    scale: Tensor
    """[k] from there to place one."""

    @staticmethod
    def of(space: FitSpace) -> Axis:
        low, high = (
            torch.tensor([getattr(variable, end) for variable in space.variables], dtype=torch.float64)
            for end in ("low", "high")
        )
        deviations = torch.tensor([variable.deviation or 0.0 for variable in space.variables], dtype=torch.float64)
        normal = deviations > 0
        return Axis(low, high, low > 0, torch.where(normal, 0.0, low), torch.where(normal, deviations, high - low))

    @property
    def ends(self) -> tuple[Tensor, Tensor]:
        """[k] where the bounds lie."""
        return self.places(self.low), self.places(self.high)

    def places(self, values: Tensor) -> Tensor:
        """[..., k] values -> places on the axis."""
        safe = torch.where(self.logarithmic, values, 1.0)
        return torch.where(self.logarithmic, safe.log(), (values - self.zero) / self.scale)

    def values(self, places: Tensor) -> Tensor:
        """The inverse of `places`. A place on a bound may be off it by rounding."""
        return torch.where(self.logarithmic, places.exp(), self.zero + self.scale * places)

    def bounded(self, places: Tensor) -> Tensor:
        """The same, no digit beyond a bound; a derivative would end there."""
        return torch.minimum(torch.maximum(self.values(places), self.low), self.high)


def by_tangents(objective: Objective) -> bool:
    """Whether the derivatives of its integrator hold over finite distances."""
    return load_integrator(objective.scenario.scene.integrator).smooth


@dataclass(frozen=True)
class Moved:
    """Motions of B places."""

    run: Rollout
    rates: Tensor
    """[k, B, L, C · V, 3] of their nodes at the compared frames, as `Objective.looked_at` has them."""


def moved_by(objective: Objective, space: FitSpace, places: Tensor) -> Moved:
    """Motions of B places [B, k], and how they change."""
    return (_by_tangents if by_tangents(objective) else _by_differences)(objective, space, places)


def _by_tangents(objective: Objective, space: FitSpace, places: Tensor) -> Moved:
    axis = Axis.of(space)

    def given(at: Tensor) -> Inputs:
        return objective.inputs(space.parameters(axis.values(at)), objective.loss_steps)

    def inputs(at: Tensor) -> tuple[Tensor, ...]:
        return given(at).tensors()

    rates = [torch.cat(parts) for parts in zip(*_along(inputs, places, _ways(places)), strict=True)]
    run, moves = given(places).rollout_tangents(rates)
    return Moved(run, torch.stack([objective.looked_at(replace(run, positions=move)) for move in moves]))


def _by_differences(objective: Objective, space: FitSpace, places: Tensor) -> Moved:
    """
    Raises:
        DivergedError: names the places beside which a motion diverges, or at which.
    """
    axis, count = Axis.of(space), len(places)
    above, below = _sides(axis, places)
    every = torch.cat([places[None], above, below]).flatten(0, 1)
    try:
        run = objective.simulate_to_loss(space.parameters(axis.values(every)))
    except DivergedError as error:
        entries = sorted({entry % count for entry in error.entries})
        raise DivergedError(error.step, entries, error.reason, error.parameters) from error
    here, beside = (
        replace(run, positions=run.positions[part], velocities=run.velocities[part])
        for part in (slice(count), slice(count, None))
    )
    there = objective.looked_at(beside).unflatten(0, (2, -1, count))
    width = (above - below).sum(-1)  # halved at a bound
    return Moved(here, (there[0] - there[1]) / width[..., None, None, None])


def _sides(axis: Axis, places: Tensor) -> Tensor:
    """[2, k, B, k] places above and below each of B places [B, k], along each variable, between the bounds."""
    low, high = axis.ends
    steps = STEP * _ways(places)
    return torch.stack([torch.minimum(torch.maximum(places + sign * steps, low), high) for sign in (1, -1)])


def _ways(places: Tensor) -> Tensor:
    """[k, B, k] each variable's direction."""
    return torch.eye(places.shape[1], dtype=places.dtype)[:, None].expand(-1, len(places), -1)


@torch.enable_grad()
def _along(function: Callable[[Tensor], tuple[Tensor, ...]], at: Tensor, ways: Tensor) -> list[tuple[Tensor, ...]]:
    """The directional derivatives of tensors, by reverse mode twice, from sums alone: torch's forward mode takes seconds to
    start, and so does its reverse mode with weights of one's own."""
    at = at.detach().requires_grad_()
    values = function(at)
    weights = [torch.zeros_like(value, requires_grad=True) for value in values]
    weighted = torch.stack([(value * weight).sum() for value, weight in zip(values, weights, strict=True)]).sum()
    (slope,) = torch.autograd.grad(weighted, at, create_graph=True)  # linear in the weights
    return [torch.autograd.grad((slope * way).sum(), weights, retain_graph=True, materialize_grads=True) for way in ways]
