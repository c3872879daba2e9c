"""Handles: nodes that a gripper holds or moves.

A handle pulls its node to the target x*(t) = translation(t) + linear(t) x̂. The anchor x̂ is the node's position when the
handle becomes active, mapped back through the inverse motion. A *soft* handle is a spring with energy strength · k_h
|x - x*|²/2, as in ARCSim. A *hard* handle prescribes the position.

In the published scenes, a static and a moving soft handle act on the same node, which then follows their midpoint.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import SceneError
from diffcloud.sim.grasp import Grasp
from diffcloud.sim.motion import Motion

_FADE_EPSILON = 1e-6
_TURN_S = 0.2
"""Time in which an upright pad turns the cloth up after the handle's `start` [s]: two frames of a typical recording."""


@dataclass(frozen=True)
class Handle:
    """A held node."""

    node: int
    motion: Motion | None = None
    start: float = 0.0
    end: float = float("inf")
    fade: float = 0.0
    """Duration over which a soft handle releases its node after `end` [s]."""
    gripper: str = "gripper"
    """Name of the gripper that moves the node. Not used without a motion."""
    pad: int = 0
    """Number of the pad that holds the node. Cloth between nodes of the same pad is also held."""
    turned: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Displacement of the node by an upright pad, in addition to its motion [m]."""

    def turning(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement [S, 3] by `turned` at times [S] [s], smoothly increasing from zero."""
        done = np.clip((times - self.start) / _TURN_S, 0, 1)
        return (done**3 * (10 - 15 * done + 6 * done**2))[:, None] * np.array(self.turned)


@dataclass(frozen=True)
class HandleSchedule:
    """State of all handles at the end of each of S steps."""

    strength: NDArray[np.float64]
    """[S, H] relative stiffness in [0, 1]; 0 is inactive."""
    linear: NDArray[np.float64]
    """[S, H, 3, 3] scale times rotation."""
    translation: NDArray[np.float64]
    """[S, H, 3] [m]. For handles that follow a gripper's track, only the displacement in addition to the track."""
    first_step: NDArray[np.int64]
    """[H] index from 0 of the step at whose start the anchor is set; S if the node's initial position is the anchor."""
    gripper: NDArray[np.int64]
    """[H] index in `Handles.grippers` of the track that the handle follows; -1 for none."""

    @property
    def active(self) -> NDArray[np.bool_]:
        """[S, H] True where a handle holds its node."""
        return self.strength > 0


@dataclass(frozen=True)
class Handles:
    """All handles of a cloth."""

    handles: tuple[Handle, ...]
    stiffness: float = 1e3
    """Spring constant k_h of soft handles [N/m]."""
    hard: bool = False
    grasp: Grasp | None = None
    """Type and size of the grasp; None if handles hold single nodes."""

    def __post_init__(self) -> None:
        nodes = [handle.node for handle in self.handles]
        if self.hard and len(set(nodes)) < len(nodes):
            raise SceneError(f"Two hard handles hold one node (nodes {sorted(nodes)}); a position has one value.")

    @property
    def nodes(self) -> list[int]:
        return [handle.node for handle in self.handles]

    @property
    def moving(self) -> NDArray[np.bool_]:
        """[H] True for handles with a motion."""
        return np.array([handle.motion is not None for handle in self.handles], dtype=np.bool_)

    @property
    def grippers(self) -> tuple[str, ...]:
        """Names of the grippers that move nodes, in the order of the handles."""
        return tuple(dict.fromkeys(handle.gripper for handle in self.handles if handle.motion is not None))

    def schedule(self, times: NDArray[np.float64]) -> HandleSchedule:
        """Strength and targets at the end of each step, at times [S] [s], from the scene's own motions."""
        shape = (len(times), len(self.handles))
        strength, translation = np.zeros(shape), np.zeros((*shape, 3))
        linear = np.broadcast_to(np.eye(3), (*shape, 3, 3)).copy()
        for index, handle in enumerate(self.handles):
            fading = np.clip(1 - (times - handle.end) / (handle.fade + _FADE_EPSILON), 0, 1) ** 4
            over = (times < handle.start) | (times > handle.end + handle.fade)
            strength[:, index] = np.where(over, 0.0, np.where(times <= handle.end, 1.0, fading))
            if handle.motion is not None:
                linear[:, index], translation[:, index] = handle.motion.at(times)
            translation[:, index] += handle.turning(times)
        active = strength > 0
        first = np.where(active.any(axis=0), active.argmax(axis=0), len(times))
        return HandleSchedule(strength, linear, translation, first, np.full(len(self.handles), -1))

    def own_track(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement [S, G, 3] of each gripper since the start, at times [S] [s], from the scene's own motions [m].

        Raises:
            SceneError: the motion is more than a translation: a gripper rotates, moves its nodes differently, starts late,
                or shares a node with a static handle.
        """
        level = replace(self, handles=tuple(replace(handle, turned=Handle.turned) for handle in self.handles))
        schedule = level.schedule(times)
        first = np.minimum(schedule.first_step, len(times) - 1)
        moved = schedule.translation - schedule.translation[first, np.arange(len(self.handles))]
        found = np.zeros((len(times), len(self.grippers), 3))
        kept = {handle.node for handle in self.handles if handle.motion is None}
        for index, name in enumerate(self.grippers):
            own = [h for h, handle in enumerate(self.handles) if handle.motion is not None and handle.gripper == name]
            found[:, index] = moved[:, own[0]]
            alike = np.allclose(schedule.linear[:, own], np.eye(3)) and np.allclose(moved[:, own], found[:, index, None])
            if not alike or first[own].any() or kept & {self.handles[h].node for h in own}:
                raise SceneError(
                    f"The gripper {name} turns what it holds, moves its nodes differently, begins later or shares a node "
                    "with another handle: that is no track. Give a recorded one."
                )
        return found

    def tracked_schedule(self, times: NDArray[np.float64]) -> HandleSchedule:
        """Schedule in which moving handles follow a recorded gripper track from their nodes' initial positions.

        Raises:
            SceneError: no handle moves.
        """
        if not self.moving.any():
            raise SceneError(
                "A gripper track was given, but no handle of this scene moves; give the grasped node a motion."
            )
        schedule = self.schedule(times)
        for index in np.flatnonzero(self.moving):
            schedule.translation[:, index] = self.handles[index].turning(times)
        schedule.linear[:, self.moving] = np.eye(3)
        # A static handle on the same node is disabled: the node would otherwise follow the midpoint of both.
        held = {handle.node for handle in self.handles if handle.motion is not None}
        twins = [handle.motion is None and handle.node in held for handle in self.handles]
        schedule.strength[:, twins] = 0.0
        # The anchor is the node's initial position. ARCSim sets it one step later, so its node would trail the gripper.
        first = np.where(self.moving, len(times), schedule.first_step)
        names = self.grippers
        gripper = [-1 if handle.motion is None else names.index(handle.gripper) for handle in self.handles]
        return HandleSchedule(schedule.strength, schedule.linear, schedule.translation, first, np.array(gripper))
