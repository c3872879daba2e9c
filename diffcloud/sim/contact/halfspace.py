"""Contact with half-spaces n · x >= offset: repulsion, lagged Coulomb friction, and projection.

Repulsion (ARCSim, thickness τ): C = n · x - offset - τ, violation c = max(-C, 0), energy K c³/(6 τ) with K = k_c times
the node's material area; force K c²/(2 τ) along n, stiffness K c/τ.

Friction (lagged: normal force and sliding direction of the start of the step): γ = min(μ f_n / |v_t|, m / Δt), force
-γ P v with P = I - n nᵀ, implicit in v. The second branch is sticking: it halves the sliding velocity in each
step, so a node on an incline of angle α creeps at g sin(α) Δt, which vanishes with the step.

Projection: a node whose candidate position is behind the plane is put at the projection thickness above it. For a single
static plane this is the exact solution of the impact-zone problem (nodes do not couple), and inelastic.

Not reproduced from ARCSim: the doubled constraint of the node nearest to each obstacle face, contacts of cloth edges
with the obstacle's edges, and the plane's finite extent.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffcloud.sim.elements import safe_norm

_TINY = 1e-12


@dataclass(frozen=True)
class ContactSettings:
    """Numbers of the contact models."""

    stiffness: float = 1e4
    """k_c [N/m³]: times a node's area gives the contact stiffness (ARCSim's default is 1e9)."""
    repulsion_thickness: float = 3e-3
    """τ, and d̂ of smooth contact [m] (ARCSim's default is 1e-3)."""
    projection_thickness: float = 3e-4
    """Of the linearised integrator [m]."""
    sticking_speed: float = 1e-3
    """v_s of smooth contact: what sticks creeps slower than this [m/s]."""


@dataclass(frozen=True)
class HalfSpaces:
    """P half-spaces and the N nodes that meet them."""

    normals: Tensor
    """[P, 3] unit, pointing to the side of the cloth."""
    offsets: Tensor
    """[P] [m]"""
    node_area: Tensor
    """[V] [m²]"""
    settings: ContactSettings

    def at(
        self,
        positions: Tensor,
        velocities: Tensor,
        node_mass: Tensor,
        friction: Tensor,
        time_step: float,
    ) -> HalfSpaceContact:
        """Contact linearised at the start of the step, which friction is lagged from.

        Args:
            positions, velocities: [B, V, 3] at the start of the step.
            node_mass, friction: [B, V] [kg], [B] [-].
        """
        violation, stiffness = self._violation(positions)
        normal_force = 0.5 * stiffness * violation
        limit = friction[:, None, None] * normal_force
        normal_speed = velocities @ self.normals.T
        tangential = velocities[:, :, None] - normal_speed[..., None] * self.normals
        sticking = limit * (time_step / node_mass)[..., None]
        gamma = limit / torch.maximum(safe_norm(tangential), sticking + _TINY)
        return HalfSpaceContact(self, normal_force, stiffness, gamma)

    def project(self, candidate: Tensor) -> Tensor:
        """[B, V, 3] candidate positions, those behind a plane put back above it."""
        for normal, offset in zip(self.normals, self.offsets, strict=True):  # a scene has a handful of planes
            gap = candidate @ normal - offset
            lift = torch.where(gap < 0, self.settings.projection_thickness - gap, 0.0)
            candidate = candidate + lift[..., None] * normal
        return candidate

    def _violation(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Violation c [B, V, P] [m] and stiffness K c / τ [N/m]."""
        thickness = self.settings.repulsion_thickness
        violation = (thickness + self.offsets - positions @ self.normals.T).clamp(min=0)
        return violation, violation * (self.settings.stiffness / thickness * self.node_area[:, None])


@dataclass(frozen=True)
class HalfSpaceContact:
    """Contact at one configuration."""

    of: HalfSpaces
    normal_force: Tensor
    """[B, V, P] [N]"""
    stiffness: Tensor
    """[B, V, P] along the normal [N/m]."""
    gamma: Tensor
    """[B, V, P] friction per sliding velocity [N·s/m]."""

    def forces(self, displacement: Tensor, sliding: Tensor) -> Tensor:
        """[B, V, 3] repulsion after a `displacement` [m] and friction of the velocity `sliding` [m/s]."""
        normals = self.of.normals
        along = self.normal_force - self.stiffness * (displacement @ normals.T) + self.gamma * (sliding @ normals.T)
        return along @ normals - self.gamma.sum(-1, keepdim=True) * sliding

    def blocks(self, time_step: float) -> Tensor:
        """[B, V, 3, 3] Δt² (repulsion stiffness) + Δt (friction), the contact's part of the step matrix."""
        normals = self.of.normals
        outer = normals[:, :, None] * normals[:, None, :]  # [P, 3, 3]
        identity = torch.eye(3, dtype=normals.dtype, device=normals.device)
        along = ((time_step**2 * self.stiffness - time_step * self.gamma) @ outer.flatten(1)).unflatten(-1, (3, 3))
        return along + (time_step * self.gamma.sum(-1))[..., None, None] * identity
