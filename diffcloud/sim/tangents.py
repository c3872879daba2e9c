"""Forward-mode derivatives of a rollout: a few directions carried along with the batch."""

from __future__ import annotations

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from diffcloud.sim.properties import Properties
from diffcloud.sim.simulate import Rollout, rollout
from diffcloud.sim.state import State, System


def rollout_tangents(
    system: System,
    steps: int,
    *,
    properties: Properties,
    tangents: Properties,
    state: State | None = None,
    state_tangents: tuple[Tensor | None, Tensor | None] = (None, None),
    track: Tensor | None = None,
    track_tangents: Tensor | None = None,
) -> tuple[Rollout, Tensor]:
    """A rollout and its derivative along K directions.

    Args:
        properties: [B, ...].
        tangents: [K · B, ...] directions of the properties, copies outermost.
        state, state_tangents: start, and directions [K · B, V, 3] of its positions and velocities.
        track, track_tangents: gripper displacement [B or 1, S, 3] and its directions [K · B, S, 3].

    Returns:
        The rollout of the batch B, and d positions [K, B, S + 1, V, 3].

    Raises:
        DivergedError: as `rollout`.
    """
    batch = properties.batch
    copies = tangents.batch // batch
    with torch.no_grad(), forward_ad.dual_level():

        def dual(primal: Tensor, tangent: Tensor | None) -> Tensor:
            repeated = primal.repeat(copies, *[1] * (primal.dim() - 1))
            return repeated if tangent is None else forward_ad.make_dual(repeated, tangent.contiguous())

        moving = Properties(*map(dual, properties.tensors(), tangents.tensors()))
        if state is None:
            positions = torch.as_tensor(system.mesh.nodes, dtype=system.dtype, device=system.device)
            positions = positions.expand(batch, -1, -1)
            velocities = torch.zeros_like(positions)
        else:
            positions, velocities = state.positions, state.velocities
        positions, velocities = dual(positions, state_tangents[0]), dual(velocities, state_tangents[1])
        start = State(positions, velocities, positions[:, system.handles.nodes])
        if track is not None:
            track = dual(track.expand(batch, -1, -1), track_tangents)
        run = rollout(system, steps, properties=moving, state=start, track=track, copies=copies)
        unpacked = forward_ad.unpack_dual(run.positions)
        tangent = torch.zeros_like(unpacked.primal) if unpacked.tangent is None else unpacked.tangent
        return Rollout(unpacked.primal[:batch], run.times), tangent.unflatten(0, (copies, batch))
