"""Hinge bending (Bridson et al. 2003, Grinspun et al. 2003) with the measured table of Wang et al. 2011.

    energy per hinge = K θ²/2,   K = k_b l² / (4 (a0 + a1)),   k_b = min over both sides of the table

θ is the dihedral angle less its rest angle: zero everywhere, as in ARCSim, also for meshes that start curved; or the angle
at the start, for what keeps its shape (`shaped`). l is the material-space length of the edge. The table is looked up
at the edge's direction in material space, which is constant, and at the curvature 0.05 θ l/(a0+a1), signed: negative
angles take the first column. So each side is reduced to five numbers beforehand, and the look-up is one-dimensional. As
with stretching, k_b counts as constant in force and Hessian, and the Hessian is K ∇θ ∇θᵀ (no second derivative of θ).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloud.mesh.topology import ClothMesh
from diffcloud.sim.elements import Elements, safe_norm
from diffcloud.sim.energies.base import Geometry
from diffcloud.sim.materials import Material
from diffcloud.sim.properties import Properties

_SMALLEST_HEIGHT = 1e-3
"""Heights of a hinge's triangles are kept above this part of the edge (ARCSim)."""
_CURVATURE_SCALE = 0.05
_TINY = 1e-30


@dataclass(frozen=True)
class Bending:
    """Bending over H hinges."""

    elements: Elements
    """[H, 4]: edge n0, n1, then the opposite nodes."""
    faces: Tensor
    """[2H] face of slot 0 and 1 of each hinge, to pick normals."""
    stiffness: Tensor
    """[H] l² / (4 (a0 + a1)) [-]: times k_b [N·m] gives K."""
    curvature: Tensor
    """[H] 2.5 · 0.05 · l / (a0 + a1): table columns per radian."""
    rest_angle: Tensor
    """[H] [rad]"""
    table: Tensor
    """[H, 2, 5] k_b over curvature columns, already interpolated to the direction of each side [N·m]."""

    @staticmethod
    def build(
        mesh: ClothMesh, material: Material, *, dtype: torch.dtype, device: torch.device, shaped: bool = False
    ) -> Bending:
        """Precompute the hinges and their table rows.

        Args:
            shaped: whether the hinges are at rest as the mesh stands, not flat.
        """
        hinges = mesh.hinges
        area = mesh.face_area[hinges.faces].sum(axis=1)

        def tensor(array: NDArray[np.float64]) -> Tensor:
            return torch.as_tensor(array, dtype=dtype, device=device)

        return Bending(
            elements=Elements(torch.as_tensor(hinges.nodes, device=device), len(mesh.nodes)),
            faces=torch.as_tensor(hinges.faces.reshape(-1), device=device),
            stiffness=tensor(hinges.length**2 / (4 * area)),
            curvature=tensor(2.5 * _CURVATURE_SCALE * hinges.length / area),
            rest_angle=_angles(mesh, tensor) if shaped else tensor(np.zeros(len(hinges.length))),
            table=tensor(_rows_at(material.bending, hinges.angle)),
        )

    def at(self, geometry: Geometry, properties: Properties) -> BendingAt:
        corners = self.elements.gather(geometry.positions)
        edge = corners[:, :, 1] - corners[:, :, 0]
        opposite = corners[:, :, 2:] - corners[:, :, :1]  # [B, H, 2, 3]
        squared = edge.square().sum(-1).clamp(min=_TINY)
        length = squared.sqrt()
        along = (opposite @ edge[..., None]).squeeze(-1) / squared[..., None]  # [B, H, 2]
        normals = geometry.area_normals.gather(1, self.faces.view(1, -1, 1).expand(len(edge), -1, 3)).view_as(opposite)
        area = safe_norm(normals)  # length times height
        n0, n1 = normals.unbind(2)
        angle = _dihedral(edge, length, n0, n1) - self.rest_angle
        angle = angle - 2 * torch.pi * (angle.detach() / (2 * torch.pi)).round()  # the short way round
        # unit normal over height, with the height kept above a part of the edge
        tilt = normals / (area * torch.maximum(area / length[..., None], _SMALLEST_HEIGHT * length[..., None]))[..., None]
        on_edge = torch.stack([along - 1.0, -along], dim=-2) @ tilt  # [B, H, 2, 3]: on n0 and n1
        gradient = torch.cat([on_edge, tilt], dim=2)
        return BendingAt(self, angle, gradient, self._coefficient(angle, properties))

    def _coefficient(self, angle: Tensor, properties: Properties) -> Tensor:
        """[B, H] K [N·m]."""
        column = (self.curvature * angle - 0.5).clamp(0.0, 4.0)
        low = column.detach().floor().clamp(max=3.0)
        index = low.long()[..., None, None].expand(-1, -1, 2, 1)  # [B, H, 2, 1]
        table = self.table.expand(len(angle), -1, -1, -1)
        left, right = table.gather(-1, index).squeeze(-1), table.gather(-1, index + 1).squeeze(-1)
        sides = (left + (right - left) * (column - low)[..., None]).clamp(min=0.0)
        return sides.amin(-1) * self.stiffness * properties.bending


