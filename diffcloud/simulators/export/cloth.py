"""Convert a fitted cloth to a problem for other simulators, and list what is lost in the conversion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from diffcloud.errors import ConfigError, DivergedError
from diffcloud.estimation.pose import PoseSpace
from diffcloud.estimation.record import RecordingFit
from diffcloud.estimation.result import FittedMotion, recorded_pose
from diffcloud.mesh.topology import ClothMesh, SurfaceMesh
from diffcloud.scene.description import Scene
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.materials import TABLE_ENTRY_TO_BENDING, TABLE_ENTRY_TO_STRETCHING, Material
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.simulators import ours
from diffcloud.simulators.problem import Problem, Sheet, Track, distances

WORTH_SAYING = 0.01
"""Relative difference of a stiffness, or initial strain, above which it is reported."""
_DIGITS = 12
"""Decimal places of the paths of held nodes in metres."""
_LEVEL = np.deg2rad(0.1)
_STRAINED = (0.0, 0.25, 0.5, 1.0)
"""Strains to try for a strain-stiffening material, as fractions of the reference strain of its tables."""


@dataclass(frozen=True)
class ExportedCloth:
    """A fitted cloth in metres, in the recording's frame, levelled such that z is up."""

    problem: Problem
    """Initial mesh, isotropic material, and the recorded motion of the held nodes."""
    scene: Scene
    """The same with the complete material, air and friction."""
    motion: NDArray[np.float64]
    """[T, V, 3] fitted node positions at the problem's times [m]."""
    left_out: tuple[str, ...]
    """Sentences about what both `problem` and `scene` lack of the fitted scene."""
    simplified: tuple[str, ...]
    """Sentences about what `problem` lacks of `scene`."""

    @cached_property
    def simplified_motion(self) -> Track:
        """Motion of the problem in DiffCloud's simulator."""
        return ours.simulate(self.problem, steps=self.scene.frame_steps, order=self.scene.order)

    @property
    def simplified_m(self) -> NDArray[np.float64]:
        """[T] RMS distance that the simplifications of the problem cause [m]. Infinite if the problem cannot be
        simulated."""
        try:
            return distances(self.simplified_motion, Track(self.motion, 0.0))
        except DivergedError:
            return np.full(len(self.motion), np.inf)


def fitted_cloth(
    recording: RecordingFit, motion: FittedMotion, scenario: Scenario, values: Mapping[str, float]
) -> ExportedCloth:
    """Convert a fit to an exportable cloth, with the isotropic material whose motion is most similar.

    Args:
        motion: fitted motion of the recording.
        scenario: scenario of the recording.
        values: multipliers of all parameters.

    Raises:
        ConfigError: the scene is not in SI units, its mesh is not the fit's, or no node is held from start to end.
    """
    if scenario.length_unit_m != 1:
        raise ConfigError(
            f"{scenario.name} has a length unit of {scenario.length_unit_m:g} m. An export needs metres. Fit the recording "
            "in a scene in metres, such as recorded_lift or recorded_fold."
        )
    scene = scenario.fitted_scene(values)
    if motion.nodes.shape[1] != len(scene.mesh.nodes) or not np.array_equal(motion.faces, scene.mesh.faces):
        raise ConfigError(
            f"The fit's mesh ({motion.nodes.shape[1]} nodes) is not that of the scenario {scenario.name} "
            f"({len(scene.mesh.nodes)} nodes). Put the fitted scene's YAML file into scenes/ beside the fit."
        )
    size = recording.nuisance.get("size")
    if size is not None:
        scene = replace(scene, mesh=replace(scene.mesh, verts=math.exp(size.value) * scene.mesh.verts))
    linear = bool(np.allclose(scene.material.stretching, scene.material.stretching[0], rtol=WORTH_SAYING))
    tried = [_cloth(recording, motion, scene, strained) for strained in ((0.0,) if linear else _STRAINED)]
    return tried[0] if linear else min(tried, key=lambda cloth: float(cloth.simplified_m.mean()))


