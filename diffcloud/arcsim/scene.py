"""Constant data for the kernels of ARCSim's step."""

from __future__ import annotations

from typing import Any, NamedTuple

from diffcloud.arcsim.contact.impact_zones import Projection
from diffcloud.arcsim.contact.nearest import Repulsion
from diffcloud.sim.compiled.data import Floats
from diffcloud.sim.compiled.sparse import Pattern
from diffcloud.sim.contact.surface import Surface
from diffcloud.sim.status import FIRST_OWN

NOT_POSITIVE_DEFINITE = FIRST_OWN
"""Status: the step matrix cannot be factorised."""
UNRESOLVED = FIRST_OWN + 1
"""Status: the passes of detection and projection did not resolve all impacts."""


class Scene(NamedTuple):
    """All data that are constant in a simulation."""

    terms: Any
    """Elements of the force terms (`kernels.Terms`)."""
    pattern: Pattern
    time_step: float
    """Time step [s]."""
    obstacles: Floats
    """[O, 3] points of static obstacles [m]."""
    plane_normals: Floats
    """[P, 3] unit normals of the half-spaces n · x >= offset that stop nodes."""
    plane_offsets: Floats
    """[P] offsets [m]."""
    surface: Surface
    repels: bool
    """Whether pairs of meshes repel each other, with friction."""
    collides: bool
    """Whether impacts between meshes are resolved."""
    repulsion: Repulsion
    projection: Projection
