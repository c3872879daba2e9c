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
    """[kg/m³]; not used if `mass` is given."""
    mass: float | None = None
    """[kg]"""
    velocity: Vector = (0.0, 0.0, 0.0)
    """[m/s]"""
    angular_velocity: Vector = (0.0, 0.0, 0.0)
    """[rad/s]"""
