"""What surrounds a cloth: gravity, air, obstacles, and how things touch."""

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
    """Numbers of the contact models."""

    stiffness: float = 1e4
    """k_c [N/m³]: times a node's area gives the contact stiffness (ARCSim's default is 1e9)."""
    repulsion_thickness: float = 3e-3
    """τ, and d̂ of smooth contact [m] (ARCSim's default is 1e-3)."""
    projection_thickness: float = 3e-4
    """Of the arcsim integrator [m]."""
    sticking_speed: float = 1e-3
    """v_s of smooth contact: what sticks creeps slower than this [m/s]."""


@dataclass(frozen=True)
class ReferenceContact:
    """Choices in which the reference simulator differs from what one would write today.

    The defaults are the correct variant; `as_published` has the reference's quirks.
    """

    smallest: float = 0.0
    """[m⁴] Pairs whose |a × b|² (cross product of two edges) is below never touch."""
    count_once: bool = True
    """Whether a pair that is nearest for both its primitives repels once, not twice."""
    residue: float = 0.0
    """Part of each impact correction that is left out; decides ties in the next step."""

    @staticmethod
    def as_published() -> ReferenceContact:
        """What the published trajectories were made with; derivatives stay exact, which the original's are not."""
        return ReferenceContact(_ARCSIM_SMALLEST, count_once=False, residue=1e-9)


@dataclass(frozen=True)
class Surrounding:
    """Everything around the cloth."""

    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """[m/s²]"""
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Velocity of the air [m/s]."""
    air_density: float = 1.0
    """[kg/m³]; ARCSim's default, real air has 1.2."""
    air_drag: float = 0.0
    """Tangential drag [kg/(m²·s)]."""
    added_mass: float = 0.0
    """Of air that moves with the cloth, in all directions alike [kg/m²]: it has inertia, and no weight."""
    linear_drag: float = 0.0
    """In all directions [kg/(m²·s)]."""
    lagged_air: bool = False
    """Whether drag is that before the step, as in ARCSim, where light cloth in dense air explodes."""
    self_friction: float = 0.6
    friction: float = 0.3
    contact: ContactSettings = field(default_factory=ContactSettings)
    proximity: bool = True
    """Of the arcsim integrator: whether planes, and other meshes, repel and rub (off: only projection and impacts)."""
    self_contact: bool = True
    """Whether the cloth meets itself (implicit integrator); without, layers pass through each other in quicker steps."""
    obstacles: tuple[SurfaceMesh, ...] = ()
    """Static ones."""
    moving: tuple[MovingObstacle, ...] = ()
    bodies: tuple[RigidBody, ...] = ()
    forces: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Settings of further forces: name of the term -> what its `build` reads."""
    reference_contact: ReferenceContact | None = None
    """Contact with all meshes and of the cloth with itself by proximity and impact zones; None: with planes only."""
