"""Load an ARCSim/DiffSim scene JSON."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from pydantic import ValidationError

from diffcloud.errors import SceneError
from diffcloud.io.files import read_json
from diffcloud.io.obj import read_cloth, read_surface
from diffcloud.mesh.topology import ClothMesh, FloatArray, SurfaceMesh
from diffcloud.scene.description import Scene
from diffcloud.scene.schema import KeyframeBlock, SceneFile, TransformBlock, explain
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.materials import read_material
from diffcloud.sim.motion import Keyframe, Motion, axis_angle_quaternion
from diffcloud.sim.surrounding import ContactSettings, ReferenceContact, Surrounding

_SUPPORTED_SWITCHES = {"remeshing", "proximity", "strainlimiting", "separation", "popfilter", "plasticity"}
"""Of `disable`: those whose stage this simulator has (proximity), or never runs anyway."""


def load_scene(path: Path, *, reload_materials: bool = False) -> Scene:
    """Read a scene file; mesh and material paths are relative to the nearest folder above it that holds them.

    Args:
        reload_materials: reproduce what the published DiffCloud experiments do: they read the material tables a second
            time after the masses were computed, which drops `thicken` and the multipliers from stretching and bending
            but keeps them in the masses.

    Raises:
        SceneError: an unreadable file, an unknown or unsupported field (by name), a path that leaves the scene's
            folder, or a reference to a motion or node that does not exist.
        MeshError: a mesh that cannot be simulated.
    """
    path = Path(path)
    data = read_json(path, error=SceneError)
    try:
        scene = SceneFile.model_validate(data)
    except ValidationError as error:
        raise explain(path, error, SceneError) from error
    _refuse_unsupported(path, scene)

    root = _root(path, scene.cloths[0].mesh)
    cloth = scene.cloths[0]
    mesh = _transform_cloth(read_cloth(_inside(root, cloth.mesh, path)), cloth.transform)
    block = cloth.materials[0]
    raw = read_material(_inside(root, block.data, path))
    damping = block.damping if scene.diffcloud.damping is None else scene.diffcloud.damping
    raw = replace(raw, damping=damping)
    scaled = raw.scaled(
        density=block.thicken * block.density_mult,
        stretching=block.thicken * block.stretching_mult,
        bending=block.thicken * block.bending_mult,
    )
    magic = scene.magic
    thickness = magic.repulsion_thickness
    return Scene(
        mesh=mesh,
        material=raw if reload_materials else scaled,
        mass_material=scaled if reload_materials else None,
        handles=Handles(_handles(path, scene, mesh), magic.handle_stiffness, scene.diffcloud.hard_handles),
        frame_time=scene.frame_time,
        frame_steps=scene.frame_steps,
        end_time=min(scene.end_time, (scene.end_frame or np.inf) * scene.frame_time),
        surrounding=Surrounding(
            gravity=scene.gravity,
            wind=scene.wind.velocity,
            air_density=scene.wind.density,
            air_drag=scene.wind.drag,
            friction_cloth=scene.friction,
            friction_obstacle=scene.obs_friction,
            contact=ContactSettings(
                stiffness=magic.collision_stiffness,
                repulsion_thickness=thickness,
                projection_thickness=magic.projection_thickness or 0.1 * thickness,
            ),
            proximity="proximity" not in scene.disable,
            reference_contact=_contact(scene),
            lagged_air=_contact(scene) == ReferenceContact.as_published(),
            obstacles=tuple(
                _transform_surface(read_surface(_inside(root, obstacle.mesh, path)), obstacle.transform)
                for obstacle in scene.obstacles
            ),
        ),
        integrator=scene.diffcloud.integrator,
        shaped=scene.diffcloud.shaped,
    )


def _refuse_unsupported(path: Path, scene: SceneFile) -> None:
    faults = []
    if "remeshing" not in scene.disable:
        faults.append("remeshing is not supported: add it to `disable`")
    faults += [f"disable: {name!r} is not supported" for name in scene.disable if name not in _SUPPORTED_SWITCHES]
    faults += [
        f"obstacles.{index}.movable: rigid bodies are not supported, set it to 0"
        for index, obstacle in enumerate(scene.obstacles)
        if obstacle.movable
    ]
    if scene.magic.rib_stiffening != 1.0:
        faults.append("magic.rib_stiffening: only 1 is supported")
    for index, handle in enumerate(scene.handles):
        if handle.motion is not None and handle.motion >= len(scene.motions):
            faults.append(f"handles.{index}.motion: {handle.motion}, but the scene has {len(scene.motions)} motions")
    if faults:
        raise SceneError(f"{path}: " + "; ".join(faults) + ".")


def _contact(scene: SceneFile) -> ReferenceContact | None:
    if scene.diffcloud.integrator == "implicit" or scene.diffcloud.contact == "planes":
        return None
    return ReferenceContact.as_published() if scene.diffcloud.contact == "published" else ReferenceContact()


def _handles(path: Path, scene: SceneFile, mesh: ClothMesh) -> tuple[Handle, ...]:
    motions = [Motion(tuple(_keyframe(key) for key in keys)) for keys in scene.motions]
    several = len({block.motion for block in scene.handles} - {None}) > 1
    handles = []
    for index, block in enumerate(scene.handles):
        for node in block.nodes:
            if node >= len(mesh.nodes):
                raise SceneError(
                    f"{path}: handles.{index}.nodes: node {node} does not exist, the cloth has nodes "
                    f"0..{len(mesh.nodes) - 1}."
                )
            motion = None if block.motion is None else motions[block.motion]
            gripper = f"motion_{block.motion}" if several else "gripper"  # each motion is a gripper's
            handles.append(Handle(node, motion, block.start_time, block.end_time, block.fade_time, gripper))
    return tuple(handles)


def _keyframe(block: KeyframeBlock) -> Keyframe:
    angle, *axis = block.transform.rotate
    velocity = None
    if block.velocity is not None:
        if block.velocity.rotate[0] != 0:
            raise SceneError("motions: a keyframe velocity with rotation is not supported.")
        scale = block.velocity.scale if "scale" in block.velocity.model_fields_set else 0.0
        velocity = (*block.velocity.translate, scale, 0.0, 0.0, 0.0, 0.0)
    return Keyframe(
        time=block.time,
        translation=block.transform.translate,
        scale=block.transform.scale,
        quaternion=axis_angle_quaternion(angle, (axis[0], axis[1], axis[2])),
        velocity=velocity,
    )


def _transform_points(points: FloatArray, transform: TransformBlock) -> FloatArray:
    angle, *axis = transform.rotate
    key = Keyframe(0.0, transform.translate, transform.scale, axis_angle_quaternion(angle, (axis[0], axis[1], axis[2])))
    linear, translation = Motion((key,)).at(np.zeros(1))
    return np.asarray(points @ linear[0].T + translation[0])


def _transform_cloth(mesh: ClothMesh, transform: TransformBlock) -> ClothMesh:
    if transform == TransformBlock():
        return mesh
    return replace(mesh, nodes=_transform_points(mesh.nodes, transform), verts=mesh.verts * transform.scale)


def _transform_surface(mesh: SurfaceMesh, transform: TransformBlock) -> SurfaceMesh:
    return SurfaceMesh(_transform_points(mesh.nodes, transform), mesh.faces)


def _root(path: Path, mesh: str) -> Path:
    """The nearest folder above the scene file that holds its mesh."""
    for folder in path.resolve().parents:
        if (folder / mesh).is_file():
            return folder
    raise SceneError(
        f"{path}: no folder above it holds {mesh!r}; paths are relative to the folder with conf/, meshes/ and materials/."
    )


def _inside(root: Path, relative: str, scene: Path) -> Path:
    """`root/relative`, refused if it leads out of `root`."""
    target = (root / PurePosixPath(relative)).resolve()
    if not target.is_relative_to(root.resolve()):
        raise SceneError(f"{scene}: the path {relative!r} leaves the scene's folder; it must lie below {root}.")
    return target
