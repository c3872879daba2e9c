"""Data structures of the implicit kernels: constant scene, work space, and records for the derivatives."""

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
"""Largest number of parts into which a step can be halved."""
BODY = 18
"""Length of a body's state: centre [m], rotation matrix in row-major order, velocity [m/s], angular velocity [rad/s]."""
STUCK = FIRST_OWN
"""Status: a step did not converge."""


class Rigid(NamedTuple):
    """Rigid bodies that contact moves."""

    points: Floats
    """[P, 3] mesh points in the body frame, whose origin is the centre of mass [m]."""
    body: Ints
    """[P] index of the body of each point."""
    gyration: Floats
    """[B, 9] inertia per mass in the body frame [m²]."""


class Scene(NamedTuple):
    """All data that are constant in a simulation."""

    terms: Any
    """Elements of the force terms (`kernels.Terms`)."""
    pattern: Pattern
    """Sparsity pattern of the matrix, with V + 2 B rows."""
    time_step: float
    """Time step [s]."""
    second_order: bool
    """True: BDF2. False: backward Euler."""
    gravity: Floats
    """[3] gravitational acceleration [m/s²]."""
    surface: Surface
    planes: Planes
    law: Floats
    """[2, 3] contact parameters k_c [N/m³], d̂ [m], v_s [m/s]: for usual pairs, and for pairs that are close at rest
    (`rest`)."""
    moves: NDArray[np.bool_]
    """[N] True for the cloth nodes, obstacle points and body points that contact can move."""
    rigid: Rigid
    obstacle_points: int
    """Number O of points on static and moving obstacles."""


class WorkType(BoxType):  # type: ignore[misc]
    """Numba type of `Work`."""


class Work(Box):  # type: ignore[misc]
    """A scene, and the part of a step that is being solved.

    Fields that are not in `Scene`:
        freedom: [N, 2] matrix rows of each point: its own, or its body's centre and rotation; -1 for none.
        first_body_point: V + O.
        parameters, motion: of the whole cloth; `motion` is scratch space.
        length: of the part [s].
        keep, back: weights of the last state and the state before it in `start_positions` and `start_velocities`.
        time_step: factor of velocities and forces at the part's end [s]; shorter than `length` in BDF2.
        start_positions, start_velocities: [V, 3] x̂ and v̂ of the equation [m], [m/s].
        start_bodies: [B, 18] states at the start.
        start_scenery, final_scenery: [O, 3] obstacle points at the start and end of the part [m].
        start_points: [N, 3] all points at the start of the part [m].
        holder: [V] the handle that prescribes each node; -1 for none.
        target: [H, 3] where prescribed nodes end [m].
        wide, moved: pattern extended by contacts, and the indices of the scene's blocks in it (`sparse.widened`).
        order: [V + 2 B] elimination order of extended patterns.
        fill: number of blocks of the factor when this order was computed.
        last: final factorised matrix of the previous part.
        left_path: final distance of the previous part from its straight path [m]. It predicts that of the next part.
        serves: `time_step` of the previous part [s]; 0 if its matrix cannot be reused.
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
    """Allocate the work space for a scene."""
    count, others = scene.surface.point_count, scene.obstacle_points
    velocities = np.zeros((count, 3))  # one array: velocities before and after a step are both those of its end
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
    """The state before the current part, for BDF2."""

    positions: Floats
    """[V, 3] positions [m]."""
    velocities: Floats
    """[V, 3] velocities [m/s]."""
    length: Floats
    """[1] length of the part between both states, as a fraction of a step; 0 if there is no earlier state."""


@kernel
def no_past(nodes: int) -> Past:
    """`Past` at the start of an episode."""
    return Past(np.zeros((nodes, 3)), np.zeros((nodes, 3)), np.zeros(1))


@kernel
def follow(past: Past, length: float, positions: Floats, velocities: Floats) -> None:
    """Make the start of a finished part the past of the next one."""
    past.length[0] = length
    for i in range(len(positions)):
        for axis in range(3):
            past.positions[i, axis], past.velocities[i, axis] = positions[i, axis], velocities[i, axis]


class Kept(NamedTuple):
    """Record of each step and its parts, for the derivatives."""

    begins: Ints
    """[S + 1] index of the first part of each step."""
    ends: Ints
    """[n] end of each part within its step, in units of 1 / `PARTS`."""
    states: Floats
    """[n, 6 V + 18 B] state at the end of each part: positions, velocities, bodies."""
    first_place: Ints
    """[n + 1] index of the first contact of each part."""
    listed: Ints
    """[., 5] contacts, as in `contact.places`."""
    numbers: Floats
    """[., 4] numbers of the contacts, as in `contact.places`."""


@kernel
def nothing_kept(steps: int, width: int) -> Kept:
    """Empty record for states of the given width."""
    return Kept(
        np.zeros(steps + 1, np.int64),
        np.zeros(steps + 8, np.int64),
        np.empty((steps + 8, width)),
        np.zeros(steps + 9, np.int64),
        np.empty((16, 5), np.int64),
        np.empty((16, 4)),
    )
