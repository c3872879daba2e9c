"""What the kernels of the implicit step are given, and what they keep for the derivatives."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.box import Box, BoxType, define
from diffcloud.sim.compiled.data import Floats, Ints, Motion, Parameters
from diffcloud.sim.compiled.lu import General
from diffcloud.sim.compiled.sparse import Pattern
from diffcloud.sim.contact.places import Planes
from diffcloud.sim.contact.surface import Surface, boxed
from diffcloud.sim.status import FIRST_OWN

PARTS = 32
"""A step may be halved into so many parts."""
BODY = 18
"""Numbers of a body's state: centre [m], orientation row by row, velocity [m/s], angular velocity [rad/s]."""
STUCK = FIRST_OWN
"""A status: a step did not converge."""


class Rigid(NamedTuple):
    """Bodies that contact moves."""

    points: Floats
    """[P, 3] mesh points in the body's axes, from its centre of mass [m]."""
    body: Ints
    """[P] body of each point."""
    gyration: Floats
    """[B, 9] inertia per mass in the body's axes [m²]."""


class Scene(NamedTuple):
    """Everything constant in a run."""

    terms: Any
    """`kernels.Terms`"""
    pattern: Pattern
    """Over V + 2 B places."""
    time_step: float
    """[s]"""
    second_order: bool
    """Whether steps are BDF2's; else backward Euler's."""
    gravity: Floats
    """[3] [m/s²]"""
    surface: Surface
    planes: Planes
    law: Floats
    """[2, 3] of contact, and of contact between what is near at rest (`rest`): k_c [N/m³], d̂ [m], v_s [m/s]."""
    moves: NDArray[np.bool_]
    """[N] of cloth nodes, obstacle points and body points: those that contact can move."""
    rigid: Rigid
    obstacle_points: int
    """O, of static and moving obstacles."""


class WorkType(BoxType):  # type: ignore[misc]
    """Of `Work`."""


class Work(Box):  # type: ignore[misc]
    """A scene, and the part of a step that is worked on.

    Fields that are no scene's:
        freedom: [N, 2] the rows of each point's motion: its own, or its body's centre and rotation; below zero: none.
        first_body_point: V + O.
        parameters, motion: of the whole cloth; `motion` is room.
        length: of the part [s].
        keep, back: weights of the last and the last but one state in `start_positions` and `start_velocities`.
        time_step: by which velocities and forces at the part's end act [s]; shorter than `length` in BDF2.
        start_positions, start_velocities: [V, 3] what they act on: the start, or where two last states lead [m], [m/s].
        start_bodies: [B, 18]
        start_scenery, final_scenery: [O, 3] where obstacles are, and where they go [m].
        start_points: [N, 3] all points where the part starts [m].
        holder: [V] the handle that prescribes each node; -1: none.
        target: [H, 3] where prescribed nodes go [m].
        wide, moved: the pattern that also couples what touches, and where the blocks of the scene's own lie in it, as
            `sparse.widened` says.
        order: [V + 2 B] in which wide patterns are eliminated.
        fill: blocks of a factor when that order was found.
        last: the factorised matrix with which the part before ended.
        left_path: how far from its straight path that part ended [m]; the next one will not differ by much.
        serves: the `time_step` of that part [s]; 0: its matrix is of no use for this one.
    """


define(
    Work,
    WorkType,
    [
        "terms",
        "pattern",
        "gravity",
        "surface",
        "planes",
        "law",
        "moves",
        "rigid",
        "freedom",
        "first_body_point",
        "parameters",
        "motion",
        "length",
        "keep",
        "back",
        "time_step",
        "start_positions",
        "start_velocities",
        "start_bodies",
        "start_scenery",
        "final_scenery",
        "start_points",
        "holder",
        "target",
        "wide",
        "moved",
        "order",
        "fill",
        "last",
        "left_path",
        "serves",
    ],
)


@kernel
def new_work(scene: Scene, parameters: Parameters, nodes: int, bodies: int) -> Work:
    """Room to work on a scene."""
    count, others = scene.surface.point_count, scene.obstacle_points
    velocities = np.zeros((count, 3))  # before and after a step are one array here, that of its end
    motion = Motion(np.zeros((count, 3)), velocities, velocities, np.zeros((count, 3)))
    freedom = np.full((count, 2), -1, np.int64)
    for i in range(nodes):
        freedom[i, 0] = i
    for p in range(len(scene.rigid.body)):
        for turns in range(2):
            freedom[nodes + others + p, turns] = nodes + 2 * scene.rigid.body[p] + turns
    return Work(
        scene.terms,
        scene.pattern,
        scene.gravity,
        boxed(scene.surface),
        scene.planes,
        scene.law,
        scene.moves,
        scene.rigid,
        freedom,
        nodes + others,
        parameters,
        motion,
        scene.time_step,
        1.0,
        0.0,
        scene.time_step,
        np.empty((nodes, 3)),
        np.empty((nodes, 3)),
        np.empty((bodies, BODY)),
        np.empty((others, 3)),
        np.empty((others, 3)),
        np.empty((count, 3)),
        np.full(nodes, -1, np.int64),
        np.empty((len(parameters.target), 3)),
        scene.pattern,
        np.arange(len(scene.pattern.rows)),
        scene.pattern.place,
        len(scene.pattern.factor_rows),
        General(scene.pattern, np.empty((0, 9)), np.empty((0, 9)), np.empty((0, 9)), np.empty((0, 9)), 0),
        0.0,
        0.0,
    )


class Past(NamedTuple):
    """The state before the part that is worked on."""

    positions: Floats
    """[V, 3] [m]"""
    velocities: Floats
    """[V, 3] [m/s]"""
    length: Floats
    """[1] of the part between, as part of a step; 0: there is none."""


@kernel
def no_past(nodes: int) -> Past:
    """Before an episode."""
    return Past(np.zeros((nodes, 3)), np.zeros((nodes, 3)), np.zeros(1))


@kernel
def follow(past: Past, length: float, positions: Floats, velocities: Floats) -> None:
    """The start of a part that is done becomes the past of the next one."""
    past.length[0] = length
    for i in range(len(positions)):
        for axis in range(3):
            past.positions[i, axis], past.velocities[i, axis] = positions[i, axis], velocities[i, axis]


class Kept(NamedTuple):
    """What an episode's derivatives need of each step and its parts."""

    begins: Ints
    """[S + 1] the first part of each step."""
    ends: Ints
    """[n] where in its step each part ends, of `PARTS`."""
    states: Floats
    """[n, 6 V + 18 B] the end of each part: positions, velocities, bodies."""
    first_place: Ints
    """[n + 1] the first place that touches in each part."""
    listed: Ints
    """[., 5] as of `contact.places`."""
    numbers: Floats
    """[., 4]"""


@kernel
def nothing_kept(steps: int, width: int) -> Kept:
    """An empty record of states that are so wide."""
    return Kept(
        np.zeros(steps + 1, np.int64),
        np.zeros(steps + 8, np.int64),
        np.empty((steps + 8, width)),
        np.zeros(steps + 9, np.int64),
        np.empty((16, 5), np.int64),
        np.empty((16, 4)),
    )
