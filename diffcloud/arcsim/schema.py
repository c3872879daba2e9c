"""The ARCSim/DiffSim scene format. Unknown or unsupported fields raise an error; they are never ignored.

Defaults are those of ARCSim. The blocks `diffcloud` are extensions of this project.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from diffcloud.io.schema import Checked, Component, FileName, Friction, NonNegative, Positive, Vector
from diffcloud.sim.integrators import IntegratorName

_MANY = 200
"""Largest number of obstacles, handles or motions of a scene."""
Switch = Literal[
    "proximity", "physics", "strainlimiting", "collision", "remeshing", "separation", "popfilter", "plasticity"
]


class TransformBlock(Checked):
    translate: Vector = (0.0, 0.0, 0.0)
    scale: NonNegative = 1.0
    rotate: tuple[Component, Component, Component, Component] = (0.0, 1.0, 0.0, 0.0)
    """Angle [degrees], then the axis."""


class MaterialBlock(Checked):
    data: FileName
    density_mult: Positive = 1.0
    stretching_mult: Positive = 1.0
    bending_mult: Positive = 1.0
    thicken: Positive = 1.0
    damping: NonNegative = 0.0


class ClothBlock(Checked):
    mesh: FileName
    transform: TransformBlock = TransformBlock()
    materials: Annotated[list[MaterialBlock], Field(min_length=1, max_length=1)]
    remeshing: dict[str, Any] | None = None
    """Accepted, but has no effect, because remeshing must be disabled."""


class KeyframeBlock(Checked):
    time: Component
    transform: TransformBlock = TransformBlock()
    velocity: TransformBlock | None = None


class HandleBlock(Checked):
    type: Literal["node"] = "node"
    nodes: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1, max_length=100_000)]
    motion: Annotated[int, Field(ge=0)] | None = None
    start_time: Component = 0.0
    end_time: float = Field(default=math.inf, gt=-math.inf, allow_inf_nan=True)
    fade_time: NonNegative = 0.0


class BodyBlock(Checked):
    """Properties of a movable obstacle that ARCSim does not have."""

    density: Positive | None = None
    """[kg/m³]. Default: 1000, as water. ARCSim uses 0.01 kg per node of the mesh, so a finer mesh is heavier."""
    mass: Positive | None = None
    """Mass instead of a density [kg]."""
    velocity: Vector = (0.0, 0.0, 0.0)
    """Velocity of the centre of mass at the start [m/s]."""
    angular_velocity: Vector = (0.0, 0.0, 0.0)
    """Angular velocity at the start, in the world frame [rad/s]."""


class ObstacleBlock(Checked):
    mesh: FileName
    transform: TransformBlock = TransformBlock()
    movable: Literal[0, 1, False, True] | None = None
    """Whether contact can move the obstacle. Default: 1, as in ARCSim, unless it has a motion."""
    motion: Annotated[int, Field(ge=0)] | None = None
    """Index of the motion, which acts on the transformed mesh."""
    start_time: Component = 0.0
    """Before this time and after `end_time` [s] the obstacle does not move. In ARCSim it is absent then."""
    end_time: float = Field(default=math.inf, gt=-math.inf, allow_inf_nan=True)
    diffcloud: BodyBlock = BodyBlock()

    @property
    def is_body(self) -> bool:
        return self.motion is None if self.movable is None else bool(self.movable)


class WindBlock(Checked):
    density: NonNegative = 1.0
    velocity: Vector = (0.0, 0.0, 0.0)
    drag: NonNegative = 0.0


class MagicBlock(Checked):
    handle_stiffness: Positive = 1e3
    collision_stiffness: NonNegative = 1e9
    repulsion_thickness: Positive = 1e-3
    projection_thickness: Positive | None = None
    """Default: a tenth of the repulsion thickness."""
    edge_flip_threshold: Positive = 1e-2
    """For remeshing only, so it has no effect."""
    rib_stiffening: Positive = 1.0
    """For side effects of remeshing. Only 1 is supported."""


class ExtensionBlock(Checked):
    """Settings that ARCSim does not have."""

    hard_handles: bool = False
    integrator: IntegratorName | None = None
    """"implicit": steps iterated to convergence, with smooth contact. Default: "arcsim", unless an obstacle moves."""
    shaped: bool = False
    """Use the angles of the given mesh as rest angles of the hinges. Otherwise the cloth is flat at rest."""
    contact: Literal["meshes", "published", "planes"] = "meshes"
    """Contact of the arcsim integrator. "meshes": with all meshes and of the cloth with itself. "published": the same with
    ARCSim's peculiarities, which the published experiments need. "planes": with planes only."""
    damping: NonNegative | None = None
    compression: Annotated[float, Field(ge=0, le=1)] = 1.0
    """Fraction of the stretching stiffness that resists compression."""
    added_mass: NonNegative = 0.0
    """Mass per area of the air that moves with the cloth [kg/m²]."""
    linear_drag: NonNegative = 0.0
    """Linear drag in all directions, in addition to `wind.drag` [kg/(m²·s)]."""
    grip: Literal["pad", "pivot"] | None = None
    """What a handle holds. "pad": its nodes, or if it names one node, a square around it. "pivot": a node that can rotate.
    Default: the nodes."""
    grip_m: Positive | None = None
    """Side of the pad, or of the square that a pivot represents [m]. Default: 0.02."""

    @model_validator(mode="after")
    def _has_a_grip_of_that_size(self) -> Self:
        if self.grip is None and self.grip_m is not None:
            raise ValueError("`grip_m` is the size of a `grip`, and there is none: add `grip`, or leave `grip_m` out")
        return self


class SceneFile(Checked):
    frame_time: Positive
    frame_steps: Annotated[int, Field(ge=1, le=10_000)] = 1
    end_time: float = Field(default=math.inf, gt=0, allow_inf_nan=True)
    end_frame: Annotated[int, Field(ge=1)] | None = None
    cloths: Annotated[list[ClothBlock], Field(min_length=1, max_length=1)]
    motions: list[Annotated[list[KeyframeBlock], Field(min_length=1, max_length=100_000)]] = Field([], max_length=_MANY)
    handles: list[HandleBlock] = Field([], max_length=_MANY)
    obstacles: list[ObstacleBlock] = Field([], max_length=_MANY)
    gravity: Vector = (0.0, 0.0, 0.0)
    wind: WindBlock = WindBlock()
    friction: Friction = 0.6
    obs_friction: Friction = 0.3
    disable: list[Switch] = Field([], max_length=_MANY)
    magic: MagicBlock = MagicBlock()
    diffcloud: ExtensionBlock = ExtensionBlock()
