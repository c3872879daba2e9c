"""Options of all built-in scenarios, and their conversion to a `Scenario`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from diffcloud.errors import SceneError, unknown_name
from diffcloud.io.schema import Checked, Friction, NonNegative, Vector
from diffcloud.mesh.topology import ClothMesh, SurfaceMesh
from diffcloud.scene.description import Scene
from diffcloud.scene.scenarios.scenario import Recorder, Scenario
from diffcloud.scene.scenarios.sheet import Sheet
from diffcloud.sim.grasp import Grasp
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.integrators import IntegratorName, load_integrator
from diffcloud.sim.materials import Material, preset, read_material
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.sim.properties import PARAMETERS
from diffcloud.sim.still_air import AIR_DENSITY, StillAir, still_air
from diffcloud.sim.surrounding import ContactSettings, Surrounding

Coordinate = Annotated[float, Field(ge=-1000, le=1000)]
"""[m] Larger values are rejected as mistakes."""
Length = Annotated[float, Field(gt=0, le=100)]
"""[m] Size of a cloth or an obstacle."""
MOST_UNCERTAINTY = 100.0
"""Maximum factor; a larger one says nothing about a material."""
_Time = Annotated[float, Field(ge=-1e6, le=1e6)]
Keyframes = Annotated[list[tuple[_Time, Coordinate, Coordinate, Coordinate]], Field(min_length=2)]
"""Keyframes (time s, dx, dy, dz m) of a displacement, in the world's axes."""