def _cloth(recording: RecordingFit, motion: FittedMotion, scene: Scene, strained: float) -> ExportedCloth:
    space, pose = recorded_pose(recording, length_unit_m=1.0)
    nodes, tilt = _levelled(motion.nodes, space, pose)
    bodies = SurfaceMesh(_levelled(motion.bodies.nodes, space, pose)[0], motion.bodies.faces)
    sheet, said = isotropic_sheet(scene.material, strained)
    around = scene.surrounding
    tables = [surface for surface in around.obstacles if surface.plane() is not None]
    shift = float(recording.nuisance["z"].value) if "z" in recording.nuisance else 0.0
    path = _levelled(motion.held_nodes, space, pose)[0]
    held, left_out = _held(scene, motion, path)
    problem = Problem(
        name=recording.name,
        mesh=ClothMesh(nodes[0], scene.mesh.verts, scene.mesh.vert_node, scene.mesh.face_verts),
        sheet=sheet,
        seconds=float(motion.times[-1]),
        held=held,
        table=float(tables[0].nodes[:, 2].mean()) + shift if tables else None,
        friction=around.friction,
        self_friction=around.self_friction,
        self_contact=around.self_contact,
        bodies=(bodies,) if len(bodies.faces) else (),
        shaped=scene.shaped,
        gravity=-around.gravity[2],
        rate=1 / scene.frame_time,
    )
    if tilt > _LEVEL:
        left_out.append(f"The recording is tilted by {np.rad2deg(tilt):.1f}° against gravity; what is exported is level.")
    if len(tables) > 1:
        left_out.append(f"Of {len(tables)} tables only the first is exported.")
    if around.moving or around.bodies:
        left_out.append("Obstacles that move are not exported.")
    simplified = (*said, *_simplified(scene))
    return ExportedCloth(problem, _whole(scene, problem), nodes, tuple(left_out), simplified)


def _whole(scene: Scene, problem: Problem) -> Scene:
    """Return the scene in the problem's frame, with the recorded motion."""
    alike = ours.scene(problem)
    around = replace(scene.surrounding, obstacles=alike.surrounding.obstacles, moving=(), bodies=())
    own = {handle.node: handle for handle in scene.handles.handles}
    held = tuple(replace(one, pad=own[one.node].pad, gripper=own[one.node].gripper) for one in alike.handles.handles)
    handles = replace(alike.handles, handles=held, grasp=scene.handles.grasp)
    return replace(scene, mesh=problem.mesh, handles=handles, surrounding=around, end_time=problem.seconds)


def _simplified(scene: Scene) -> list[str]:
    around, said = scene.surrounding, []
    if any(around.gravity[:2]):
        said.append(f"Gravity is vertical; in the fit it is {list(around.gravity)} m/s².")
    if around.air_density or around.air_drag or around.linear_drag or around.added_mass:
        moving = f", of which {around.added_mass:.3g} kg/m² move with the cloth" if around.added_mass else ""
        said.append(f"There is no air; the fit has air of {around.air_density:.3g} kg/m³{moving}.")
    if not scene.handles.hard:
        said.append(f"Held nodes follow exactly; in the fit, springs of {scene.handles.stiffness:g} N/m hold them.")
    grasp = scene.handles.grasp
    if grasp is not None and grasp.kind == "pivot":
        said.append(f"Held nodes are points of the mesh; in the fit, each yields as a {grasp.described(1)} does.")
    return said


