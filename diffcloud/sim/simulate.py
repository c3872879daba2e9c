"""The simulation: initial state, rollout, and derivatives of rollouts.

Kernels simulate one cloth at a time. This module runs them on batches, in several threads, as one differentiable torch
operation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import torch
from torch import Tensor

from diffcloud.errors import DivergedError, SceneError
from diffcloud.sim.episodes import Batch
from diffcloud.sim.properties import Properties
from diffcloud.sim.rigid.bodies import BodyState
from diffcloud.sim.system import State, System


@dataclass(frozen=True)
class Rollout:
    """Simulated trajectories of a batch of cloths."""

    positions: Tensor
    """[B, S + 1, V, 3] node positions at the start and after each of S steps [m]."""
    times: Tensor
    """[S + 1] times of these states [s]."""
    velocities: Tensor
    """[B, S + 1, V, 3] node velocities [m/s]."""
    bodies: BodyState | None = None
    """Rigid bodies, with fields stacked as [B, S + 1, N, ...]; None without bodies."""
    diverged: Mapping[int, DivergedError] = field(default_factory=dict)
    """Batch entries that diverged, with `drop_diverged`. Their positions are NaN from this step on."""

    def at(self, times: Tensor) -> Tensor:
        """Positions [B, T, V, 3] [m] at times [T] [s], interpolated linearly between steps."""
        place = (times / self.times[1]).clamp(0, len(self.times) - 1)
        nearest = place.round()
        place = torch.where((place - nearest).abs() < 1e-6, nearest, place)
        low = place.floor().long().clamp(max=len(self.times) - 2)
        fraction = (place - low)[:, None, None]
        return self.positions[:, low] * (1 - fraction) + self.positions[:, low + 1] * fraction


def init(system: System, batch: int = 1, *, positions: Tensor | None = None, velocities: Tensor | None = None) -> State:
    """State at time zero.

    Args:
        batch: B, the number of parameter sets.
        positions: [B or 1, V, 3]; default the nodes of the mesh [m].
        velocities: [B or 1, V, 3]; default zero [m/s].
    """
    if positions is None:
        positions = torch.as_tensor(system.mesh.nodes, dtype=torch.float64)[None]
    positions = positions.expand(batch, -1, -1)
    velocities = torch.zeros_like(positions) if velocities is None else velocities.expand(batch, -1, -1)
    bodies = _body_state(torch.from_numpy(system.bodies.start).expand(batch, 1, -1, -1))
    if bodies is not None:
        bodies = BodyState(*(part[:, 0] for part in bodies.tensors()))
    return State(positions, velocities, bodies)


def still(system: System, positions: Tensor) -> State:
    """Direction (tangent) of the initial state in which only the cloth's positions [B, V, 3] change."""
    start = init(system, len(positions))
    bodies = None if start.bodies is None else BodyState(*(torch.zeros_like(part) for part in start.bodies.tensors()))
    return State(positions, torch.zeros_like(positions), bodies)


