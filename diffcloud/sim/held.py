"""Handles in the kernels: targets of the held nodes, and the derivatives of these targets.

    anchor x̂ = L⁻¹(t₀) (x(t₀) - s(t₀)),    target x*(t) = s(t) + L(t) x̂,    s = translation (+ its gripper's track)

t₀ is the step in which the handle becomes active. If a handle never does, or follows a track, its anchor is the node's
initial position. `handles` computes the schedule.

Functions `*_reverse` propagate the gradient of a loss backwards. Functions `*_tangent` propagate K directional derivatives.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats, Ints, Parameters


class Held(NamedTuple):
    """Schedule of H handles over S steps, as arrays. `handles.HandleSchedule` has the same fields."""

    node: Ints
    """[H] index of the held node."""
    hard: bool
    stiffness: float
    """Spring constant k_h [N/m]."""
    strength: Floats
    """[S, H] relative stiffness in [0, 1]."""
    linear: Floats
    """[S, H, 3, 3] scale times rotation."""
    translation: Floats
    """[S, H, 3] translation [m]."""
    first_step: Ints
    """[H] index of the step that sets the anchor; S if no step does."""
    inverse: Floats
    """[H, 3, 3] inverse of the linear part in this step."""
    gripper: Ints
    """[H] index of the gripper whose track the handle follows; -1 for none."""


@kernel
def first_anchors(held: Held, positions: Floats) -> Floats:
    """Initial positions [H, 3] of the held nodes, from positions [V, 3]."""
    anchors = np.empty((len(held.node), 3))
    for h in range(len(held.node)):
        for axis in range(3):
            anchors[h, axis] = positions[held.node[h], axis]
    return anchors


@kernel
def take_anchors(held: Held, track: Floats, step: int, positions: Floats, anchors: Floats) -> None:
    """Set the anchors [H, 3] of the handles that become active in this step. The track is [S, G, 3] for G grippers."""
    for h in range(len(held.node)):
        if held.first_step[h] == step:
            for axis in range(3):
                anchors[h, axis] = 0.0
                for k in range(3):
                    away = positions[held.node[h], k] - _shift(held, track, step, h, k)
                    anchors[h, axis] += held.inverse[h, axis, k] * away


@kernel
def aim(held: Held, track: Floats, step: int, anchors: Floats, parameters: Parameters) -> None:
    """Write stiffness and target of each handle at the end of a step into `parameters`."""
    for h in range(len(held.node)):
        parameters.hold[h] = 0.0 if held.hard else held.stiffness * held.strength[step, h]
        for axis in range(3):
            parameters.target[h, axis] = _shift(held, track, step, h, axis)
            for k in range(3):
                parameters.target[h, axis] += held.linear[step, h, axis, k] * anchors[h, k]


@kernel
def holders(held: Held, step: int, nodes: int) -> Ints:
    """[V] index of the hard handle that prescribes each node in a step; -1 for none."""
    found = np.full(nodes, -1, np.int64)
    if held.hard:
        for h in range(len(held.node)):
            if held.strength[step, h] > 0:
                found[held.node[h]] = h
    return found


@kernel
def aim_reverse(held: Held, step: int, target: Floats, anchors: Floats, track: Floats) -> None:
    """Add to the gradients of the anchors and of the track [S, G, 3], given the gradient of the targets [H, 3]."""
    for h in range(len(held.node)):
        for axis in range(3):
            slope = target[h, axis]
            if slope != 0:
                if held.gripper[h] >= 0:
                    track[step, held.gripper[h], axis] += slope
                for k in range(3):
                    anchors[h, k] += held.linear[step, h, axis, k] * slope


@kernel
def take_anchors_reverse(held: Held, step: int, anchors: Floats, positions: Floats, track: Floats) -> None:
    """Move the gradient of the anchors that this step sets to the gradients of positions [V, 3] and of the track."""
    for h in range(len(held.node)):
        if held.first_step[h] == step:
            for k in range(3):
                slope = 0.0
                for axis in range(3):
                    slope += held.inverse[h, axis, k] * anchors[h, axis]
                positions[held.node[h], k] += slope
                if held.gripper[h] >= 0:
                    track[step, held.gripper[h], k] -= slope
            anchors[h] = 0.0


@kernel
def first_anchors_reverse(held: Held, anchors: Floats, positions: Floats) -> None:
    """Add the gradient of the remaining anchors to that of the initial positions [V, 3]."""
    for h in range(len(held.node)):
        for axis in range(3):
            positions[held.node[h], axis] += anchors[h, axis]


@kernel
def take_anchors_tangent(held: Held, track: Floats, step: int, positions: Floats, anchors: Floats) -> None:
    """Derivatives [K, H, 3] of the anchors that this step sets, from those of the track [K, S, G, 3] and positions
    [K, V, 3]."""
    for h in range(len(held.node)):
        if held.first_step[h] == step:
            for d in range(len(anchors)):
                for axis in range(3):
                    anchors[d, h, axis] = 0.0
                    for k in range(3):
                        away = positions[d, held.node[h], k]
                        if held.gripper[h] >= 0:
                            away -= track[d, step, held.gripper[h], k]
                        anchors[d, h, axis] += held.inverse[h, axis, k] * away


@kernel
def aim_tangent(held: Held, track: Floats, step: int, anchors: Floats, target: Floats) -> None:
    """Write the derivatives of the targets [K, H, 3]."""
    for d in range(len(anchors)):
        for h in range(len(held.node)):
            for axis in range(3):
                target[d, h, axis] = track[d, step, held.gripper[h], axis] if held.gripper[h] >= 0 else 0.0
                for k in range(3):
                    target[d, h, axis] += held.linear[step, h, axis, k] * anchors[d, h, k]


@kernel
def _shift(held: Held, track: Floats, step: int, h: int, axis: int) -> float:
    shift = held.translation[step, h, axis]
    if held.gripper[h] >= 0:
        shift += track[step, held.gripper[h], axis]
    return shift
