"""What the kernels of the implicit step are given, and what they keep for the derivatives."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffcloud.sim.compiled.data import Floats, Ints
from diffcloud.sim.compiled.kernel import kernel
from diffcloud.sim.compiled.sparse import Pattern
from diffcloud.sim.contact.places import Planes
from diffcloud.sim.contact.surface import Surface

PARTS = 32
"""A step may be halved into so many parts."""
BODY = 18
"""Numbers of a body's state: centre [m], orientation row by row, velocity [m/s], angular velocity [rad/s]."""


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
    gravity: Floats
    """[3] [m/s²]"""
    surface: Surface
    planes: Planes
    law: Floats
    """[1, 3] of contact: k_c [N/m³], d̂ [m], v_s [m/s]."""
    moves: NDArray[np.bool_]
    """[N] of cloth nodes, obstacle points and body points: those that contact can move."""
    rigid: Rigid
    obstacle_points: int
    """O, of static and moving obstacles."""


class Start(NamedTuple):
    """What one part of a step starts from, and where it is to go."""

    time_step: float
    """[s]"""
    positions: Floats
    """[V, 3] [m]"""
    velocities: Floats
    """[V, 3] [m/s]"""
    bodies: Floats
    """[B, 18]"""
    scenery: Floats
    """[O, 3] where obstacles are [m]."""
    final: Floats
    """[O, 3] where they go [m]."""
    points: Floats
    """[N, 3] all points [m]."""
    holder: Ints
    """[V] the handle that prescribes each node; -1: none."""
    target: Floats
    """[H, 3] where prescribed nodes go [m]."""


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
