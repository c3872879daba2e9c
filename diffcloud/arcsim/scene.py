"""What the kernels of ARCSim's step are given."""

from __future__ import annotations

from typing import Any, NamedTuple

from diffcloud.arcsim.contact.impact_zones import Projection
from diffcloud.arcsim.contact.nearest import Repulsion
from diffcloud.sim.compiled.data import Floats
from diffcloud.sim.compiled.sparse import Pattern
from diffcloud.sim.contact.surface import Surface
from diffcloud.sim.status import FIRST_OWN

NOT_POSITIVE_DEFINITE = FIRST_OWN
"""A status: the step matrix cannot be factorised."""
UNRESOLVED = FIRST_OWN + 1
"""A status: impacts that passes of detection and projection did not resolve."""


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
