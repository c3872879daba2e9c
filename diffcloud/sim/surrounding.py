"""The surroundings of a cloth: gravity, air, obstacles, and contact settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.sim.rigid.body import RigidBody
from diffcloud.sim.scenery import MovingObstacle

_ARCSIM_SMALLEST = 1e-6

Order = Literal[1, 2]


@dataclass(frozen=True)
class ContactSettings:
    """Parameters of the contact models."""

    stiffness: float = 1e4
    """k_c [N/m³]. Multiplied by a node's area, it gives the contact stiffness (ARCSim's default is 1e9)."""
    repulsion_thickness: float = 3e-3
    """Distance at which contact forces begin: τ of ARCSim, d̂ of smooth contact [m] (ARCSim's default is 1e-3)."""
    projection_thickness: float = 3e-4
    """Distance to which the arcsim integrator projects nodes out of obstacles [m]."""
    sticking_speed: float = 1e-3
    """v_s of smooth contact: cloth in static friction slides slower than this [m/s]."""


@dataclass(frozen=True)
class ReferenceContact:
    """Options in which ARCSim differs from a correct implementation. The defaults are the correct variant. `as_published`
    reproduces ARCSim."""

    smallest: float = 0.0
    """Pairs of edges with |a × b|² below this never touch [m⁴]."""
    count_once: bool = True
    """If a pair is the nearest one of both its primitives, apply its repulsion once instead of twice."""
    residue: float = 0.0
    """Fraction of each impact correction that is omitted. It decides ties in the next step."""

    @staticmethod
    def as_published() -> ReferenceContact:
        """Options of the published trajectories. Derivatives remain exact, unlike those of the original code."""
        return ReferenceContact(_ARCSIM_SMALLEST, count_once=False, residue=1e-9)


@dataclass(frozen=True)
class Surrounding:
    """Gravity, air, obstacles and contact around the cloth."""

    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """Gravitational acceleration [m/s²]."""
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Air velocity [m/s]."""
    air_density: float = 1.0
    """Density of the air [kg/m³]. The default is ARCSim's; real air has 1.2."""
    air_drag: float = 0.0
    """Coefficient of the linear tangential drag [kg/(m²·s)]."""
    added_mass: float = 0.0
    """Mass per area of the air that moves with the cloth [kg/m²]. It has inertia in all directions, but no weight."""
    linear_drag: float = 0.0
    """Coefficient of the linear drag in all directions [kg/(m²·s)]."""
    lagged_air: bool = False
    """Use the drag at the start of the step, as ARCSim does. Light cloth in dense air is then unstable."""
    self_friction: float = 0.6
    friction: float = 0.3
    contact: ContactSettings = field(default_factory=ContactSettings)
    proximity: bool = True
    """Contact forces and friction of the arcsim integrator at planes and other meshes. False: only projection and impacts.
    """
    self_contact: bool = True
    """Whether the implicit integrator detects contact of the cloth with itself. False: faster, but layers interpenetrate.
    """
    obstacles: tuple[SurfaceMesh, ...] = ()
    """Static obstacles."""
    moving: tuple[MovingObstacle, ...] = ()
    bodies: tuple[RigidBody, ...] = ()
    forces: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Settings of further forces: name of the force term -> settings that its `build` reads."""
    reference_contact: ReferenceContact | None = None
    """Contact by proximity and impact zones, with all meshes and of the cloth with itself. None: contact with planes only.
    """
