"""What the kernels of the linearised step are given, and what they keep for the derivatives."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from diffcloud.sim.compiled.data import Floats, Ints
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