def rollout(
    system: System,
    steps: int,
    *,
    properties: Properties | None = None,
    state: State | None = None,
    track: Tensor | None = None,
    drop_diverged: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Rollout:
    """Simulate `steps` steps on the CPU in double precision. Reverse-mode differentiable in all input tensors.

    Args:
        properties: of a batch of parameter sets; default the nominal material, batch 1.
        state: initial state; default at rest.
        track: [B or 1, S, G, 3] displacement of each gripper since the start, at the end of each step [m]. The order is
            that of `Handles.grippers`. The track replaces the scene's own motion of the moving handles.
        drop_diverged: report batch entries that diverge in `Rollout.diverged` instead of raising an error.
        progress: called from time to time with the number of finished steps, averaged over the batch.

    Raises:
        DivergedError: names the batch entries that diverged, and the first step in which one did.
        SceneError: an input has the wrong shape, or the track has other grippers or fewer steps.
    """
    properties = system.properties if properties is None else properties
    state = init(system, properties.batch) if state is None else state
    count = max(properties.batch, len(state.positions), 0 if track is None else len(track))
    batch = Batch(system, steps, tracked=track is not None, progress=progress)
    given = _inputs(system, steps, properties, state, track)
    positions, velocities, poses = _Episodes.apply(batch, *(_expanded(tensor, count) for tensor in given))
    diverged = batch.diverged()
    if diverged and not drop_diverged:
        raise _joined(diverged)
    if diverged:
        positions, velocities, poses = (_cut(tensor, diverged) for tensor in (positions, velocities, poses))
    return Rollout(positions, batch.times, velocities, _body_state(poses), diverged)


def rollout_tangents(
    system: System,
    steps: int,
    *,
    properties: Properties,
    tangents: Properties,
    state: State | None = None,
    state_tangents: State | None = None,
    track: Tensor | None = None,
    track_tangents: Tensor | None = None,
) -> tuple[Rollout, Tensor]:
    """Simulate a batch, with its derivatives along K directions (forward mode).

    Args:
        properties: [B, ...].
        tangents: [K · B, ...] directions of the properties, directions outermost.
        state: initial state.
        state_tangents: directions of the initial state, each field [K · B, ...].
        track: [B or 1, S, G, 3] displacement of the grippers [m].
        track_tangents: [K · B, S, G, 3] directions of the track.

    Returns:
        The rollout of the batch, and the derivatives of its positions [K, B, S + 1, V, 3].

    Raises:
        DivergedError: as `rollout`.
    """
    count = properties.batch
    directions = tangents.batch // count
    state = init(system, count) if state is None else state
    batch = Batch(system, steps, tracked=track is not None)
    given = _inputs(system, steps, properties, state, track)
    moves: list[Tensor | None] = [None, None, None, track_tangents, *tangents.tensors()]
    if state_tangents is not None:
        moves[:3] = _packed(state_tangents)
    values = [_expanded(tensor.detach(), count) for tensor in given]
    rates = [
        torch.zeros(directions, *value.shape, dtype=torch.float64)
        if move is None
        else move.detach().double().reshape(directions, *value.shape)
        for value, move in zip(values, moves, strict=True)
    ]
    positions, velocities, poses = batch.simulate(values, keep=True)
    diverged = batch.diverged()
    if diverged:
        raise _joined(diverged)
    found = batch.tangents(rates)
    return Rollout(positions, batch.times, velocities, _body_state(poses)), found


class _Episodes(torch.autograd.Function):
    """Differentiable simulation of a batch. Inputs are those of `Batch.simulate`."""

    @staticmethod
    def forward(ctx: Any, batch: Batch, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        ctx.batch = batch
        return batch.simulate(inputs, keep=any(ctx.needs_input_grad))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        found = ctx.batch.gradients(gradients)
        return (None, *found)


def _inputs(system: System, steps: int, properties: Properties, state: State, track: Tensor | None) -> list[Tensor]:
    """Check the inputs of `Batch.simulate` and convert them to tensors with a leading axis B or 1."""
    positions, velocities, poses = _packed(state)
    if poses is None:
        poses = torch.from_numpy(system.bodies.start)[None]
    names = system.handles.grippers
    if track is None:
        track = torch.zeros(1, steps, len(names), 3, dtype=torch.float64)
    elif track.ndim != 4 or track.shape[2:] != (len(names), 3) or track.shape[1] < steps:
        raise SceneError(
            f"A track has shape [batch, {steps} or more steps, {len(names)}, 3] here ({', '.join(names)}), got "
            f"{list(track.shape)}."
        )
    nodes = (len(system.mesh.nodes), 3)
    expected = {"positions": nodes, "velocities": nodes, "bodies": system.bodies.start.shape}
    expected |= {field.name: getattr(system.properties, field.name).shape[1:] for field in fields(properties)}
    given = [positions, velocities, poses, *properties.tensors()]
    for (name, shape), tensor in zip(expected.items(), given, strict=True):
        if tuple(tensor.shape[1:]) != tuple(shape):  # kernels do not check array bounds
            raise SceneError(f"{name} must have shape [batch, {', '.join(map(str, shape))}], got {list(tensor.shape)}.")
    return [positions, velocities, poses, track, *properties.tensors()]


def _packed(state: State) -> tuple[Tensor, Tensor, Tensor | None]:
    """Positions and velocities [B, V, 3] and poses of the bodies [B, N, 18]; poses are None if the state has no bodies."""
    parts = None if state.bodies is None else [part.flatten(2) for part in state.bodies.tensors()]
    return state.positions, state.velocities, None if parts is None else torch.cat(parts, dim=2)


def _expanded(tensor: Tensor, count: int) -> Tensor:
    return tensor.double().expand(count, *tensor.shape[1:])


def _body_state(poses: Tensor) -> BodyState | None:
    """Convert poses [B, S + 1, N, 18] to the states of the bodies; None without bodies."""
    if not poses.shape[2]:
        return None
    centre, orientation, velocity, angular_velocity = poses.split([3, 9, 3, 3], dim=-1)
    return BodyState(centre, orientation.unflatten(-1, (3, 3)), velocity, angular_velocity)


def _joined(diverged: Mapping[int, DivergedError]) -> DivergedError:
    """One error for all entries that diverged."""
    first = min(diverged.values(), key=lambda error: error.step)
    if len(diverged) == 1:
        return first
    return DivergedError(first.step, sorted(diverged), first.reason)


def _cut(tensor: Tensor, diverged: Mapping[int, DivergedError]) -> Tensor:
    """Replace an entry's states by NaN from the step on in which it diverged. The tensor is [B, S + 1, ...]."""
    last = torch.full((len(tensor),), tensor.shape[1], dtype=torch.long)
    last[list(diverged)] = torch.tensor([error.step for error in diverged.values()])
    gone = torch.arange(tensor.shape[1]) >= last[:, None]
    return torch.where(gone.view(*gone.shape, *[1] * (tensor.dim() - 2)), torch.nan, tensor)