class ScenarioOptions(Checked):
    """Fields that all built-in scenarios share (SI units)."""

    name: Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^./\\\s][^/\\]*$")]
    """Name of folders and files. Every name of a recording is allowed, because `fit` uses it for the scenario."""
    material: str | Sheet = "soft-knit"
    """A preset, the path of an ARCSim material JSON, or an isotropic sheet in SI units."""
    compression: Annotated[float, Field(ge=0, le=1)] = 1.0
    """Fraction of the stretching stiffness that resists in-plane compression. Real fabric forms wrinkles instead, which
    are finer than most meshes (docs/physics.md, wrinkles)."""
    uncertain: dict[str, Annotated[float, Field(gt=1, le=MOST_UNCERTAINTY)]] = Field(default_factory=dict)
    """Material parameters with another uncertainty than the default: parameter -> standard deviation as a factor
    (`estimation.uncertain`)."""
    path: Keyframes
    """Displacement of the gripper."""
    frames: Annotated[int, Field(ge=1, le=100_000)] = 25
    rate_hz: Annotated[float, Field(gt=0, le=1e5)] = 10.0
    steps_per_frame: Annotated[int, Field(ge=1, le=10_000)] = 8
    integrator: IntegratorName = Scene.integrator
    """"implicit" has second-order steps and smooth contact. "arcsim" has ARCSim's steps, which take a quarter to a
    tenth of the time and are less accurate (docs/results/discretisation.md)."""
    shaped: bool = Scene.shaped
    """Whether the initial shape of the cloth has no bending energy, instead of the flat shape."""
    soft_handles: bool = False
    loss_frames: tuple[int, ...] = (-1,)
    """Frames for the loss of the paper and for studies of the motion."""
    every_frame: bool = True
    """Whether fits compare all usable frames. A file with loss_frames uses only those, unless it sets this to true."""
    points: Annotated[int, Field(ge=1, le=1_000_000)] = 3500
    learning_rate: Annotated[float, Field(gt=0, le=1e3)] = 0.2
    threshold_m2: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Loss below which a fit stops; 0: never."""
    recorder: Recorder = "depth_cameras"
    gravity: Vector = Surrounding.gravity
    air: Literal["none", "drag", "still"] = "drag"
    """"none": vacuum, as in most simulators. "drag": pressure on faces that move through the air. "still": also linear
    drag and the air that moves with the cloth, which makes it swing more slowly (`sim.still_air`)."""
    air_density: NonNegative = AIR_DENSITY
    """Density of the air, if any [kg/m³]."""
    friction: Friction = Surrounding.friction
    self_friction: Friction = Surrounding.self_friction
    mesh_contact: bool = True
    """For the arcsim integrator: contact with all meshes and the cloth itself, or with planes only."""
    self_contact: bool = Surrounding.self_contact
    """Whether the cloth collides with itself. Without, layers pass through each other, and steps are faster."""
    contact_stiffness: NonNegative = ContactSettings.stiffness
    contact_thickness_m: Annotated[float, Field(gt=0, le=1)] = ContactSettings.repulsion_thickness

    @field_validator("uncertain")
    @classmethod
    def _of_parameters(cls, uncertain: dict[str, float]) -> dict[str, float]:
        for name in uncertain:
            if name not in PARAMETERS:
                raise ValueError(unknown_name("parameter", name, PARAMETERS))
        return uncertain

    @property
    def reach(self) -> float:
        """Largest displacement of a gripper along an axis [m]."""
        return max(abs(way) for path in (self.path, *self.own_paths.values()) for key in path for way in key[1:])

    @property
    def own_paths(self) -> Mapping[str, Keyframes]:
        """Path of each gripper that does not follow `path`."""
        return {}


@dataclass(frozen=True)
class Regrip:
    """Function that returns a scenario with another grasp size."""

    build: Callable[[Any], Scenario]
    options: Any
    """Options with `grip_m` and `grip_known_within`, which `build` takes."""

    def __call__(self, deviations: float) -> Scenario:
        """Return the scenario with a grasp this many standard deviations larger.

        Raises:
            SceneError: the pad is as large as the cloth.
        """
        size = self.options.grip_m * self.options.grip_known_within**deviations
        return self.build(self.options.model_copy(update={"grip_m": size}))


def resting_height(options: ScenarioOptions) -> float:
    """Return the height above a level table at which the contact model holds a cloth, about 2 mm; 0 without weight [m]."""
    contact = ContactSettings(options.contact_stiffness, options.contact_thickness_m)
    weight = -options.gravity[2] * chosen_material(options).density
    return load_integrator(options.integrator).resting_height(contact, weight) if weight > 0 else 0.0


def sunk(options: ScenarioOptions, gap_m: float) -> float:
    """Return how far the contact table is below the real one [m], so that a cloth at height `gap_m` is initially at rest.
    The mid-surface of a real cloth is at half its thickness, below the height at which the contact model holds it."""
    return max(resting_height(options) - gap_m, 0.0)


def chosen_material(options: ScenarioOptions) -> Material:
    """Return the material that `options.material` names or describes."""
    match options.material:
        case Sheet() as sheet:
            return sheet.material(options.name)
        case str() as name if name.endswith(".json"):
            return read_material(Path(name))
        case name:
            return preset(name)


def assemble(
    options: ScenarioOptions,
    mesh: ClothMesh,
    obstacles: tuple[SurfaceMesh, ...],
    *,
    grippers: Mapping[str, Sequence[int]],
    held: Sequence[int] = (),
    grasp: Grasp | None = None,
    pads: Mapping[int, int] | None = None,
    turned: Mapping[int, tuple[float, float, float]] | None = None,
    loss_faces: NDArray[np.int64] | None = None,
) -> Scenario:
    """Build the scenario of a cloth and its obstacles.

    Args:
        grippers: name -> nodes that follow its path.
        held: nodes that stay fixed.
        grasp: type and size of the grasp that the nodes represent; None: single nodes.
        pads: node -> number of the pad that holds it; None: no pads.
        turned: node -> its displacement by an upright pad [m].
        loss_faces: faces whose surface the loss samples; None for all.

    Raises:
        SceneError: a node is held twice, or a loss frame is after the end.
    """
    nodes = [*held, *(node for grasped in grippers.values() for node in grasped)]
    twice = sorted({node for node in nodes if nodes.count(node) > 1})
    if twice:
        raise SceneError(f"Scenario {options.name}: nodes {twice} are held twice, by two grippers or by `held` too.")
    frames = {frame if frame >= 0 else options.frames + 1 + frame for frame in options.loss_frames}
    if not frames or min(frames) < 0 or max(frames) > options.frames:
        raise SceneError(f"Scenario {options.name}: loss_frames {list(options.loss_frames)} leave 0..{options.frames}.")
    handles = []
    for name, grasped in grippers.items():
        path = options.own_paths.get(name, options.path)
        motion = Motion(tuple(Keyframe(time, (x, y, z)) for time, x, y, z in path))
        handles += [Handle(node, motion, gripper=name) for node in grasped]
    handles += [Handle(node) for node in held]
    handles = [
        replace(one, pad=(pads or {}).get(one.node, 0), turned=(turned or {}).get(one.node, one.turned)) for one in handles
    ]
    thickness = options.contact_thickness_m
    moving = still_air(mesh, options.air_density) if options.air == "still" else StillAir(0.0, 0.0)
    surrounding = Surrounding(
        gravity=options.gravity,
        air_density=0.0 if options.air == "none" else options.air_density,
        added_mass=moving.added_mass,
        linear_drag=moving.linear_drag,
        friction=options.friction,
        self_friction=options.self_friction,
        self_contact=options.self_contact,
        contact=ContactSettings(options.contact_stiffness, thickness, 0.1 * thickness),
        obstacles=obstacles,
    )
    if options.mesh_contact:
        surrounding = load_integrator(options.integrator).with_contact(surrounding)
    scene = Scene(
        mesh=mesh,
        material=replace(chosen_material(options), compression=options.compression),
        handles=Handles(tuple(handles), hard=not options.soft_handles, grasp=grasp),
        frame_time=1 / options.rate_hz,
        frame_steps=options.steps_per_frame,
        surrounding=surrounding,
        integrator=options.integrator,
        shaped=options.shaped,
    )
    return Scenario(
        name=options.name,
        scene=scene,
        frames=options.frames,
        loss_frames=tuple(options.loss_frames),
        every_frame=options.every_frame,
        loss_faces=loss_faces,
        points=options.points,
        learning_rate=options.learning_rate,
        threshold=options.threshold_m2,
        recorder=options.recorder,
        uncertain=options.uncertain,
    )
