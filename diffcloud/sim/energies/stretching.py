"""In-plane elasticity with the measured tables of Wang et al. 2011, as ARCSim samples them.

    energy per face = a [k0 E00²/2 + k1 E00 E11 + k2 E11²/2 + k3 E01²],   E = (FᵀF - I)/2,   k = k(E)

with F [3, 2] the deformation gradient and a the material-space area. The coefficients are looked up trilinearly in a
30³ grid over (E00, E11, |E01|). ARCSim samples with half-pixel centres and border padding (grid_sample with
align_corners = False); with zero padding the resting stiffness would be halved. They are constants in force and Hessian,
but their dependence on the strain does enter derivatives with respect to the state, as autograd sees it.

The Hessian clamps compressive strain in the geometric term and drops the shear's (ARCSim), which keeps it positive.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloud.mesh.topology import ClothMesh
from diffcloud.sim.elements import Elements
from diffcloud.sim.energies.base import Geometry, face_edges
from diffcloud.sim.materials import TABLE_ENTRY_TO_STRETCHING, Material
from diffcloud.sim.properties import Properties

_SAMPLES = 30
_SCALE = 900.0 / 29.0
"""Grid cells per unit of strain: a range factor 60/29 in grid_sample's coordinates."""


@dataclass(frozen=True)
class Stretching:
    """Stretching of F faces."""

    elements: Elements
    """[F, 3] corners."""
    area: Tensor
    """[F] material-space area [m²]."""
    inverse_rest: Tensor
    """[F, 2, 2] Dm⁻¹ [1/m]: row i belongs to edge i, column to the material direction (u, v)."""
    corner_weights: Tensor
    """[F, 9, 6] maps (w_u, w_v) [6] to the corners [9]: derivative of x_u, x_v by corner, times I3."""
    pull: Tensor
    """[F, 3, 2] minus area times the derivative of x_u, x_v by corner [m]."""
    cells: Tensor
    """[29³, 8, 5] trilinear polynomial (x, y, z, xy, xz, yz, xyz, 1) of (k0, k1, k1, k2, k3) in each cell [N/m]."""
    cell_strides: Tensor
    """[3] of the flattened cells."""

    @staticmethod
    def build(mesh: ClothMesh, material: Material, *, dtype: torch.dtype, device: torch.device) -> Stretching:
        """Precompute rest shapes and the table of a cloth."""
        inverse = np.linalg.inv(mesh.material_edges).astype(np.float64)
        weights = np.stack([-inverse.sum(axis=1), inverse[:, 0], inverse[:, 1]], axis=1)  # [F, corner, direction]
        expanded = np.einsum("fca,xy->fcxay", weights, np.eye(3)).reshape(-1, 9, 6)

        def tensor(array: NDArray[np.float64]) -> Tensor:
            return torch.as_tensor(array, dtype=dtype, device=device)

        return Stretching(
            elements=Elements(torch.as_tensor(mesh.faces, device=device), len(mesh.nodes)),
            area=tensor(mesh.face_area),
            inverse_rest=tensor(inverse),
            corner_weights=tensor(expanded),
            pull=tensor(-mesh.face_area[:, None, None] * weights),
            cells=tensor(_cell_polynomials(_sample_table(material.stretching)[[0, 1, 1, 2, 3]])),
            cell_strides=torch.tensor([(_SAMPLES - 1) ** 2, _SAMPLES - 1, 1], device=device),
        )

    def at(self, geometry: Geometry, properties: Properties) -> StretchingAt:
        gradient = self.inverse_rest.mT @ geometry.face_edges
        identity = torch.eye(2, dtype=gradient.dtype, device=gradient.device)
        strain = 0.5 * (gradient @ gradient.mT - identity)
        normal = strain.diagonal(dim1=-2, dim2=-1)
        k = self.coefficients(normal, strain[..., 0, 1]) * properties.stretching[..., None]
        return StretchingAt(self, gradient, strain, normal, k[..., :4].unflatten(-1, (2, 2)), k[..., 4])

    def coefficients(self, normal: Tensor, shear: Tensor) -> Tensor:
        """Strains (E00, E11) [..., 2] and E01 [...] -> [..., 5] the looked-up (k0, k1, k1, k2, k3) [N/m]."""
        position = torch.cat([normal + 0.25, shear[..., None].abs()], dim=-1) * _SCALE - 0.5
        position = position.clamp(0.0, _SAMPLES - 1.0)
        corner = position.detach().floor().clamp(max=_SAMPLES - 2.0)
        local = position - corner
        x, y, z = local.unbind(-1)
        cell = (corner.long() * self.cell_strides).sum(-1)
        xy = x * y
        monomials = torch.cat([local, torch.stack([xy, x * z, y * z, xy * z, torch.ones_like(x)], dim=-1)], dim=-1)
        return (monomials[..., None, :] @ self.cells[cell]).squeeze(-2)