@dataclass(frozen=True)
class BendingAt:
    """Bending at one configuration."""

    of: Bending
    angle: Tensor
    """[B, H] θ [rad], less the rest angle"""
    gradient: Tensor
    """[B, H, 4, 3] ∇θ [rad/m]"""
    stiffness: Tensor
    """[B, H] K [N·m]"""

    def energy(self) -> Tensor:
        return 0.5 * (self.stiffness * self.angle.square()).sum(-1)

    def forces(self, displacement: Tensor | None = None) -> Tensor:
        angle = self.angle
        if displacement is not None:
            angle = angle + (self.gradient * self.of.elements.gather(displacement)).sum((-2, -1))
        return self.of.elements.scatter((-self.stiffness * angle)[..., None, None] * self.gradient)

    def hessian(self) -> Tensor:
        flat = self.gradient.flatten(-2)
        return (self.stiffness[..., None] * flat)[..., :, None] * flat[..., None, :]


def _rows_at(bending: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3, 5] table, [H, 2] directions -> [H, 2, 5]; half-pixel rows, reflected at -0.5 and 2.5, then clamped."""
    row = (6 * angle / np.pi) % 6.0  # reflection about -0.5 and 2.5 folds the direction into a period of pi
    row = np.clip(np.where(row > 3.0, 6.0 - row, row) - 0.5, 0.0, 2.0)
    low = np.minimum(row.astype(int), 1)
    fraction = (row - low)[..., None]
    return bending[low] * (1 - fraction) + bending[low + 1] * fraction


def _dihedral(edge: Tensor, length: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """[...] angle of the normals [..., 3] (any length) on both sides of an edge [..., 3] with its length [...] [rad]."""
    sine = -(edge * torch.linalg.cross(first, second)).sum(-1) / length
    cosine = (first * second).sum(-1)
    # atan2(0, 0), a hinge with a collapsed face, has no derivative: call it flat
    cosine = cosine + (sine.abs() + cosine.abs() < _TINY)
    return torch.atan2(sine, cosine)


def _angles(mesh: ClothMesh, tensor: Callable[[NDArray[np.float64]], Tensor]) -> Tensor:
    """[H] dihedral angles as the mesh stands [rad]."""
    corner = mesh.nodes[mesh.faces[mesh.hinges.faces]]  # [H, 2, 3, 3]
    normals = tensor(np.cross(corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0]))
    edge = tensor(mesh.nodes[mesh.hinges.nodes[:, 1]] - mesh.nodes[mesh.hinges.nodes[:, 0]])
    return _dihedral(edge, safe_norm(edge), normals[:, 0], normals[:, 1])
