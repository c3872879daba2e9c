"""A movable obstacle, as it is described."""

from __future__ import annotations

from dataclasses import dataclass

from diffcloud.mesh.topology import SurfaceMesh

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class RigidBody:
    """A movable obstacle."""

    mesh: SurfaceMesh
    """Closed, oriented outwards, in world coordinates at the start [m]."""
    density: float = 1000.0
    """[kg/m³]; without effect if `mass` is given."""
    mass: float | None = None
    """[kg]"""
    velocity: Vector = (0.0, 0.0, 0.0)
    """[m/s]"""
    angular_velocity: Vector = (0.0, 0.0, 0.0)
    """[rad/s]"""
