"""Scenarios: a scene and how an experiment looks at it (which frame, which faces, which bounds).

The built-ins are procedural and in SI. The `release_*` scenarios carry the settings of the experiments published with
the paper and take their scene from the published JSON (PHYSICS: experiments). A person's own cloth is a YAML file that
starts from a built-in and changes what differs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from pydantic import Field, ValidationError
from torch import Tensor

from diffcloud.errors import ConfigError, SceneError, unknown_name
from diffcloud.mesh.shapes import grid_cloth
from diffcloud.mesh.topology import ClothMesh, SurfaceMesh
from diffcloud.scene.description import Scene
from diffcloud.scene.load import load_scene
from diffcloud.scene.schema import Checked, NonNegative, Positive, Vector, explain
from diffcloud.sim.build import Surrounding
from diffcloud.sim.contact import ContactSettings, ReferenceContact
from diffcloud.sim.energies import Handles
from diffcloud.sim.energies.handles import Handle
from diffcloud.sim.materials import Material, preset, read_material
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.sim.properties import Properties, scaled_properties
from diffcloud.sim.state import System

PAPER_THRESHOLD = 5e-4
"""Stop below this one-sided Chamfer loss, in squared length units of the release (paper, section IV-F)."""
RELEASE_UNIT_M = 0.35
"""One length unit of the published recordings [m]."""


@dataclass(frozen=True)
class Scenario:
    """A scene and the settings of an experiment on it."""

    name: str
    scene: Scene
    frames: int
    """Simulated frames after the start."""
    loss_frames: tuple[int, ...]
    """Frames of an episode that enter the loss; negative ones count from the end."""
    loss_faces: NDArray[np.int64] | None = None
    """Faces whose surface is sampled; None for all."""
    node_sets: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    """Parameter name -> nodes it acts on."""
    points: int = 3500
    """Sampled per frame."""
    learning_rate: float = 0.2
    iterations: int = 50
    threshold: float = 0.0
    """Stop when the loss [squared length unit] is below; 0: never."""
    length_unit_m: float = 1.0
    first_frame_time: float = 0.0
    """Time of a recorded episode's first frame since the start [s]."""
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Overrides of the parameters' own bounds."""

    @property
    def steps(self) -> int:
        return self.frames * self.scene.frame_steps

    @property
    def grasped(self) -> list[int]:
        """Nodes that a moving handle holds."""
        return [handle.node for handle in self.scene.handles.handles if handle.motion is not None]

    def properties(self, system: System, values: Mapping[str, Tensor]) -> Properties:
        """Physical quantities of parameter sets, name -> [B], with the scenario's node sets applied.

        Raises:
            ConfigError: an unknown parameter.
        """
        sets = {}
        for name in values.keys() & self.node_sets.keys():
            sets[name] = torch.zeros(len(system.mesh.nodes), dtype=torch.bool, device=system.device)
            sets[name][torch.as_tensor(self.node_sets[name], device=system.device)] = True
        return scaled_properties(system.properties, values, faces=system.stretching.elements.nodes, node_sets=sets)


class GridScenario(Checked):
    """A rectangular cloth over a table: everything a person may change in a YAML file (SI units)."""

    name: str
    size_m: tuple[Positive, Positive]
    """Extent along the cloth's own x and y."""
    nodes: tuple[Annotated[int, Field(ge=2)], Annotated[int, Field(ge=2)]] = (7, 7)
    """Node counts along x and y."""
    center_m: tuple[float, float] = (0.0, 0.0)
    """Where the cloth's centre lies on the table."""
    yaw_deg: float = 45.0
    """Rotation about the vertical; 45 lays a square cloth as a diamond."""
    table_height_m: float = 0.0
    gap_m: NonNegative = 0.002
    """Height of the cloth over the table at the start."""
    material: str = "basis-knit"
    """A preset, or the path of an ARCSim material JSON."""
    grasped: tuple[str | int, ...]
    """Nodes that the gripper moves: corner names (left/right_bottom/top of the unrotated cloth) or indices."""
    held: tuple[str | int, ...] = ()
    """Nodes that stay where they are."""
    path: Annotated[list[tuple[float, float, float, float]], Field(min_length=2)]
    """Keyframes (time s, dx, dy, dz m) of the gripper's displacement, in the world's axes."""
    frames: Annotated[int, Field(ge=1)] = 25
    rate_hz: Positive = 10.0
    steps_per_frame: Annotated[int, Field(ge=1)] = 4
    newton_iterations: Annotated[int, Field(ge=1)] = 1
    soft_handles: bool = False
    loss_frames: tuple[int, ...] = (-1,)
    loss_surface: Literal["all", "grasped_half"] = "all"
    points: Annotated[int, Field(ge=1)] = 3500
    learning_rate: Positive = 0.2
    gravity: Vector = (0.0, 0.0, -9.81)
    air_density: NonNegative = 1.2
    friction_obstacle: NonNegative = 0.3
    friction_cloth: NonNegative = 0.6
    contact_stiffness: NonNegative = 1e5
    contact_thickness_m: Positive = 0.002


