"""The ARCSim/DiffSim scene format. Fields are refused by name when unknown or unsupported, never ignored.

Defaults are ARCSim's. The blocks `diffcloud` are this project's own additions, for what ARCSim cannot say.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from diffcloud.errors import DiffCloudError
from diffcloud.sim.surrounding import Integrator

Vector = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Switch = Literal[
    "proximity", "physics", "strainlimiting", "collision", "remeshing", "separation", "popfilter", "plasticity"
]


class Checked(BaseModel):
    """A block of a file: frozen, every field known."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class TransformBlock(Checked):
    translate: Vector = (0.0, 0.0, 0.0)
    scale: NonNegative = 1.0
    rotate: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 0.0)
    """Degrees, then the axis."""


class MaterialBlock(Checked):
    data: str
    density_mult: Positive = 1.0
    stretching_mult: Positive = 1.0
    bending_mult: Positive = 1.0
    thicken: Positive = 1.0
    damping: NonNegative = 0.0


class ClothBlock(Checked):
    mesh: str
    transform: TransformBlock = TransformBlock()
    materials: Annotated[list[MaterialBlock], Field(min_length=1, max_length=1)]
    remeshing: dict[str, Any] | None = None
    """Accepted, and without effect, while remeshing is disabled."""


class KeyframeBlock(Checked):
    time: float
    transform: TransformBlock = TransformBlock()
    velocity: TransformBlock | None = None


class HandleBlock(Checked):
    type: Literal["node"] = "node"
    nodes: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)]
    motion: Annotated[int, Field(ge=0)] | None = None
    start_time: float = 0.0
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
    mesh: str
    transform: TransformBlock = TransformBlock()
    movable: Literal[0, 1, False, True] | None = None
    """Whether what it touches moves it. Default: 1, as in ARCSim, unless it has a motion."""
    motion: Annotated[int, Field(ge=0)] | None = None
    """It acts on the transformed mesh."""
    start_time: float = 0.0
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
    integrator: Integrator | None = None
    """"implicit": converged steps with smooth contact. Default: "linearised", ARCSim's, unless an obstacle moves."""
    shaped: bool = False
    """Whether hinges are at rest as the mesh stands, not flat."""
    contact: Literal["meshes", "published", "planes"] = "meshes"
    """Of the linearised integrator: with all meshes and the cloth itself; the same with ARCSim's quirks, which the
    published experiments need; or with planes only."""
    damping: NonNegative | None = None


class SceneFile(Checked):
    frame_time: Positive
    frame_steps: Annotated[int, Field(ge=1)] = 1
    end_time: float = Field(default=math.inf, gt=0, allow_inf_nan=True)
    end_frame: Annotated[int, Field(ge=1)] | None = None
    cloths: Annotated[list[ClothBlock], Field(min_length=1, max_length=1)]
    motions: list[Annotated[list[KeyframeBlock], Field(min_length=1)]] = []
    handles: list[HandleBlock] = []
    obstacles: list[ObstacleBlock] = []
    gravity: Vector = (0.0, 0.0, 0.0)
    wind: WindBlock = WindBlock()
    friction: NonNegative = 0.6
    obs_friction: NonNegative = 0.3
    disable: list[Switch] = []
    magic: MagicBlock = MagicBlock()
    diffcloud: ExtensionBlock = ExtensionBlock()


def explain(source: object, error: ValidationError, kind: type[DiffCloudError]) -> DiffCloudError:
    """A validation error in one message: each field with its path, what came, and what is allowed."""
    faults = []
    for fault in error.errors():
        place = ".".join(str(part) for part in fault["loc"]) or "(the whole)"
        got = repr(fault["input"])
        shown = got if len(got) <= 60 else got[:57] + "..."
        if fault["type"] == "extra_forbidden":
            faults.append(f"{place}: unknown or unsupported field (value {shown})")
        else:
            faults.append(f"{place}: {fault['msg']} (got {shown})")
    return kind(f"{source}: " + "; ".join(faults) + ".")
