"""Handles: nodes that a gripper holds or moves.

A handle pulls its node to the target x*(t) = translation(t) + linear(t) x̂, where the anchor x̂ is the node's position,
taken back through the motion, at the step in which the handle becomes active. A *soft* handle is a spring with energy
strength · k_h |x - x*|²/2 (ARCSim); a *hard* one prescribes the position.

The published scenes put a static and a moving soft handle on the same node, which then follows the midpoint of both.
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
"""In which a pad turns up what it holds, from `start` on: twice the time of a usual frame."""


@dataclass(frozen=True)
class Handle:
    """One held node."""

    node: int
    motion: Motion | None = None
    start: float = 0.0
    end: float = float("inf")
    fade: float = 0.0
    """Seconds over which a soft handle lets go after `end`."""
    gripper: str = "gripper"
    """Which one moves the node, if one does."""
    pad: int = 0
    """Number of the pad that holds the node: what lies between nodes of one pad is held like them."""
    turned: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """By how much an upright pad displaces the node, beside its motion [m]."""

    def turning(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """[S, 3] of `turned` at times [S], with a smooth start and end."""
        done = np.clip((times - self.start) / _TURN_S, 0, 1)
        return (done**3 * (10 - 15 * done + 6 * done**2))[:, None] * np.array(self.turned)


@dataclass(frozen=True)
class HandleSchedule:
    """Handles at the S steps of one run (at the end of each step)."""

    strength: NDArray[np.float64]
    """[S, H] in [0, 1]."""
    linear: NDArray[np.float64]
    """[S, H, 3, 3] scale times rotation."""
    translation: NDArray[np.float64]
    """[S, H, 3] [m]; of handles that follow a gripper's track, what comes on top of it."""
    first_step: NDArray[np.int64]
    """[H] the step index (from 0) that takes the anchor; S where none does."""
    gripper: NDArray[np.int64]
    """[H] whose track the handle follows, a number in `Handles.grippers`; -1: none."""

    @property
    def active(self) -> NDArray[np.bool_]:
        """[S, H]"""
        return self.strength > 0


@dataclass(frozen=True)
class Handles:
    """All handles of a cloth."""

    handles: tuple[Handle, ...]
    stiffness: float = 1e3
    """k_h of soft handles [N/m]."""
    hard: bool = False
    grasp: Grasp | None = None
    """What the held nodes stand for; None: nodes, as they are."""

    def __post_init__(self) -> None:
        nodes = [handle.node for handle in self.handles]
        if self.hard and len(set(nodes)) < len(nodes):
            raise SceneError(f"Two hard handles hold one node (nodes {sorted(nodes)}); a position has one value.")

    @property
    def nodes(self) -> list[int]:
        return [handle.node for handle in self.handles]

    @property
    def moving(self) -> NDArray[np.bool_]:
        """[H] those with a motion."""
        return np.array([handle.motion is not None for handle in self.handles], dtype=np.bool_)

    @property
    def grippers(self) -> tuple[str, ...]:
        """Those that move nodes, in the order of the handles."""
        return tuple(dict.fromkeys(handle.gripper for handle in self.handles if handle.motion is not None))

    def schedule(self, times: NDArray[np.float64]) -> HandleSchedule:
        """Strength and targets at the end of each step, times [S] [s], as the scene says."""
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
        """[S, G, 3] displacement of each gripper since the start at the end of each step, times [S] [s], as the scene says.

        Raises:
            SceneError: a gripper turns what it holds, moves its nodes in different ways, begins later, or moves a node that
                another handle keeps in place: as a track, that would be another motion.
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
        """The schedule with moving handles displaced as their grippers are, from where their nodes start.

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
        # static twins of moving handles go: together they would hold the node half-way
        held = {handle.node for handle in self.handles if handle.motion is not None}
        twins = [handle.motion is None and handle.node in held for handle in self.handles]
        schedule.strength[:, twins] = 0.0
        # a node's own start is its anchor; ARCSim's rule would take it one step late and lag behind the gripper
        first = np.where(self.moving, len(times), schedule.first_step)
        names = self.grippers
        gripper = [-1 if handle.motion is None else names.index(handle.gripper) for handle in self.handles]
        return HandleSchedule(schedule.strength, schedule.linear, schedule.translation, first, np.array(gripper))