_SIDE = 0.2625
"""Side of the cloth of the paper's experiments [m] (0.75 release units)."""
_LIFT = GridScenario(
    name="lift",
    size_m=(_SIDE, _SIDE),
    grasped=("right_top",),
    path=[(0.0, 0.0, 0.0, 0.0), (2.5, 0.0, -0.14, 0.40)],
)
_FOLD = GridScenario(
    name="fold",
    size_m=(_SIDE, _SIDE),
    grasped=("left_bottom",),
    held=("right_top",),
    path=[(0.0, 0.0, 0.0, 0.0), (1.25, 0.0, 0.12, 0.26), (2.5, 0.0, 0.28, 0.08)],
    loss_frames=(15,),
    loss_surface="grasped_half",
)
_BUILT_IN = {"lift": _LIFT, "fold": _FOLD}


@dataclass(frozen=True)
class _Release:
    """Settings of one published experiment (PHYSICS section 13)."""

    frames: int
    loss_frame: int
    points: int
    learning_rate: float
    threshold: float
    first_frame: int
    """State that the first recorded file is compared with: after this many steps."""
    mass_nodes: tuple[int, ...] | None = None
    loss_faces: tuple[int, ...] | None = None


def _numbers(text: str) -> tuple[int, ...]:
    ranges = (part.split("-") for part in text.split(","))
    return tuple(i for part in ranges for i in range(int(part[0]), int(part[-1]) + 1))


_RELEASE = {
    "release_lift": _Release(25, 24, 3500, 0.2, 0.0, 1, _numbers("5,9-11,17,21-23,27,28,33,35-37,39,43,45-48")),
    "release_fold": _Release(
        25,
        14,
        3500,
        0.2,
        0.0,
        1,
        _numbers("9-11,21,22,36,37,43,45-48"),
        _numbers("1,2,8-13,16,19,22-30,34,35,37,38,44-49,52,55,58-66,70,71"),
    ),
    "release_hang": _Release(15, 10, 3500, 0.3, PAPER_THRESHOLD, 0, _numbers("38-40,42,43,47,49,51,54-65,67,68")),
    "release_band": _Release(25, 24, 5500, 0.4, PAPER_THRESHOLD, 0),
}

SCENARIO_NAMES = (*_BUILT_IN, *_RELEASE)


def load_scenario(name: str | Path | None, scene: Path | None = None) -> Scenario:
    """A scenario by name or YAML file, or from a scene file, or both.

    Args:
        name: a built-in, a `release_*` experiment (then `scene` is needed), the path of a YAML file, or None for a
            scene file as it is written.
        scene: an ARCSim scene JSON.

    Raises:
        ConfigError, SceneError, MeshError: what is wrong and what is allowed.
    """
    if name is None:
        if scene is None:
            raise ConfigError(
                f"Give --scenario (one of {', '.join(SCENARIO_NAMES)}, or a YAML file), or --scene FILE.json."
            )
        loaded = load_scene(scene)
        frames = loaded.default_frames or 25
        return Scenario(Path(scene).stem, loaded, frames, loss_frames=(-1,))
    text = str(name)
    if text in _RELEASE:
        if scene is None:
            raise ConfigError(f"Scenario {text} needs --scene with the published scene file (README: published data).")
        return _release(text, _RELEASE[text], scene)
    if scene is not None:
        raise ConfigError(f"Scenario {text} makes its own scene; --scene goes with release_* scenarios or alone.")
    if text in _BUILT_IN:
        return grid_scenario(_BUILT_IN[text])
    if Path(text).suffix in (".yaml", ".yml"):
        return grid_scenario(read_grid_scenario(Path(text)))
    raise ConfigError(unknown_name("scenario", text, SCENARIO_NAMES) + " Or give the path of a YAML file.")


def built_in(name: str) -> GridScenario:
    """The options of a built-in scenario, to vary.

    Raises:
        ConfigError: no such built-in.
    """
    if name not in _BUILT_IN:
        raise ConfigError(unknown_name("built-in scenario", name, _BUILT_IN))
    return _BUILT_IN[name]


def read_grid_scenario(path: Path) -> GridScenario:
    """Read a person's own cloth: `base: lift` or `fold`, then the fields of `GridScenario` that differ.

    Raises:
        SceneError: an unreadable file, an unknown field, or a value out of range.
    """
    try:
        data = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise SceneError(f"No such scenario file: {path}.") from error
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise SceneError(f"{path} is not readable YAML: {error}.") from error
    if not isinstance(data, dict):
        raise SceneError(f"{path}: a scenario is a mapping of fields, got {type(data).__name__}.")
    base = data.pop("base", "lift")
    if base not in _BUILT_IN:
        raise SceneError(f"{path}: " + unknown_name("base", base, _BUILT_IN))
    material = data.get("material")
    if isinstance(material, str) and material.endswith(".json"):
        data["material"] = str((Path(path).parent / material).resolve())
    try:
        return GridScenario.model_validate({**_BUILT_IN[base].model_dump(), "name": Path(path).stem, **data})
    except ValidationError as error:
        raise explain(path, error, SceneError) from error


