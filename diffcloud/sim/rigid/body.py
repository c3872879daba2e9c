"""Description of a rigid body that contact can move."""

from __future__ import annotations

from dataclasses import dataclass

from diffcloud.mesh.topology import SurfaceMesh

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class RigidBody:
    """A rigid body that contact can move."""

    mesh: SurfaceMesh
    """Closed mesh with outward faces, in the world frame at the start [m]."""
    density: float = 1000.0
    """Density [kg/m³]; not used if `mass` is given."""
    mass: float | None = None
    """Mass [kg]; default density times volume."""
    velocity: Vector = (0.0, 0.0, 0.0)
    """Initial velocity of the centre of mass [m/s]."""
    angular_velocity: Vector = (0.0, 0.0, 0.0)
    """Initial angular velocity in the world frame [rad/s]."""