@dataclass(frozen=True)
class StretchingAt:
    """Stretching at one configuration."""

    of: Stretching
    gradient: Tensor
    """[B, F, 2, 3] rows x_u and x_v: the deformation gradient, transposed."""
    strain: Tensor
    """[B, F, 2, 2] E"""
    normal: Tensor
    """[B, F, 2] its diagonal."""
    stiffness: Tensor
    """[B, F, 2, 2] ((k0, k1), (k1, k2)) [N/m]."""
    shear: Tensor
    """[B, F] k3 [N/m]."""

    def energy(self) -> Tensor:
        axial = 0.5 * (self.normal * self._apply_stiffness(self.normal)).sum(-1)
        return (self.of.area * (axial + self.shear * self.strain[..., 0, 1].square())).sum(-1)

    def forces(self, displacement: Tensor | None = None) -> Tensor:
        strain, normal = self.strain, self.normal
        if displacement is not None:
            moved = self.of.inverse_rest.mT @ face_edges(self.of.elements, displacement)  # [B, F, 2, 3]
            turn = self.gradient @ moved.mT  # [B, F, 2, 2]: x_a . d_b
            strain = strain + 0.5 * (turn + turn.mT)
            normal = strain.diagonal(dim1=-2, dim2=-1)
        s_uv = self.shear * strain[..., 0, 1]
        s_uu, s_vv = self._apply_stiffness(normal).unbind(-1)
        rows = torch.stack([s_uu, s_uv, s_uv, s_vv], dim=-1).unflatten(-1, (2, 2)) @ self.gradient
        if displacement is not None:
            rows = rows + self._tension()[..., None] * moved
        pulls = self.of.pull @ rows  # [B, F, 3, 3] on the corners
        return self.of.elements.scatter(pulls)

    def hessian(self) -> Tensor:
        area = self.of.area[:, None, None, None]
        k0, k1, _, k2 = (area * self.stiffness.flatten(-2)[:, :, None, None]).unbind(-1)  # [B, F, 1, 1]
        k3 = 0.5 * area[..., 0] * self.shear[..., None, None]
        flat = self.gradient.flatten(-2)  # (x_u, x_v)
        outer = flat[..., :, None] * flat[..., None, :]
        uu, uv, vu, vv = outer[..., :3, :3], outer[..., :3, 3:], outer[..., 3:, :3], outer[..., 3:, 3:]
        identity = torch.eye(3, dtype=flat.dtype, device=flat.device)
        tension_u, tension_v = (area * self._tension()[:, :, None, None]).unbind(-1)
        top_left = k0 * uu + k3 * vv + tension_u * identity
        bottom_right = k2 * vv + k3 * uu + tension_v * identity
        top_right = k1 * uv + k3 * vu
        middle = torch.cat([torch.cat([top_left, top_right], -1), torch.cat([top_right.mT, bottom_right], -1)], dim=-2)
        return self.of.corner_weights @ middle @ self.of.corner_weights.mT

    def _apply_stiffness(self, normal: Tensor) -> Tensor:
        """[B, F, 2] -> [B, F, 2]"""
        return (self.stiffness @ normal[..., None]).squeeze(-1)

    def _tension(self) -> Tensor:
        """[B, F, 2] geometric stiffness along u and v, tension only [N/m]."""
        return self._apply_stiffness(self.normal.clamp(min=0))


def _sample_table(stretching: NDArray[np.float64]) -> NDArray[np.float64]:
    """[6, 4] table -> [4, 30, 30, 30] coefficients over (C00, C11, C01), C = FᵀF (PHYSICS: grid of samples)."""
    index = np.arange(_SAMPLES)
    c00, c11, c01 = np.meshgrid(0.5 + index / 15, 0.5 + index / 15, index / 15, indexing="ij")
    largest = 0.5 * (c00 + c11 + np.sqrt(4 * c01**2 + (c00 - c11) ** 2))
    direction_u, direction_v = largest - c11, c01.copy()
    axis_aligned = c01 == 0
    direction_u[axis_aligned] = (c00 >= c11)[axis_aligned]
    direction_v[axis_aligned] = (c00 < c11)[axis_aligned]
    angle = 8 * np.abs(np.arctan2(direction_v, direction_u)) / np.pi
    strain = 6 * (np.sqrt(largest) - 1)
    p = np.clip(1.25 * angle - 0.5, 0, 4)
    q = np.clip(2 * strain - 0.5, 0, 1)
    low = np.minimum(p.astype(int), 3)
    fraction = p - low
    reference = stretching[1:].T  # [4, 5]
    at_reference = reference[:, low] * (1 - fraction) + reference[:, low + 1] * fraction
    at_rest = stretching[0][:, None, None, None]
    return np.maximum(0.0, TABLE_ENTRY_TO_STRETCHING * (at_rest * (1 - q) + at_reference * q))


def _cell_polynomials(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """[K, n, n, n] -> [(n-1)³, 8, K]: each cell's trilinear polynomial in its local coordinates."""
    low, high = slice(None, -1), slice(1, None)

    def corner(x: slice, y: slice, z: slice) -> NDArray[np.float64]:
        return table[:, x, y, z]

    c000, c100, c010, c001 = (
        corner(low, low, low),
        corner(high, low, low),
        corner(low, high, low),
        corner(low, low, high),
    )
    c110, c101, c011, c111 = (
        corner(high, high, low),
        corner(high, low, high),
        corner(low, high, high),
        corner(high, high, high),
    )
    polynomial = [
        c100 - c000,
        c010 - c000,
        c001 - c000,
        c110 - c100 - c010 + c000,
        c101 - c100 - c001 + c000,
        c011 - c010 - c001 + c000,
        c111 - c110 - c101 - c011 + c100 + c010 + c001 - c000,
        c000,
    ]
    return np.stack(polynomial).transpose(2, 3, 4, 0, 1).reshape(-1, 8, len(table))