def grid_scenario(options: GridScenario) -> Scenario:
    """The scenario of a rectangular cloth over a table."""
    columns, rows = options.nodes
    flat = grid_cloth(rows, columns, options.size_m[1], options.size_m[0])
    yaw = np.deg2rad(options.yaw_deg)
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])  # for row vectors
    start = np.array([*options.center_m, options.table_height_m + options.gap_m])
    mesh = replace(flat, nodes=flat.nodes @ turn + start)
    grasped, held = (_named_nodes(options, names) for names in (options.grasped, options.held))
    if set(grasped) & set(held):
        raise SceneError(f"Scenario {options.name}: nodes {sorted(set(grasped) & set(held))} are both grasped and held.")
    motion = Motion(tuple(Keyframe(time, (x, y, z)) for time, x, y, z in options.path))
    handles = (*(Handle(node, motion) for node in grasped), *(Handle(node) for node in held))
    extent = 2.0 * max(options.size_m) + float(np.abs([key[1:] for key in options.path]).max())
    material = options.material
    found: Material = read_material(Path(material)) if material.endswith(".json") else preset(material)
    thickness = options.contact_thickness_m
    scene = Scene(
        mesh=mesh,
        material=found,
        handles=Handles(handles, hard=not options.soft_handles),
        frame_time=1 / options.rate_hz,
        frame_steps=options.steps_per_frame,
        surrounding=Surrounding(
            gravity=options.gravity,
            air_density=options.air_density,
            friction_obstacle=options.friction_obstacle,
            friction_cloth=options.friction_cloth,
            contact=ContactSettings(options.contact_stiffness, thickness, 0.1 * thickness),
            obstacles=(_table(options, extent),),
        ),
        newton_iterations=options.newton_iterations,
    )
    frames = {frame if frame >= 0 else options.frames + 1 + frame for frame in options.loss_frames}
    if not frames or min(frames) < 0 or max(frames) > options.frames:
        raise SceneError(f"Scenario {options.name}: loss_frames {list(options.loss_frames)} leave 0..{options.frames}.")
    return Scenario(
        name=options.name,
        scene=scene,
        frames=options.frames,
        loss_frames=tuple(options.loss_frames),
        loss_faces=_half(mesh, grasped) if options.loss_surface == "grasped_half" else None,
        points=options.points,
        learning_rate=options.learning_rate,
    )


def _named_nodes(options: GridScenario, names: Sequence[str | int]) -> list[int]:
    columns, rows = options.nodes
    corners = {
        "left_bottom": 0,
        "right_bottom": columns - 1,
        "left_top": (rows - 1) * columns,
        "right_top": rows * columns - 1,
    }
    nodes = []
    for name in names:
        if isinstance(name, str) and name not in corners:
            raise SceneError(f"Scenario {options.name}: " + unknown_name("corner", name, corners))
        node = corners[name] if isinstance(name, str) else name
        if not 0 <= node < rows * columns:
            raise SceneError(f"Scenario {options.name}: node {node} does not exist, the cloth has 0..{rows * columns - 1}.")
        nodes.append(node)
    return nodes


def _half(mesh: ClothMesh, grasped: list[int]) -> NDArray[np.int64]:
    """Faces on the grasped side of the cloth's middle: the part that comes to lie on top."""
    side = mesh.nodes[grasped].mean(axis=0) - mesh.nodes.mean(axis=0)
    centre = mesh.nodes[mesh.faces].mean(axis=1) - mesh.nodes.mean(axis=0)
    return np.flatnonzero(centre @ side > 0)


def _table(options: GridScenario, extent: float) -> SurfaceMesh:
    x, y = options.center_m
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * extent + [x, y]
    nodes = np.column_stack([corners, np.full(4, options.table_height_m)])
    return SurfaceMesh(nodes, np.array([[0, 1, 2], [0, 2, 3]]))


def _release(name: str, settings: _Release, path: Path) -> Scenario:
    scene = load_scene(path, reload_materials=True)
    scene = replace(scene, surrounding=replace(scene.surrounding, reference_contact=ReferenceContact.as_published()))
    faces, nodes = settings.loss_faces, settings.mass_nodes
    for what, index, count in (("face", faces, len(scene.mesh.faces)), ("node", nodes, len(scene.mesh.nodes))):
        if index and max(index) >= count:
            raise SceneError(f"{path}: {name} needs {what} {max(index)}, but the cloth has {count}; wrong scene file?")
    return Scenario(
        name=name,
        scene=scene,
        frames=settings.frames,
        loss_frames=(settings.loss_frame,),
        loss_faces=None if faces is None else np.array(faces),
        node_sets={} if nodes is None else {"mass": np.array(nodes)},
        points=settings.points,
        learning_rate=settings.learning_rate,
        threshold=settings.threshold,
        length_unit_m=RELEASE_UNIT_M,
        first_frame_time=settings.first_frame * scene.frame_time,
        # the published scripts use 0.05 in places; everything here is compared on one box
        bounds={"stretch": (0.1, 10.0), "mass": (0.1, 10.0)},
    )
