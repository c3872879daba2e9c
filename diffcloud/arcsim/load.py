"""Loads scenes from ARCSim/DiffSim JSON files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from pydantic import ValidationError

from diffcloud.arcsim.schema import KeyframeBlock, ObstacleBlock, SceneFile, TransformBlock
from diffcloud.errors import SceneError
from diffcloud.io.files import read_json
from diffcloud.io.obj import read_cloth, read_surface
from diffcloud.io.schema import explain
from diffcloud.mesh.topology import ClothMesh, FloatArray, SurfaceMesh
from diffcloud.scene.description import Scene
from diffcloud.sim.grasp import GRIP_M, Grasp, nodes_under_pad
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.materials import read_material
from diffcloud.sim.motion import Keyframe, Motion, axis_angle_quaternion
from diffcloud.sim.rigid.bodies import Bodies
from diffcloud.sim.rigid.body import RigidBody
from diffcloud.sim.scenery import MovingObstacle
from diffcloud.sim.surrounding import ContactSettings, ReferenceContact, Surrounding

_SUPPORTED_SWITCHES = {"remeshing", "proximity", "strainlimiting", "separation", "popfilter", "plasticity"}
"""Supported values of `disable`: stages that this simulator has (proximity) or never runs."""


def load_scene(path: Path, *, reload_materials: bool = False) -> Scene:
    """Read a scene file. Mesh and material paths are relative to the nearest parent folder that contains them.

    Args:
        reload_materials: reproduce the published DiffCloud experiments. They read the material tables again after the
            masses were computed. So `thicken` and the multipliers affect the masses, but not stretching and bending.

    Raises:
        SceneError: an unreadable file, an unknown or unsupported field, a path outside the scene's folder, a reference to a
            motion or node that does not exist, or contradictory obstacle settings.
        MeshError: a mesh is missing or cannot be simulated.
    """
    path = Path(path)
    data = read_json(path, error=SceneError, comments=True)
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
    raw = replace(raw, damping=damping, compression=scene.diffcloud.compression)
    scaled = raw.scaled(
        density=block.thicken * block.density_mult,
        stretching=block.thicken * block.stretching_mult,
        bending=block.thicken * block.bending_mult,
    )
    motions = [_motion(f"{path}: motions.{index}", keys) for index, keys in enumerate(scene.motions)]
    placed = [
        (block, _transform_surface(read_surface(_inside(root, block.mesh, path)), block.transform))
        for block in scene.obstacles
    ]
    magic = scene.magic
    thickness = magic.repulsion_thickness
    return Scene(
        mesh=mesh,
        material=raw if reload_materials else scaled,
        mass_material=scaled if reload_materials else None,
        handles=Handles(
            _handles(path, scene, mesh, motions), magic.handle_stiffness, scene.diffcloud.hard_handles, _grasp(scene)
        ),
        frame_time=scene.frame_time,
        frame_steps=scene.frame_steps,
        end_time=min(scene.end_time, (scene.end_frame or np.inf) * scene.frame_time),
        surrounding=Surrounding(
            gravity=scene.gravity,
            wind=scene.wind.velocity,
            air_density=scene.wind.density,
            air_drag=scene.wind.drag,
            added_mass=scene.diffcloud.added_mass,
            linear_drag=scene.diffcloud.linear_drag,
            self_friction=scene.friction,
            friction=scene.obs_friction,
            contact=ContactSettings(
                stiffness=magic.collision_stiffness,
                repulsion_thickness=thickness,
                projection_thickness=magic.projection_thickness or 0.1 * thickness,
            ),
            proximity="proximity" not in scene.disable,
            reference_contact=_contact(scene),
            lagged_air=_contact(scene) == ReferenceContact.as_published(),
            obstacles=tuple(surface for block, surface in placed if not block.is_body and block.motion is None),
            moving=tuple(
                MovingObstacle(surface, motions[block.motion], block.start_time, block.end_time)
                for block, surface in placed
                if block.motion is not None
            ),
            bodies=tuple(
                _body(f"{path}: obstacles.{index}", block, surface)
                for index, (block, surface) in enumerate(placed)
                if block.is_body
            ),
        ),
        integrator=_integrator(scene),
        shaped=scene.diffcloud.shaped,
    )


def _refuse_unsupported(path: Path, scene: SceneFile) -> None:
    faults = []
    if "remeshing" not in scene.disable:
        faults.append("remeshing is not supported: add it to `disable`")
    faults += [f"disable: {name!r} is not supported" for name in scene.disable if name not in _SUPPORTED_SWITCHES]
    for index, obstacle in enumerate(scene.obstacles):
        faults += [f"obstacles.{index}.{fault}" for fault in _contradictions(obstacle, scene)]
    if scene.magic.rib_stiffening != 1.0:
        faults.append("magic.rib_stiffening: only 1 is supported")
    for index, handle in enumerate(scene.handles):
        if handle.motion is not None and handle.motion >= len(scene.motions):
            faults.append(f"handles.{index}.motion: {handle.motion}, but the scene has {len(scene.motions)} motions")
    if faults:
        raise SceneError(f"{path}: " + "; ".join(faults) + ".")


def _contradictions(block: ObstacleBlock, scene: SceneFile) -> Iterator[str]:
    """Contradictions between the fields of an obstacle, each of which is valid alone."""
    given = block.model_fields_set
    if block.motion is None:
        for name in ("start_time", "end_time"):
            if name in given:
                yield f"{name}: of an obstacle with a `motion`; one that comes or goes is not supported, leave it out"
    elif block.movable:
        yield "movable: it has a `motion`, which nothing can push it off; set `movable` to 0 or leave `motion` out"
    elif block.motion >= len(scene.motions):
        yield f"motion: {block.motion}, but the scene has {len(scene.motions)} motions"
    elif any(key.transform.scale == 0 for key in scene.motions[block.motion]):
        yield f"motion: motion {block.motion} shrinks the obstacle to a point; its keyframes need a `scale` above 0"
    if block.start_time > block.end_time:
        yield f"end_time: {block.end_time} comes before start_time {block.start_time}"
    if "diffcloud" in given and not block.is_body:
        yield "diffcloud: of movable obstacles only; leave it out, or set `movable` to 1 and leave `motion` out"
    if block.diffcloud.density is not None and block.diffcloud.mass is not None:
        yield "diffcloud: give either `density` or `mass`"
    if scene.diffcloud.integrator == "arcsim":
        advice = 'set `diffcloud.integrator` to "implicit" or leave it out'
        if block.is_body:
            yield f"movable: rigid bodies need the implicit integrator; {advice}, or set `movable` (default 1) to 0"
        elif block.motion is not None:
            yield f"motion: moving obstacles need the implicit integrator; {advice}"


def _integrator(scene: SceneFile) -> str:
    moves = any(block.is_body or block.motion is not None for block in scene.obstacles)
    return scene.diffcloud.integrator or ("implicit" if moves else "arcsim")


def _body(place: str, block: ObstacleBlock, mesh: SurfaceMesh) -> RigidBody:
    own = block.diffcloud
    body = RigidBody(mesh, mass=own.mass, velocity=own.velocity, angular_velocity=own.angular_velocity)
    body = body if own.density is None else replace(body, density=own.density)
    try:
        Bodies.build([body])
    except SceneError as error:
        hint = "If nothing moves it, set its `movable` to 0."
        raise SceneError(f"{place} is movable (ARCSim's default). {error} {hint}") from error
    return body


def _contact(scene: SceneFile) -> ReferenceContact | None:
    if _integrator(scene) != "arcsim" or scene.diffcloud.contact == "planes":
        return None
    return ReferenceContact.as_published() if scene.diffcloud.contact == "published" else ReferenceContact()


def _grasp(scene: SceneFile) -> Grasp | None:
    own = scene.diffcloud
    return None if own.grip is None else Grasp(own.grip, GRIP_M if own.grip_m is None else own.grip_m)


def _handles(path: Path, scene: SceneFile, mesh: ClothMesh, motions: list[Motion]) -> tuple[Handle, ...]:
    several = len({block.motion for block in scene.handles} - {None}) > 1
    step = scene.frame_time / scene.frame_steps
    handles, grasp = [], _grasp(scene)
    for index, block in enumerate(scene.handles):
        taken = step * max(1.0, np.ceil(block.start_time / step))
        # In the published scenes, this happens only later.
        if block.motion is not None and np.allclose(motions[block.motion].at(np.array([taken]))[0], 0.0):
            raise SceneError(
                f"{path}: handles.{index}.motion: motion {block.motion} has shrunk the cloth to a point when the handle "
                f"takes hold, at {taken:g} s; its keyframes need a `scale` above 0 there."
            )
        for node in block.nodes:
            if node >= len(mesh.nodes):
                raise SceneError(
                    f"{path}: handles.{index}.nodes: node {node} does not exist, the cloth has nodes "
                    f"0..{len(mesh.nodes) - 1}."
                )
        nodes, pad = block.nodes, 0
        if grasp is not None and grasp.kind == "pad":
            pad = index + 1
            if len(block.nodes) == 1:
                try:
                    nodes = nodes_under_pad(mesh, block.nodes[0], grasp.size)
                except SceneError as error:
                    raise SceneError(f"{path}: handles.{index}: {error}") from error
        motion = None if block.motion is None else motions[block.motion]
        gripper = f"motion_{block.motion}" if several else "gripper"  # each motion belongs to one gripper
        one = Handle(0, motion, block.start_time, block.end_time, block.fade_time, gripper, pad)
        handles += [replace(one, node=node) for node in nodes]
    return tuple(handles)


def _motion(place: str, keys: list[KeyframeBlock]) -> Motion:
    try:
        return Motion(tuple(_keyframe(key) for key in keys))
    except SceneError as error:
        raise SceneError(f"{place}: {error}") from error


def _keyframe(block: KeyframeBlock) -> Keyframe:
    angle, *axis = block.transform.rotate
    velocity = None
    if block.velocity is not None:
        if block.velocity.rotate[0] != 0:
            raise SceneError("A keyframe velocity with rotation is not supported.")
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
    """The nearest folder above the scene file that contains its mesh."""
    for folder in path.resolve().parents:
        if (folder / mesh).is_file():
            return folder
    raise SceneError(
        f"{path}: no folder above it holds {mesh!r}; paths are relative to the folder with conf/, meshes/ and materials/."
    )


def _inside(root: Path, relative: str, scene: Path) -> Path:
    """`root/relative`. Raise an error if it is outside `root`."""
    target = (root / PurePosixPath(relative)).resolve()
    if not target.is_relative_to(root.resolve()):
        raise SceneError(f"{scene}: the path {relative!r} leaves the scene's folder; it must lie below {root}.")
    return target
