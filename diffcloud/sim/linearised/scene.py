"""What the kernels of the linearised step are given, and what they keep for the derivatives."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from diffcloud.sim.compiled.data import Floats, Ints, Parameters
from diffcloud.sim.compiled.kernel import kernel
from diffcloud.sim.compiled.sparse import Pattern
from diffcloud.sim.contact.surface import Surface
from diffcloud.sim.reference.impact_zones import Impacts, Projection, no_impacts
from diffcloud.sim.reference.nearest import Repulsion


class Scene(NamedTuple):
    """Everything constant in a run."""

    terms: Any
    """`kernels.Terms`"""
    pattern: Pattern
    time_step: float
    """[s]"""
    obstacles: Floats
    """[O, 3] points of static obstacles [m]."""
    plane_normals: Floats
    """[P, 3] of half-spaces n · x >= offset, which stop nodes."""
    plane_offsets: Floats
    """[P] [m]"""
    surface: Surface
    repels: bool
    """Whether pairs of meshes repel and rub."""
    collides: bool
    """Whether impacts between meshes are resolved."""
    repulsion: Repulsion
    projection: Projection


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
    """[H] the step that takes the anchor."""
    inverse: Floats
    """[H, 3, 3] of the linear part in that step."""
    gripper: Ints
    """[H] whose track a handle follows; -1: none."""


class Kept(NamedTuple):
    """What an episode's derivatives need of each step."""

    solved: Floats
    """[S, V, 3] velocities after the linear system, before contact [m/s]."""
    begins: Ints
    """[S + 1, 5] the first row of each step in `corners`, `impacts.met`, `impacts.passes`, `impacts.forces`, `factors`; -1
    where the factor is to be made again."""
    corners: Ints
    """[., 5] kind and points of the pairs that repel."""
    constants: Floats
    """[., 4] sign, count, stiffness and whether an obstacle takes part."""
    impacts: Impacts
    factors: Floats
    """[., 9]"""


@kernel
def nothing_kept(steps: int, nodes: int) -> Kept:
    """An empty record."""
    corners, constants, factors = np.empty((16, 5), np.int64), np.empty((16, 4)), np.empty((16, 9))
    begins = np.zeros((steps + 1, 5), np.int64)
    return Kept(np.empty((steps, nodes, 3)), begins, corners, constants, no_impacts(), factors)


@kernel
def held_now(scene: Scene, held: Held, step: int) -> Ints:
    """[V] the handle that prescribes each node in a step; -1: none."""
    found = np.full(len(scene.pattern.place), -1, np.int64)
    if held.hard:
        for h in range(len(held.node)):
            if held.strength[step, h] > 0:
                found[held.node[h]] = h
    return found


@kernel
def take_anchors(held: Held, track: Floats, step: int, positions: Floats, anchors: Floats) -> None:
    """Anchors [H, 3] of the handles that become active in this step: the node's position, back through the motion."""
    for h in range(len(held.node)):
        if held.first_step[h] == step:
            shift = _shift(held, track, step, h)
            for axis in range(3):
                anchors[h, axis] = 0.0
                for k in range(3):
                    anchors[h, axis] += held.inverse[h, axis, k] * (positions[held.node[h], k] - shift[k])


@kernel
def aim(held: Held, track: Floats, step: int, anchors: Floats, parameters: Parameters) -> None:
    """Stiffness and targets of the handles at the end of a step."""
    for h in range(len(held.node)):
        parameters.hold[h] = 0.0 if held.hard else held.stiffness * held.strength[step, h]
        shift = _shift(held, track, step, h)
        for axis in range(3):
            parameters.target[h, axis] = shift[axis]
            for k in range(3):
                parameters.target[h, axis] += held.linear[step, h, axis, k] * anchors[h, k]


@kernel
def _shift(held: Held, track: Floats, step: int, h: int) -> Floats:
    shift = held.translation[step, h].copy()
    if held.gripper[h] >= 0:
        for axis in range(3):
            shift[axis] += track[step, held.gripper[h], axis]
    return shift