def isotropic_sheet(material: Material, strained: float = 0.0) -> tuple[Sheet, list[str]]:
    """Return the isotropic sheet nearest to a material, and sentences about the differences.

    The elastic tensor is projected on isotropic tensors, that is, averaged over all in-plane directions.

    Args:
        strained: strain at which the stiffness is taken, as a fraction of the reference strain of the material's
            tables.
    """
    rest, reference = material.stretching[0], material.stretching[1:].mean(axis=0)
    row = (1 - strained) * rest + strained * reference
    uu, uv, vv, shear = (TABLE_ENTRY_TO_STRETCHING * float(entry) for entry in row)
    shear /= 2  # force per width per shear angle, C_66
    plane = (3 * (uu + vv) + 2 * uv + 4 * shear) / 8
    poisson = max((uu + vv + 6 * uv - 4 * shear) / 8 / plane, 0.0)
    stretching = plane * (1 - poisson**2)
    said = []
    if uu * vv > uv**2 and shear > 0:
        inverse = np.linalg.inv([[uu, uv], [uv, vv]])
        warp, weft = 1 / inverse[0, 0], 1 / inverse[1, 1]
        bias = 4 / (inverse.sum() + 1 / shear)
        strips = {"along the cloth's first side": warp, "along its second side": weft, "at 45°": bias}
        off = {name: stretching / value - 1 for name, value in strips.items()}
        if max(abs(part) for part in off.values()) > WORTH_SAYING:
            told = ", ".join(f"{strips[name]:.3g} N/m {name} (export: {off[name]:+.0%})" for name in strips)
            said.append(f"The material is isotropic with {stretching:.3g} N/m; in the fit, a strip has {told}.")
    else:
        said.append(
            f"The material is isotropic with {stretching:.3g} N/m; in the fit, it does not resist every deformation."
        )
    stiffening = float(reference[[0, 2]].mean() / rest[[0, 2]].mean())
    if abs(stiffening - 1) > WORTH_SAYING:
        part = f"{strained:.0%} of the way from rest to that strain"
        where = {0.0: "at rest", 1.0: "at that strain"}.get(strained, part)
        said.append(
            f"Stretching is linear; in the fit, its stiffness at 12.5 % strain is {stiffening:.3g} times that at rest. The "
            f"exported stiffness is the one {where}."
        )
    if material.compression < 1 - WORTH_SAYING:
        said.append(
            "Compression in the plane is resisted as stretching is; in the fit, the cloth wrinkles finer than its mesh "
            f"instead, and {material.compression:.1%} of the stiffness stays."
        )
    flat = TABLE_ENTRY_TO_BENDING * material.bending
    bending = material.resting_bending_stiffness
    apart = float(np.abs(flat / bending - 1).max())
    if apart > WORTH_SAYING:
        said.append(
            f"Bending has one stiffness, {bending:.3g} N·m; in the fit it is {flat.min():.3g} to {flat.max():.3g} N·m by "
            "direction and curvature."
        )
    return Sheet(material.density, stretching, poisson, bending, material.damping), said


def start_strain(mesh: ClothMesh) -> float:
    """Largest Green strain of the faces in the initial state."""
    return float(np.abs(_metric(mesh, mesh.nodes) - np.eye(2)).max() / 2)


def _metric(mesh: ClothMesh, nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """[..., F, 2, 2] metric C = FᵀF of the faces at node positions [..., V, 3]."""
    corners = nodes[..., mesh.faces, :]
    edges = np.stack([corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]], axis=-1)
    gradient = edges @ np.linalg.inv(mesh.material_edges)
    return np.asarray(gradient.swapaxes(-1, -2) @ gradient)


def _levelled(points: NDArray[np.float64], space: PoseSpace, pose: torch.Tensor) -> tuple[NDArray[np.float64], float]:
    """Remove the tilt of the recording from points [..., 3], but not its scale. Return points and tilt [rad]."""
    level = pose.clone()
    tilted = [index for index, name in enumerate(space.names) if name.startswith("tilt")]
    of_cameras = [*tilted, *(index for index, name in enumerate(space.names) if name == "scale")]
    if not of_cameras or not len(points):
        return points, 0.0
    level[:, of_cameras] = 0.0
    scene = space.back(torch.as_tensor(points), pose)[0]
    return space.moved(scene[None], level)[0].numpy(), float(pose[0, tilted].norm())


def _held(scene: Scene, motion: FittedMotion, paths: NDArray[np.float64]) -> tuple[dict[int, Motion | None], list[str]]:
    """Return held node -> motion, from paths [S + 1, K, 3], and sentences about nodes that are released."""
    times, rows = motion.held_times, {int(node): row for row, node in enumerate(motion.held)}
    absent = {handle.node for handle in scene.handles.handles} - rows.keys()
    if absent:
        raise ConfigError(
            f"The fit holds the nodes {sorted(rows)}, but its scene also holds {sorted(absent)}. Fit and scene must hold "
            "the same nodes. Put the fitted scene's YAML file into scenes/ beside the fit, or fit again."
        )
    held: dict[int, Motion | None] = {}
    loose = set()
    for handle in scene.handles.handles:
        if handle.start > times[0] or handle.end < times[-1]:
            loose.add(handle.node)
            continue
        path = paths[:, rows[handle.node]]
        if np.ptp(path, axis=0).max() < 1e-9:
            held.setdefault(handle.node, None)
        else:
            path = np.round(path - path[0], _DIGITS)  # removes rounding differences between nodes of one pad
            keys = tuple(Keyframe(float(time), (x, y, z)) for time, (x, y, z) in zip(times, path.tolist(), strict=True))
            held[handle.node] = Motion(keys)
    loose -= held.keys()
    if not held:
        raise ConfigError("No node is held from start to end, so there is no motion to export.")
    told = [
        f"Node {node} is held for only part of the time; in the export it is free throughout." for node in sorted(loose)
    ]
    return held, told
