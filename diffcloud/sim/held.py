"""Handles inside kernels: where each wants its node in a step, and derivatives of that.

    anchor x̂ = L⁻¹(t₀) (x(t₀) - s(t₀)),    target x*(t) = s(t) + L(t) x̂,    s = translation (+ its gripper's track)

t₀ is the step in which the handle becomes active; a handle that never does, or that follows a track, is anchored where its
node starts. (`handles` has the schedule.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats, Ints, Parameters


class Held(NamedTuple):
    """Handles over the S steps of a run."""

    node: Ints
    """[H]"""
    hard: bool
    stiffness: float
    """k_h [N/m]"""
    strength: Floats
    """[S, H] in [0, 1]."""
    linear: Floats
    """[S, H, 3, 3]"""
    translation: Floats
    """[S, H, 3] [m]"""
    first_step: Ints
    """[H] the step that takes the anchor; S: none does."""
    inverse: Floats
    """[H, 3, 3] of the linear part in that step."""
    gripper: Ints
    """[H] whose track a handle follows; -1: none."""


@kernel
def first_anchors(held: Held, positions: Floats) -> Floats:
    """[H, 3] where the nodes start, positions [V, 3]."""
    anchors = np.empty((len(held.node), 3))
    for h in range(len(held.node)):
        for axis in range(3):
            anchors[h, axis] = positions[held.node[h], axis]
    return anchors


@kernel
def take_anchors(held: Held, track: Floats, step: int, positions: Floats, anchors: Floats) -> None:
    """Anchors [H, 3] of the handles that become active in this step; the track is [S, G, 3] of G grippers."""
    for h in range(len(held.node)):
        if held.first_step[h] == step:
            for axis in range(3):
                anchors[h, axis] = 0.0
                for k in range(3):
                    away = positions[held.node[h], k] - _shift(held, track, step, h, k)
                    anchors[h, axis] += held.inverse[h, axis, k] * away


@kernel
def aim(held: Held, track: Floats, step: int, anchors: Floats, parameters: Parameters) -> None:
    """Stiffness and targets of the handles at the end of a step, into the parameters."""
    for h in range(len(held.node)):
        parameters.hold[h] = 0.0 if held.hard else held.stiffness * held.strength[step, h]
        for axis in range(3):
            parameters.target[h, axis] = _shift(held, track, step, h, axis)
            for k in range(3):
                parameters.target[h, axis] += held.linear[step, h, axis, k] * anchors[h, k]


@kernel
def holders(held: Held, step: int, nodes: int) -> Ints:
    """[V] the handle that prescribes each node in a step; -1: none."""
    found = np.full(nodes, -1, np.int64)
    if held.hard:
        for h in range(len(held.node)):
            if held.strength[step, h] > 0:
                found[held.node[h]] = h
    return found


@kernel
def aim_reverse(held: Held, step: int, target: Floats, anchors: Floats, track: Floats) -> None:
    """From the gradients by the targets [H, 3] to those by the anchors and the track [S, G, 3]."""
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
    """From the gradients by the anchors that this step takes to those by positions [V, 3] and the track."""
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
    """Adds the gradients by the anchors that no step took to those by the first positions [V, 3]."""
    for h in range(len(held.node)):
        for axis in range(3):
            positions[held.node[h], axis] += anchors[h, axis]


@kernel
def take_anchors_tangent(held: Held, track: Floats, step: int, positions: Floats, anchors: Floats) -> None:
    """Rates of the anchors [K, H, 3] that this step takes, from those of the track [K, S, G, 3] and of positions
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
    """Rates of the targets [K, H, 3]."""
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
