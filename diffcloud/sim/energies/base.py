"""What every internal energy offers, and the geometry they share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from diffcloud.sim.elements import Elements
from diffcloud.sim.properties import Properties


@dataclass(frozen=True)
class Geometry:
    """Positions and what several energies need of them, computed once."""

    positions: Tensor
    """[B, V, 3] [m]"""
    face_edges: Tensor
    """[B, F, 2, 3] the two edges that leave corner 0 of each face [m]."""
    area_normals: Tensor
    """[B, F, 3] normals (right-hand rule), as long as twice the world-space area [m²]."""


def geometry(faces: Elements, positions: Tensor) -> Geometry:
    """Shared geometry at `positions` [B, V, 3]."""
    edges = face_edges(faces, positions)
    return Geometry(positions, edges, torch.linalg.cross(edges[:, :, 0], edges[:, :, 1]))


def face_edges(faces: Elements, field: Tensor) -> Tensor:
    """[B, V, 3] -> [B, F, 2, 3]: differences of a node field from corner 0 to corners 1 and 2."""
    corners = faces.gather(field)
    return corners[:, :, 1:] - corners[:, :, :1]


class Linearisation(Protocol):
    """An energy at one configuration. Evaluated once, used for forces and Hessian."""

    def energy(self) -> Tensor:
        """[B] [J]."""
        ...

    def forces(self, displacement: Tensor | None = None) -> Tensor:
        """[B, V, 3] [N]: F(x) - H(x) d for a displacement d [B, V, 3] of the nodes (none: F)."""
        ...

    def hessian(self) -> Tensor:
        """[B, E, 3n, 3n] [N/m]: blocks over the n nodes of each element."""
        ...


class InternalEnergy(Protocol):
    """An elastic energy of the cloth.

    Its stiffness coefficients come from measured tables; as in ARCSim they count as constants in forces and Hessian, so
    forces = -d energy / d x at frozen coefficients, and the Hessian is positive semidefinite (Gauss-Newton).
    """

    elements: Elements

    def at(self, geometry: Geometry, properties: Properties) -> Linearisation:
        """The energy at a configuration."""
        ...
