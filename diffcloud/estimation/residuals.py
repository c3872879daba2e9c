"""Derivatives of a motion with respect to the fitted variables.

Variables are fitted in their own coordinates (`Axis`). The coordinate is the logarithm if the lower bound is positive.
It is the number of standard deviations from zero for a normal prior, and the fraction of the range otherwise. The
implicit integrator's derivatives are valid over finite distances (docs/results/gradients.md), so forward-mode
derivatives from one simulation are used. The contact model of the arcsim integrator is non-smooth. There, central
differences over finite steps are used.
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
"""Step of the central differences in fit coordinates: 5 % of a value."""


@dataclass(frozen=True)
class Axis:
    """Fit coordinates of k variables."""

    low: Tensor
    """[k] lower bounds of the values."""
    high: Tensor
    logarithmic: Tensor
    """bool [k], whether the coordinate is the logarithm."""
    zero: Tensor
    """[k] value at coordinate 0, for variables that are not logarithmic."""
    scale: Tensor
    """[k] difference of the values at coordinates 1 and 0."""

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
        """[k] coordinates of the lower and upper bounds."""
        return self.places(self.low), self.places(self.high)

    def places(self, values: Tensor) -> Tensor:
        """Convert values [..., k] to fit coordinates."""
        safe = torch.where(self.logarithmic, values, 1.0)
        return torch.where(self.logarithmic, safe.log(), (values - self.zero) / self.scale)

    def values(self, places: Tensor) -> Tensor:
        """Return the inverse of `places`. At a bound, rounding errors may exceed the bound."""
        return torch.where(self.logarithmic, places.exp(), self.zero + self.scale * places)

    def bounded(self, places: Tensor) -> Tensor:
        """Return `values` clipped exactly to the bounds; the gradient vanishes outside."""
        return torch.minimum(torch.maximum(self.values(places), self.low), self.high)


def by_tangents(objective: Objective) -> bool:
    """Return whether derivatives of the scenario's integrator are valid over finite distances."""
    return load_integrator(objective.scenario.scene.integrator).smooth


@dataclass(frozen=True)
class Moved:
    """Motions of B parameter sets and their derivatives."""

    run: Rollout
    rates: Tensor
    """[k, B, L, C · V, 3] derivatives of the nodes at the compared frames, in the layout of `Objective.looked_at`."""


def moved_by(objective: Objective, space: FitSpace, places: Tensor) -> Moved:
    """Simulate parameter sets [B, k] in fit coordinates, with derivatives."""
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
    """Simulate parameter sets with central differences.

    Raises:
        DivergedError: names the parameter sets whose motion, or a neighbouring motion, diverges.
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
    """Return coordinates [2, k, B, k] one step above and below [B, k] along each variable, clipped to the bounds."""
    low, high = axis.ends
    steps = STEP * _ways(places)
    return torch.stack([torch.minimum(torch.maximum(places + sign * steps, low), high) for sign in (1, -1)])


def _ways(places: Tensor) -> Tensor:
    """Return the unit vectors [k, B, k] of each variable."""
    return torch.eye(places.shape[1], dtype=places.dtype)[:, None].expand(-1, len(places), -1)


@torch.enable_grad()
def _along(function: Callable[[Tensor], tuple[Tensor, ...]], at: Tensor, ways: Tensor) -> list[tuple[Tensor, ...]]:
    """Return directional derivatives of tensors by applying reverse mode twice. torch's own forward mode takes seconds
    to start, and so does its reverse mode with custom weights. So only sums are differentiated."""
    at = at.detach().requires_grad_()
    values = function(at)
    weights = [torch.zeros_like(value, requires_grad=True) for value in values]
    weighted = torch.stack([(value * weight).sum() for value, weight in zip(values, weights, strict=True)]).sum()
    (slope,) = torch.autograd.grad(weighted, at, create_graph=True)  # linear in the weights
    return [torch.autograd.grad((slope * way).sum(), weights, retain_graph=True, materialize_grads=True) for way in ways]
