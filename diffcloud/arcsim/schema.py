"""The ARCSim/DiffSim scene format. Fields are refused by name when unknown or unsupported, never ignored.

Defaults are ARCSim's. The blocks `diffcloud` are this project's own additions, for what ARCSim cannot say.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from diffcloud.io.schema import Checked, Component, FileName, Friction, NonNegative, Positive, Vector
from diffcloud.sim.integrators import IntegratorName

_MANY = 200
"""Obstacles, handles or motions of a scene."""
Switch = Literal[
    "proximity", "physics", "strainlimiting", "collision", "remeshing", "separation", "popfilter", "plasticity"
]


class TransformBlock(Checked):
    translate: Vector = (0.0, 0.0, 0.0)
    scale: NonNegative = 1.0
    rotate: tuple[Component, Component, Component, Component] = (0.0, 1.0, 0.0, 0.0)
    """Degrees, then the axis."""


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
    """Accepted, and without effect, while remeshing is disabled."""


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
    """What ARCSim cannot say of a movable obstacle."""

    density: Positive | None = None
    """[kg/m³] Default: 1000, water's. ARCSim takes 0.01 kg for each node of the mesh, so that a finer mesh weighs more."""
    mass: Positive | None = None
    """[kg], instead of a density."""
    velocity: Vector = (0.0, 0.0, 0.0)
    """Of the centre of mass at the start [m/s]."""
    angular_velocity: Vector = (0.0, 0.0, 0.0)
    """At the start, in the world's axes [rad/s]."""


class ObstacleBlock(Checked):
    mesh: FileName
    transform: TransformBlock = TransformBlock()
    movable: Literal[0, 1, False, True] | None = None
    """Whether what it touches moves it. Default: 1, as in ARCSim, unless it has a motion."""
    motion: Annotated[int, Field(ge=0)] | None = None
    """It acts on the transformed mesh."""
    start_time: Component = 0.0
    """Before this and after `end_time` [s] the motion stands still, and so does the obstacle; in ARCSim it is absent."""
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
    """Of remeshing; without effect while that is disabled."""
    rib_stiffening: Positive = 1.0
    """Of remeshing's side effects; only 1 is supported."""


class ExtensionBlock(Checked):
    """What ARCSim cannot say."""

    hard_handles: bool = False
    integrator: IntegratorName | None = None
    """"implicit": converged steps with smooth contact. Default: "arcsim", ARCSim's, unless an obstacle moves."""
    shaped: bool = False
    """Whether hinges are at rest as the mesh stands, not flat."""
    contact: Literal["meshes", "published", "planes"] = "meshes"
    """Of the arcsim integrator: with all meshes and the cloth itself; the same with ARCSim's quirks, which the
    published experiments need; or with planes only."""
    damping: NonNegative | None = None
    compression: Annotated[float, Field(ge=0, le=1)] = 1.0
    """The part of its stretching stiffness with which the cloth resists compression in its plane."""
    added_mass: NonNegative = 0.0
    """Of air that moves with the cloth, per area of it [kg/m²]."""
    linear_drag: NonNegative = 0.0
    """Beside `wind.drag`, in all directions [kg/(m²·s)]."""
    grip: Literal["pad", "pivot"] | None = None
    """What a handle holds: a pad around a node, or of the nodes where it names several; or a pivot. Default: nodes."""
    grip_m: Positive | None = None
    """Side of the pad, or of the square that a pivot stands for. Default: 0.02."""

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
