"""Writes a scene as ARCSim/DiffSim JSON with its meshes and material. Loading it gives the same system."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from diffcloud.errors import SceneError
from diffcloud.io.files import write_json
from diffcloud.io.obj import write_cloth, write_surface
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.scene.description import Scene
from diffcloud.sim.handles import Handle
from diffcloud.sim.materials import Material
from diffcloud.sim.motion import Motion
from diffcloud.sim.surrounding import ContactSettings, ReferenceContact, Surrounding

_Owned = tuple[str | None, Motion]
"""Name of a gripper and its motion; the name is None for the motion of an obstacle."""


def write_scene(scene: Scene, folder: Path, name: str = "scene") -> Path:
    """Write `conf/<name>.json`, `meshes/<name>/*.obj` and `materials/<name>.json` below `folder`.

    Returns:
        The path of the scene file.

    Raises:
        SceneError: the format cannot express the scene: masses from another material than the tables (as in the published
            experiments), further forces, a gripper with several motions, contact options of the arcsim integrator without a
            name, or some settings of the implicit integrator.
    """
    folder = Path(folder)
    if scene.mass_material is not None:
        raise SceneError("A scene whose masses come from another material cannot be written as ARCSim JSON.")
    around = scene.surrounding
    unsaid = {
        "order": scene.integrator == "implicit" and scene.order != 2 and not around.bodies,
        "self_contact": not around.self_contact,
        "forces": bool(around.forces),
        "contact.sticking_speed": around.contact.sticking_speed != ContactSettings().sticking_speed,
        "reference_contact": around.reference_contact not in (None, ReferenceContact(), ReferenceContact.as_published()),
        "lagged_air": scene.integrator == "arcsim"
        and around.lagged_air != (around.reference_contact == ReferenceContact.as_published()),
        "a gripper with several motions": _shared_grippers(scene),
        "an upright pad": any(any(handle.turned) for handle in scene.handles.handles),
    }
    if any(unsaid.values()):
        named = ", ".join(name for name, lost in unsaid.items() if lost)
        raise SceneError(f"ARCSim JSON has no place for {named} of this scene; take the default, or keep it in Python.")
    cloth, material = f"meshes/{name}/cloth.obj", f"materials/{name}.json"
    write_cloth(folder / cloth, scene.mesh)
    write_json(folder / material, _material(scene.material))
    motions: list[_Owned] = []
    obstacles = []
    for index, (surface, obstacle) in enumerate(_obstacles(around, motions)):
        mesh = f"meshes/{name}/obstacle{index}.obj"
        write_surface(folder / mesh, surface)
        obstacles.append({"mesh": mesh, **obstacle})

    handles: list[dict[str, Any]] = []
    pads: dict[Handle, dict[str, Any]] = {}
    for handle in scene.handles.handles:
        if handle.pad and (pad := pads.get(replace(handle, node=0))):
            pad["nodes"].append(handle.node)
            continue
        block: dict[str, Any] = {"nodes": [handle.node], "start_time": handle.start, "fade_time": handle.fade}
        if math.isfinite(handle.end):
            block["end_time"] = handle.end
        if handle.motion is not None:
            block["motion"] = _number((handle.gripper, handle.motion), motions)
        handles.append(block)
        pads[replace(handle, node=0)] = block

    data: dict[str, Any] = {
        "frame_time": scene.frame_time,
        "frame_steps": scene.frame_steps,
        "cloths": [{"mesh": cloth, "materials": [{"data": material, "damping": scene.material.damping}]}],
        "motions": [_motion(motion) for _, motion in motions],
        "handles": handles,
        "obstacles": obstacles,
        "gravity": list(around.gravity),
        "wind": {"density": around.air_density, "velocity": list(around.wind), "drag": around.air_drag},
        "friction": around.self_friction,
        "obs_friction": around.friction,
        "disable": ["remeshing"] + ([] if around.proximity else ["proximity"]),
        "magic": {
            "handle_stiffness": scene.handles.stiffness,
            "collision_stiffness": around.contact.stiffness,
            "repulsion_thickness": around.contact.repulsion_thickness,
            "projection_thickness": around.contact.projection_thickness,
        },
        "diffcloud": {
            "hard_handles": scene.handles.hard,
            "integrator": scene.integrator,
            "shaped": scene.shaped,
            "contact": _contact_name(scene.surrounding.reference_contact),
            "compression": scene.material.compression,
            "added_mass": around.added_mass,
            "linear_drag": around.linear_drag,
        },
    }
    grasp = scene.handles.grasp
    if grasp is not None and grasp.kind != "upright_pad":  # the motions of its nodes fully describe an upright pad
        data["diffcloud"] |= {"grip": grasp.kind, "grip_m": grasp.size}
    if math.isfinite(scene.end_time):
        data["end_time"] = scene.end_time
    path = folder / "conf" / f"{name}.json"
    write_json(path, data)
    return path


def _shared_grippers(scene: Scene) -> bool:
    """Whether the handles of one gripper have different motions. Loading would make each motion a separate gripper."""
    moved = {(handle.gripper, handle.motion) for handle in scene.handles.handles if handle.motion is not None}
    return len(moved) > len({gripper for gripper, _ in moved})


def _obstacles(around: Surrounding, motions: list[_Owned]) -> Iterator[tuple[SurfaceMesh, dict[str, Any]]]:
    """Meshes and blocks of all obstacles. New motions are appended to `motions`."""
    for surface in around.obstacles:
        yield surface, {"movable": 0}
    for moving in around.moving:
        block = {"movable": 0, "motion": _number((None, moving.motion), motions), "start_time": moving.start}
        yield moving.mesh, block | ({"end_time": moving.end} if math.isfinite(moving.end) else {})
    for body in around.bodies:
        weight = {"density": body.density} if body.mass is None else {"mass": body.mass}
        own = {"velocity": list(body.velocity), "angular_velocity": list(body.angular_velocity)}
        yield body.mesh, {"movable": 1, "diffcloud": weight | own}


def _number(motion: _Owned, motions: list[_Owned]) -> int:
    """Index of a motion in the list, to which it is appended if it is new. Grippers do not share motions."""
    if motion not in motions:
        motions.append(motion)
    return motions.index(motion)


def _material(material: Material) -> dict[str, Any]:
    return {
        "density": material.density,
        "stretching": material.stretching.tolist(),
        "bending": material.bending.tolist(),
    }


def _motion(motion: Motion) -> list[dict[str, Any]]:
    keys = []
    for key in motion.keyframes:
        w, x, y, z = key.quaternion
        angle = 2 * math.degrees(math.atan2(math.hypot(x, y, z), w))
        block: dict[str, Any] = {
            "time": key.time,
            "transform": {"translate": list(key.translation), "scale": key.scale, "rotate": [angle, x, y, z]},
        }
        if key.velocity is not None:
            if any(key.velocity[4:]):
                raise SceneError("A keyframe velocity with rotation cannot be written as ARCSim JSON.")
            block["velocity"] = {"translate": list(key.velocity[:3]), "scale": key.velocity[3]}
        keys.append(block)
    return keys


def _contact_name(contact: ReferenceContact | None) -> str:
    if contact is None:
        return "planes"
    return "published" if contact == ReferenceContact.as_published() else "meshes"
