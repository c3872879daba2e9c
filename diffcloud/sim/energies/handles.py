"""Handles: nodes that a gripper holds or moves.

A handle pulls its node to the target x*(t) = translation(t) + linear(t) x̂, where the anchor x̂ is the node's position,
taken back through the motion, at the step in which the handle becomes active. A *soft* handle is a spring with energy
strength · k_h |x - x*|²/2 (ARCSim); a *hard* one prescribes the position.

The published scenes put a static and a moving soft handle on the same node, which then follows the midpoint of both.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloud.errors import SceneError
from diffcloud.sim.motion import Motion

_FADE_EPSILON = 1e-6


@dataclass(frozen=True)
class Handle:
    """One held node."""

    node: int
    motion: Motion | None = None
    start: float = 0.0
    end: float = float("inf")
    fade: float = 0.0
    """Seconds over which a soft handle lets go after `end`."""


@dataclass(frozen=True)
class HandleSchedule:
    """Handles at the S steps of one run (at the end of each step)."""

    strength: Tensor
    """[S, H] in [0, 1]."""
    linear: Tensor
    """[S, H, 3, 3] scale times rotation."""
    translation: Tensor
    """[B or 1, S, H, 3] [m]; differentiable."""
    active: NDArray[np.bool_]
    """[S, H] where the strength is not zero."""
    first_step: NDArray[np.int64]
    """[H] the step index (from 0) that takes the anchor; S where none does."""
    cache: dict[Any, Any] = field(default_factory=dict, compare=False)
    """What the integrator derives from a set of active handles, kept for the steps of this run."""


@dataclass(frozen=True)
class Handles:
    """All handles of a cloth."""

    handles: tuple[Handle, ...]
    stiffness: float = 1e3
    """k_h of soft handles [N/m]."""
    hard: bool = False

    def __post_init__(self) -> None:
        nodes = [handle.node for handle in self.handles]
        if self.hard and len(set(nodes)) < len(nodes):
            raise SceneError(f"Two hard handles hold one node (nodes {sorted(nodes)}); a position has one value.")

    @property
    def nodes(self) -> list[int]:
        return [handle.node for handle in self.handles]

    def schedule(self, times: NDArray[np.float64], *, dtype: torch.dtype, device: torch.device) -> HandleSchedule:
        """Strength and targets at the end of each step, times [S] [s]."""
        shape = (len(times), len(self.handles))
        strength, translation = np.zeros(shape), np.zeros((*shape, 3))
        linear = np.broadcast_to(np.eye(3), (*shape, 3, 3)).copy()
        for index, handle in enumerate(self.handles):
            fading = np.clip(1 - (times - handle.end) / (handle.fade + _FADE_EPSILON), 0, 1) ** 4
            over = (times < handle.start) | (times > handle.end + handle.fade)
            strength[:, index] = np.where(over, 0.0, np.where(times <= handle.end, 1.0, fading))
            if handle.motion is not None:
                linear[:, index], translation[:, index] = handle.motion.at(times)
        active = strength > 0
        return HandleSchedule(
            strength=torch.as_tensor(strength, dtype=dtype, device=device),
            linear=torch.as_tensor(linear, dtype=dtype, device=device),
            translation=torch.as_tensor(translation, dtype=dtype, device=device)[None],
            active=active,
            first_step=np.where(active.any(axis=0), active.argmax(axis=0), len(times)),
        )

    def following_track(self) -> Handles:
        """The handles that remain when a recorded gripper track drives the moving ones.

        Static twins of moving handles go: together they would hold the node half-way.
        """
        moving = {handle.node for handle in self.handles if handle.motion is not None}
        if not moving:
            raise SceneError(
                "A gripper track was given, but no handle of this scene moves; give the grasped node a motion."
            )
        kept = tuple(h for h in self.handles if h.motion is not None or h.node not in moving)
        return replace(self, handles=kept)


def follow_track(handles: Handles, schedule: HandleSchedule, displacement: Tensor) -> HandleSchedule:
    """The schedule with moving handles displaced as a gripper is, from where their nodes start.

    Args:
        displacement: [B or 1, S, 3] of the gripper since the start, at the end of each step [m]; differentiable.
    """
    moving = torch.tensor([h.motion is not None for h in handles.handles], device=displacement.device)
    translation = torch.where(moving[:, None], displacement[:, :, None], schedule.translation)
    identity = torch.eye(3, dtype=displacement.dtype, device=displacement.device)
    linear = torch.where(moving[:, None, None], identity, schedule.linear)
    # a node's own start is its anchor; ARCSim's rule would take it one step late and lag behind the gripper
    first_step = np.where(moving.cpu().numpy(), len(schedule.active), schedule.first_step)
    return replace(schedule, translation=translation, linear=linear, first_step=first_step)
