"""How the loss changes with what is fitted, to first and second order.

Variables are fitted on an axis of their own: the logarithm of a value whose lower bound is positive, the standard
deviations off zero of one with a normal prior, else the part of its range. Where the integrator's derivatives hold over
finite distances (the implicit one: docs/results/gradients.md), the motion is linearised by forward tangents, in one
simulation. The linearised integrator's contact is rough: there, motions a finite step to both sides give the differences,
and losses there are known too.

What a motion says at a pose stands in `matching`. The pose is not among the variables: it follows them, to where the loss
is lowest. Of the whole system over variables p and pose q, what is left when q is solved for is (variable projection;
Golub and Pereyra 2003)

    slope g_p - H_pq H_qq⁻¹ g_q,      curvature H_pp - H_pq H_qq⁻¹ H_qp.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffcloud.errors import DivergedError
from diffcloud.fit.batches import without_diverged
from diffcloud.fit.inputs import Inputs
from diffcloud.fit.joint import AnyObjective, mean_loss, mean_terms
from diffcloud.fit.objective import Objective
from diffcloud.fit.parameters import FitSpace
from diffcloud.sim.simulate import Rollout
from diffcloud.sim.threads import map_threads

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
    beside: tuple[Tensor, Tensor] | None = None
    """The places [n, B, k] of the differences, and the loss at each [n, B], with the pose of the place in the middle: with
    a pose of its own, it would be about as low or lower. All are infinite of a place at or beside which a motion diverges.
    None where the derivatives of any recording are tangents."""


def linearise(objective: AnyObjective, space: FitSpace, places: Tensor) -> Linearisation:
    """The loss at [B, k] places, with the prior of the variables, by the rule that stands at the head of this module."""
    paper = objective.paper

    axis, members = Axis.of(space), len(objective.members)
    sides = None if any(map(by_tangents, objective.members)) else _sides(axis, places).flatten(0, 1)

    def run(index: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        parts = map_threads(lambda one: _part(objective, space, places[index], one, sides is not None), range(members))
        loss, slope, curvature = mean_terms([part[:3] for part in parts], paper=paper)
        values = axis.values(places[index])
        prior, factor = loss[:, None] * space.prior_weights(members), space.prior_factor(values, members)
        slope, curvature = slope + prior * space.off_centre(values), curvature + torch.diag_embed(prior)
        beside = mean_loss(torch.stack([part[3] for part in parts]).flatten(1), paper=paper).unflatten(0, (-1, len(index)))
        return factor * loss, factor[:, None] * slope, factor[:, None, None] * curvature, beside

    with torch.no_grad():
        found, kept, _ = without_diverged(len(places), run)
    count, variables = places.shape
    losses = torch.full((count,), torch.inf, dtype=torch.float64)
    slope, curvature = places.new_zeros(count, variables), places.new_zeros(count, variables, variables)
    beside = None if sides is None else (sides, torch.full(sides.shape[:2], torch.inf, dtype=torch.float64))
    if found is not None:
        losses[kept], slope[kept], curvature[kept] = found[:3]
        if beside is not None:
            beside[1][:, kept] = found[3] * space.prior_factor(axis.values(beside[0][:, kept]), members)
    each = sum(
        1 if by_tangents(one) else 1 + 2 * len(space.of_recording(index)[1]) for index, one in enumerate(objective.members)
    )
    return Linearisation(losses, slope, curvature, each * count, beside)


def _part(
    objective: AnyObjective, space: FitSpace, places: Tensor, recording: int, beside: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Loss [B], slope [B, k] and curvature [B, k, k] of one recording, which only its own variables move; and the losses
    [2 k, B] at the places of the differences. Where a variable is another recording's, or nobody asks for them, that of the
    place itself."""
    own, columns = space.of_recording(recording)
    member = objective.members[recording]
    moved = moved_by(member, own, places[:, columns])
    loss, own_slope, own_curvature, pose = _over_pose(member, moved)
    batch, variables = places.shape
    slope, curvature = places.new_zeros(batch, variables), places.new_zeros(batch, variables, variables)
    slope[:, columns], curvature[:, columns[:, None], columns] = own_slope, own_curvature
    around = loss.expand(2, variables, batch).clone()
    if beside and moved.beside is not None:
        poses = pose.repeat(2 * len(columns), 1)
        losses = member.frame_losses(moved.beside, pose=poses).mean(-1) * member.pose_space.prior_factor(poses)
        around[:, columns] = losses.reshape(2, len(columns), batch)
    return loss, slope, curvature, around.flatten(0, 1)


def by_tangents(objective: Objective) -> bool:
    """Whether the derivatives of its integrator hold over finite distances."""
    return objective.scenario.scene.integrator == "implicit"


@dataclass(frozen=True)
class Moved:
    """Motions of B places."""

    run: Rollout
    rates: Tensor
    """[k, B, L, C · V, 3] of their nodes at the compared frames, as `Objective.looked_at` has them."""
    beside: Rollout | None
    """The [2 · k · B] motions that these are differences of."""


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
    return Moved(run, torch.stack([objective.looked_at(replace(run, positions=move)) for move in moves]), None)


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
    return Moved(here, (there[0] - there[1]) / width[..., None, None, None], beside)


def _sides(axis: Axis, places: Tensor) -> Tensor:
    """[2, k, B, k] places above and below each of B places [B, k], along each variable, between the bounds."""
    low, high = axis.ends
    steps = STEP * _ways(places)
    return torch.stack([torch.minimum(torch.maximum(places + sign * steps, low), high) for sign in (1, -1)])


def _over_pose(objective: Objective, moved: Moved) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Loss [B], slope [B, k] and curvature [B, k, k] of one episode, the pose solved for; and that pose [B, d]."""
    motion, count = objective.match(moved.run), len(moved.rates)
    loss, slope, curvature = objective.terms(motion, moved.rates)
    if motion.pose.shape[1] == 0:
        return loss, slope, curvature, motion.pose
    space = objective.pose_space
    prior, factor = loss[:, None] * space.prior_weights, space.prior_factor(motion.pose)
    of_pose = slope[:, count:] + prior * motion.pose
    along, mixed = curvature[:, count:, count:] + torch.diag_embed(prior), curvature[:, :count, count:]
    solved = torch.linalg.solve(along, torch.cat([of_pose[..., None], mixed.mT], dim=-1))
    slope = slope[:, :count] - (mixed @ solved[..., :1]).squeeze(-1)
    curvature = curvature[:, :count, :count] - mixed @ solved[..., 1:]
    return factor * loss, factor[:, None] * slope, factor[:, None, None] * curvature, motion.pose


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
