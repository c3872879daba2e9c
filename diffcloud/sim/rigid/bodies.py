"""Movable obstacles: mass and inertia of their meshes, their pose, and how a step moves them.

A step moves a body with its new velocities: centre c₁ = c₀ + Δt v₁, orientation R₁ = exp(Δt ω₁) R₀. The unknowns are the
changes of v and ω; the equations are the balances of linear and of angular momentum,

    M (v₁ - v₀) = Δt (M g + Σ f),      I(R₁) ω₁ - I(R₀) ω₀ = Δt Σ (p - c₁) × f,

so that a body without contact keeps its angular momentum exactly. (The reference simulator uses Euler angles, a point
mass per node and no angular acceleration; PHYSICS section 9.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloud.errors import SceneError
from diffcloud.sim.rigid.body import RigidBody
from diffcloud.sim.rigid.rotation import rotation


@dataclass(frozen=True)
class BodyState:
    """Poses and velocities of N bodies in a batch."""

    centre: Tensor
    """[B, N, 3] of mass [m]."""
    orientation: Tensor
    """[B, N, 3, 3] from body to world."""
    velocity: Tensor
    """[B, N, 3] [m/s]"""
    angular_velocity: Tensor
    """[B, N, 3] in the world's axes [rad/s]."""

    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.centre, self.orientation, self.velocity, self.angular_velocity


@dataclass(frozen=True)
class Bodies:
    """N rigid bodies."""

    points: Tensor
    """[P, 3] mesh points in the body's axes, from its centre of mass [m]."""
    body: Tensor
    """[P] body of each point."""
    mass: Tensor
    """[N] [kg]"""
    gyration: Tensor
    """[N, 3, 3] inertia per mass in the body's axes [m²]."""
    start: BodyState = field(repr=False)
    """Batch 1."""

    @staticmethod
    def build(
        bodies: Sequence[RigidBody], *, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu"
    ) -> Bodies:
        """Mass properties of the meshes (trimesh integrates over the volume).

        Raises:
            SceneError: a mesh that is open or turned inside out, or a mass or density that is not positive.
        """
        points, index, masses, gyrations, centres = [], [], [], [], []
        for number, body in enumerate(bodies):
            import trimesh  # slow to import, and most scenes have no bodies

            solid = trimesh.Trimesh(body.mesh.nodes, body.mesh.faces, process=False)
            if not solid.is_watertight or solid.volume <= 0:
                raise SceneError(
                    f"Rigid body {number}: its mesh must be closed with faces turned outwards (watertight: "
                    f"{solid.is_watertight}, volume {solid.volume:.3g} m³); close the holes or flip the faces."
                )
            mass = body.density * solid.volume if body.mass is None else body.mass
            if not mass > 0:
                raise SceneError(
                    f"Rigid body {number}: mass and density must be positive, got {body.mass} and {body.density}."
                )
            points.append(body.mesh.nodes - solid.center_mass)
            index.append(np.full(len(body.mesh.nodes), number))
            masses.append(mass)
            gyrations.append(solid.moment_inertia / solid.volume)
            centres.append(solid.center_mass)

        def tensor(array: NDArray[np.float64]) -> Tensor:
            return torch.as_tensor(np.asarray(array, dtype=np.float64), dtype=dtype, device=device)

        count = len(bodies)
        start = BodyState(
            centre=tensor(np.array(centres).reshape(1, count, 3)),
            orientation=torch.eye(3, dtype=dtype, device=device).expand(1, count, 3, 3),
            velocity=tensor(np.array([body.velocity for body in bodies]).reshape(1, count, 3)),
            angular_velocity=tensor(np.array([body.angular_velocity for body in bodies]).reshape(1, count, 3)),
        )
        return Bodies(
            points=tensor(np.concatenate([*points, np.zeros((0, 3))])),
            body=torch.as_tensor(np.concatenate([*index, np.zeros(0)]), dtype=torch.long, device=device),
            mass=tensor(np.array(masses)),
            gyration=tensor(np.array(gyrations).reshape(count, 3, 3)),
            start=start,
        )

    def __len__(self) -> int:
        return len(self.mass)

    def arms(self, orientation: Tensor) -> Tensor:
        """[B, P, 3] from the centre of mass to each point, in the world's axes [m]."""
        return (orientation[:, self.body] @ self.points[..., None]).squeeze(-1)

    def places(self, state: BodyState) -> Tensor:
        """[B, P, 3] world positions of the mesh points [m]."""
        return state.centre[:, self.body] + self.arms(state.orientation)

    def moved(self, state: BodyState, velocity: Tensor, angular_velocity: Tensor, time_step: float) -> BodyState:
        """The state after a step with the given new velocities, each [B, N, 3]."""
        turned = rotation(time_step * angular_velocity) @ state.orientation
        return BodyState(state.centre + time_step * velocity, turned, velocity, angular_velocity)

    def angular_momentum(self, mass: Tensor, orientation: Tensor, angular_velocity: Tensor) -> Tensor:
        """[B, N, 3] about the centre of mass, of bodies with mass [B, N] [kg·m²/s]."""
        local = orientation.mT @ angular_velocity[..., None]
        return mass[..., None] * (orientation @ (self.gyration @ local)).squeeze(-1)
