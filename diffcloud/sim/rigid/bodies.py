"""Rigid bodies that contact can move: mass and inertia of their meshes, and their states.

A step moves a body with its velocities at the end of the step: centre c₁ = c₀ + Δt v₁, orientation R₁ = exp(Δt ω₁) R₀. The
equations are the balances of linear and of angular momentum,

    M (v₁ - v₀) = Δt (M g + Σ f),      I(R₁) ω₁ - I(R₀) ω₀ = Δt Σ (p - c₁) × f,

so a body without contact conserves its angular momentum exactly (`rigid.spin`). ARCSim instead uses Euler angles, a point
mass per node and no angular acceleration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from diffcloud.errors import SceneError
from diffcloud.sim.rigid.body import RigidBody


@dataclass(frozen=True)
class BodyState:
    """Poses and velocities of N bodies in a batch."""

    centre: Tensor
    """[B, N, 3] centre of mass [m]."""
    orientation: Tensor
    """[B, N, 3, 3] rotation matrix from the body frame to the world frame."""
    velocity: Tensor
    """[B, N, 3] velocity of the centre of mass [m/s]."""
    angular_velocity: Tensor
    """[B, N, 3] angular velocity in the world frame [rad/s]."""

    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.centre, self.orientation, self.velocity, self.angular_velocity


@dataclass(frozen=True)
class Bodies:
    """Constant data of B rigid bodies."""

    points: NDArray[np.float64]
    """[P, 3] mesh points in the body frame, whose origin is the centre of mass [m]."""
    body: NDArray[np.int64]
    """[P] index of the body of each point."""
    mass: NDArray[np.float64]
    """[B] mass of each body [kg]."""
    gyration: NDArray[np.float64]
    """[B, 3, 3] inertia per mass in the body frame [m²]."""
    start: NDArray[np.float64]
    """[B, 18] initial states: centre, rotation matrix in row-major order, velocity, angular velocity."""

    @staticmethod
    def build(bodies: Sequence[RigidBody]) -> Bodies:
        """Compute mass and inertia from the volumes of the meshes.

        Raises:
            SceneError: a mesh is open or its faces point inwards, or a mass or density is not positive.
        """
        points, index, masses, gyrations, starts = [np.zeros((0, 3))], [np.zeros(0)], [], [], []
        for number, body in enumerate(bodies):
            import trimesh  # slow to import, and most scenes have no bodies

            solid = trimesh.Trimesh(body.mesh.nodes, body.mesh.faces, process=False)
            with np.errstate(divide="ignore", invalid="ignore"):  # trimesh divides by the volume, which may be zero
                volume = float(solid.volume)
            if not solid.is_watertight or volume <= 0:
                raise SceneError(
                    f"Rigid body {number}: its mesh must be closed with faces turned outwards (watertight: "
                    f"{solid.is_watertight}, volume {volume:.3g} m³); close the holes or flip the faces."
                )
            mass = body.density * volume if body.mass is None else body.mass
            if not mass > 0:
                raise SceneError(
                    f"Rigid body {number}: mass and density must be positive, got {body.mass} and {body.density}."
                )
            points.append(body.mesh.nodes - solid.center_mass)
            index.append(np.full(len(body.mesh.nodes), float(number)))
            masses.append(mass)
            gyrations.append(solid.moment_inertia / volume)
            starts.append(np.concatenate([solid.center_mass, np.eye(3).ravel(), body.velocity, body.angular_velocity]))
        count = len(bodies)
        return Bodies(
            points=np.concatenate(points),
            body=np.concatenate(index).astype(np.int64),
            mass=np.array(masses, dtype=np.float64),
            gyration=np.array(gyrations, dtype=np.float64).reshape(count, 3, 3),
            start=np.array(starts, dtype=np.float64).reshape(count, 18),
        )

    def placed(self, centre: NDArray[np.float64], orientation: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mesh points [..., P, 3] in the world frame, for centres [..., B, 3] and orientations [..., B, 3, 3]."""
        turned = np.einsum("...pij,pj->...pi", orientation[..., self.body, :, :], self.points)
        return np.asarray(centre[..., self.body, :] + turned)

    def __len__(self) -> int:
        return len(self.mass)
