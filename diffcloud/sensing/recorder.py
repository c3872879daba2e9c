"""Synthetic raw episodes: an arm moves a simulated cloth over a table in front of depth cameras.

The output is a normal raw episode. The additional folder `truth` has the ground truth: pixel labels, cloth positions
and camera poses. No code that reads raw episodes uses it.

    truth/cloth.npz                   nodes [T, V, 3] [m] in the world, faces [F, 3], times [T] [s]
    truth/cameras.json                T_world_camera of each camera, and the true pose of the scene
    truth/<cam>/000000.png            16-bit [H, W] labels: NOTHING, TABLE, CLOTH, ROBOT

The rendered arm differs from the model that the mask uses (`arm_body`), and the joint log has a clock offset. This
makes the test of the mask realistic.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffcloud.errors import EpisodeError, RobotError
from diffcloud.io.arrays import read_npz
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.clouds import import_open3d
from diffcloud.io.files import read_json, write_json, write_npz
from diffcloud.io.images import read_depth, write_depth
from diffcloud.io.raw_episodes import RawEpisodeWriter, RobotSample, ScenePlacement, read_placement
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.sensing.arm_body import cable, lookalike
from diffcloud.sensing.cameras import rotate, transform
from diffcloud.sensing.depth_camera import DepthCamera
from diffcloud.sensing.masking import RobotMask, View
from diffcloud.sensing.robot import Robot, gen3

Floats = NDArray[np.float64]

NOTHING, TABLE, CLOTH, ROBOT = range(4)
STARTED_AT = "2000-01-01T00:00:00.000+00:00"
"""Start time of every synthetic episode, so that the same seed gives the same bytes."""

_DOWN = np.diag([1.0, -1.0, -1.0])
"""Orientation of a gripper that points down, with the fingers on both sides of the cloth along x."""
_LEANS_DEG = (0.0, 10.0, 20.0, 30.0)
"""Outward tilt angles of the gripper. The first one at which the arm reaches the whole motion is used."""
_GRASP_M = 0.071
"""Distance along the tool's z from the tool frame to the fingertips."""
_GRIPPER_CLOSED = 1.0
_COLORS = np.array([[60, 60, 60], [126, 114, 100], [0, 0, 0], [205, 205, 208]], dtype=np.float64)
"""RGB colours of NOTHING (the floor), TABLE, CLOTH (replaced by a setting) and ROBOT."""
_CABLE_COLOR = np.array([30.0, 30.0, 30.0])
_COLOR_NOISE = 4.0
_LIGHT = np.array([0.3, -0.4, 0.866])
_SAME = 2e-3
"""Relative tolerance of an occlusion test: a hit this close before a point is the point itself."""
_BEFORE_S = 0.5
"""The joint log starts this long before the first image and ends this long after the last [s]."""


_IN_REACH = ScenePlacement((0.5, 0.04, 0.0), float(np.pi / 2))
"""Pose of the cloth in front of the arm, rotated as in the published experiments."""


@dataclass(frozen=True)
class RecorderSettings:
    """Settings of the synthetic set-up."""

    placement: ScenePlacement = _IN_REACH
    joint_rate_hz: float = 40.0
    clock_offset_s: float = 0.02
    """Offset of the joint log's times: logged time minus true time."""
    largest_growth_m: float = 0.003
    """Maximum excess size of the rendered arm relative to its model."""
    with_cable: bool = True
    extrinsic_error: tuple[float, float] = (0.0, 0.0)
    """(mm, degrees) error of the stated pose of each camera except the first, in a random direction per episode."""
    rig_error: tuple[float, float] = (0.0, 0.0)
    """(mm, degrees) common pose error of all cameras. They still agree with each other, but not with the arm."""
    placement_error: tuple[float, float] = (0.0, 0.0)
    """(mm, degrees about the vertical) difference between the true and the stated pose of cloth and gripper."""
    table_size_m: tuple[float, float] = (1.1, 1.3)
    """Size along x and y of the base frame, centred below the scene's origin."""


@dataclass(frozen=True)
class ClothMotion:
    """Simulated motion to render, in the scene's frame."""

    nodes: Floats
    """[T, V, 3] nodes at each frame."""
    faces: NDArray[np.int64]
    """[F, 3] faces of the cloth."""
    times: Floats
    """[T] times of the frames [s]."""
    grasped: Sequence[int]
    """Nodes whose mean position the gripper follows."""
    table_height: float = 0.0


@dataclass(frozen=True)
class Truth:
    """Ground truth of a synthetic episode."""

    nodes: Floats
    """[T, V, 3] cloth nodes in the world [m]."""
    faces: NDArray[np.int64]
    T_world_camera: Mapping[str, Floats]
    placement: ScenePlacement
    """True pose of the scene."""
    folder: Path

    def labels(self, camera: str, index: int) -> NDArray[np.uint16]:
        """Return labels [H, W]: NOTHING, TABLE, CLOTH or ROBOT."""
        return read_depth(self.folder / camera / f"{index:06d}.png")

    def visible_cloth(self, camera: str, intrinsics: Intrinsics, index: int) -> tuple[Floats, NDArray[np.int64]]:
        """Return the world points [P, 3] [m] and pixels [P, 2] of the cloth in an ideal camera image."""
        view = View(intrinsics, self.T_world_camera[camera])
        seen = self.labels(camera, index) == CLOTH
        row, column = np.nonzero(seen)
        depth, _, _ = _cast(caster([SurfaceMesh(self.nodes[index], self.faces)]), view, np.zeros(3), view.directions[seen])
        hit = np.isfinite(depth)  # a ray in single precision may miss the rim
        points = transform(view.T_world_camera, view.directions[seen][hit] * depth[hit, None])
        return points, np.column_stack([column, row])[hit]


def read_truth(folder: Path) -> Truth:
    """Read the ground truth of a synthetic raw episode.

    Raises:
        EpisodeError: the episode is not synthetic, or a file is damaged.
    """
    place = Path(folder) / "truth"
    if not place.is_dir():
        raise EpisodeError(f"{folder} has no folder truth: only synthetic recordings know the truth.")
    poses = read_json(place / "cameras.json", error=EpisodeError)
    cloth = read_npz(place / "cloth.npz", kind="truth of a cloth", error=EpisodeError, names=("nodes", "faces"))
    try:
        cameras = {name: np.array(pose, dtype=np.float64) for name, pose in poses["T_world_camera"].items()}
        placement = read_placement(poses["scene_in_world"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise EpisodeError(
            f"{place / 'cameras.json'} does not say where the cameras and the scene were; record again with "
            "`python -m pipeline.synthesize`."
        ) from error
    return Truth(cloth["nodes"], cloth["faces"], cameras, placement, place)


def record(
    folder: Path,
    motion: ClothMotion,
    cameras: Sequence[DepthCamera],
    *,
    settings: RecorderSettings | None = None,
    cloth_color: tuple[int, int, int] = (40, 70, 170),
    seed: int,
    meta: Mapping[str, Any],
    tell: Callable[[int, str], None] = lambda done, text: None,
) -> None:
    """Write a synthetic raw episode and its ground truth.

    Args:
        folder: output folder, which must not exist yet.
        cloth_color: red, green, blue in full light.
        seed: seed of the noise, the arm's shape and the extrinsic error.
        meta: labels for episode.json, such as scenario and fabric.
        tell: progress callback with (frames done, text).

    Raises:
        EpisodeError: the folder exists.
        RobotError: the cloth's path is out of the arm's reach at every tilt of the gripper.
    """
    settings = settings or RecorderSettings()
    rng, others = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    robot = gen3()
    placement = _misplaced(settings, motion.nodes, others)
    nodes = placement.to_world(motion.nodes)
    held = nodes[:, list(motion.grasped)].mean(axis=1)
    joints = _holding(robot, held)
    poses = robot.forward_kinematics(robot.configuration(joints, _GRIPPER_CLOSED))
    scene = _Scene(robot, motion.faces, _table(motion, settings), settings, np.array(cloth_color, dtype=np.float64), rng)
    moved = _motion(*settings.rig_error, nodes, others)
    stated = {
        camera.name: _motion(*(settings.extrinsic_error if index else (0.0, 0.0)), nodes, rng)
        @ moved
        @ camera.view.T_world_camera
        for index, camera in enumerate(cameras)
    }
    interval = float(np.median(np.diff(motion.times))) if len(motion.times) > 1 else 1.0
    described = {
        **meta,
        "scene_in_world": asdict(settings.placement),
    }
    with RawEpisodeWriter(
        folder,
        {camera.name: camera.info(stated[camera.name]) for camera in cameras},
        rate_hz=round(1 / interval, 6),
        source="synthetic",
        robot={"model": "Kinova Gen3, Robotiq 2F-85 (synthetic)"},
        durable=False,
        meta=described,
        started_at=STARTED_AT,
    ) as writer:
        _write_log(writer, robot, motion.times, joints, settings)
        for index, time in enumerate(motion.times):  # images are taken one after the other; each is vectorised
            scene.place(nodes[index], poses[index])
            for camera in cameras:
                depth_m, labels, color = scene.render(camera.view, rng)
                hidden = scene.hidden(camera, depth_m, labels)
                writer.add_frame(camera.name, float(time), camera.measure(depth_m, hidden, rng), color)
                write_depth(folder / "truth" / camera.name / f"{index:06d}.png", labels)
            tell(index + 1, f"frame {index}")
    true = {camera.name: camera.view.T_world_camera.tolist() for camera in cameras}
    write_json(folder / "truth" / "cameras.json", {"T_world_camera": true, "scene_in_world": asdict(placement)})
    cloth = {"nodes": nodes, "faces": motion.faces, "times": motion.times}
    write_npz(folder / "truth" / "cloth.npz", compressed=False, **cloth)


def _holding(robot: Robot, held: Floats) -> Floats:
    """Return joint angles [T, J] [rad] with which the gripper holds the cloth, pointing down if possible.

    Args:
        held: [T, 3] grasp points in the world [m].

    Raises:
        RobotError: the path is out of reach.
    """
    x, y, _ = held.mean(axis=0)
    sideways = np.array([y, -x, 0.0]) / np.hypot(x, y)

    def leaning(degrees: float) -> Floats:
        rotation = Rotation.from_rotvec(np.radians(degrees) * sideways).as_matrix() @ _DOWN
        return robot.inverse_kinematics(held - _GRASP_M * rotation[:, 2], rotations=rotation)

    for degrees in _LEANS_DEG[:-1]:
        with contextlib.suppress(RobotError):
            return leaning(degrees)
    return leaning(_LEANS_DEG[-1])


class _Scene:
    """Ray-casting scene of cloth, arm and table."""

    def __init__(
        self,
        robot: Robot,
        faces: NDArray[np.int64],
        table: SurfaceMesh,
        settings: RecorderSettings,
        cloth_color: Floats,
        rng: np.random.Generator,
    ) -> None:
        self._robot, self._faces, self._settings = robot, faces, settings
        self._arm = RobotMask(lookalike(robot, rng, largest_growth_m=settings.largest_growth_m), robot_margin_m=0.0)
        self._table = caster([table])
        self._colors = _COLORS.copy()
        self._colors[CLOTH] = cloth_color
        self._grain = rng.normal(size=(64, 64))

    def place(self, nodes: Floats, poses: Floats) -> None:
        """Move cloth [V, 3] and links [L, 4, 4]."""
        self._poses = poses
        loose = [SurfaceMesh(nodes, self._faces)]
        if self._settings.with_cable:
            loose.append(cable(self._robot, poses))
        self._loose = caster(loose)  # rebuilt for each frame, unlike the structures of links and table

    def render(self, view: View, rng: np.random.Generator) -> tuple[Floats, NDArray[np.uint16], NDArray[np.uint8]]:
        """Return (z-depth [H, W] [m], labels [H, W], colour [H, W, 3])."""
        table, _, _ = _cast(self._table, view, np.zeros(3), view.directions)
        loose, which, normal = _cast(self._loose, view, np.zeros(3), view.directions)
        arm = self._arm.surface(view, self._poses).astype(np.float64)
        depth = np.minimum(np.minimum(table, loose), arm)
        labels = np.full(depth.shape, NOTHING, dtype=np.uint16)
        labels[np.isfinite(table) & (table <= depth)] = TABLE
        labels[np.isfinite(depth) & (arm <= depth)] = ROBOT
        front = np.isfinite(depth) & (loose <= depth)
        labels[front] = np.where(which[front] == 0, CLOTH, ROBOT)
        color = self._colors[labels]
        color[front & (labels == ROBOT)] = _CABLE_COLOR
        cloth = labels == CLOTH
        lambert = np.abs(normal[cloth] @ _LIGHT)  # a cloth has two sides
        color[cloth] *= (0.55 + 0.45 * lambert)[:, None]
        row, column = np.indices(depth.shape)
        color *= (1 + 0.03 * self._grain[row % 64, column % 64])[..., None]
        noisy = color + _COLOR_NOISE * rng.standard_normal(color.shape)
        return depth, labels, np.clip(np.rint(noisy), 0, 255).astype(np.uint8)

    def hidden(self, camera: DepthCamera, depth_m: Floats, labels: NDArray[np.uint16]) -> NDArray[np.bool_]:
        """Return pixels [H, W] whose point is occluded from one of the camera's imagers."""
        view = camera.view
        seen = (labels == CLOTH) | (labels == TABLE)  # occluded robot pixels would still be robot
        points = view.directions[seen] * depth_m[seen][:, None]
        lost = np.zeros(len(points), dtype=bool)
        for x in camera.imager_offsets_m:
            eye = np.array([x, 0.0, 0.0])
            between, _, _ = _cast(self._loose, view, eye, points - eye)
            lost |= between < 1 - _SAME
            free = np.flatnonzero(~lost)
            lost[free] = self._arm.hides(points[free], view.T_world_camera, self._poses, eye=eye.tolist())
        hidden = np.zeros(depth_m.shape, dtype=bool)
        hidden[seen] = lost
        return hidden


def caster(meshes: Sequence[SurfaceMesh]) -> Any:
    """Return a ray-casting structure of meshes in the world."""
    open3d = import_open3d()
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    for mesh in meshes:
        scene.add_triangles(mesh.nodes.astype(np.float32), mesh.faces.astype(np.uint32))
    return scene


def _cast(scene: Any, view: View, eye: Floats, directions: Floats) -> tuple[Floats, NDArray[np.uint32], Floats]:
    """Return (first hit in lengths of `directions` [..., 3], index of the mesh, its normal in the world).

    Args:
        eye: [3] origin of the rays, in the camera's frame like the directions.
    """
    pose = view.T_world_camera
    bundle = np.empty((*directions.shape[:-1], 6), dtype=np.float32)
    bundle[..., :3] = transform(pose, eye[None])[0]
    bundle[..., 3:] = rotate(pose, directions)
    hit = scene.cast_rays(bundle, nthreads=1)
    return hit["t_hit"].numpy().astype(np.float64), hit["geometry_ids"].numpy(), hit["primitive_normals"].numpy()


def _table(motion: ClothMotion, settings: RecorderSettings) -> SurfaceMesh:
    half = 0.5 * np.array(settings.table_size_m)
    x, y, z = settings.placement.to_world(np.array([0.0, 0.0, motion.table_height]))
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half + [x, y]
    return SurfaceMesh(np.column_stack([corners, np.full(4, z)]), np.array([[0, 1, 2], [0, 2, 3]]))


def _motion(millimetres: float, degrees: float, nodes: Floats, rng: np.random.Generator) -> Floats:
    """Return a random transform [4, 4] with a rotation about the scene's centre and a shift of these sizes."""
    turn_axis, direction = rng.normal(size=(2, 3))
    middle, found = nodes.reshape(-1, 3).mean(axis=0), np.eye(4)
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * turn_axis / np.linalg.norm(turn_axis)).as_matrix()
    found[:3, :3] = turn
    found[:3, 3] = middle - turn @ middle + 1e-3 * millimetres * direction / np.linalg.norm(direction)
    return found


def _misplaced(settings: RecorderSettings, nodes: Floats, rng: np.random.Generator) -> ScenePlacement:
    """Return the stated placement, rotated about the cloth's centre and shifted on the table, in random directions."""
    stated, (millimetres, degrees) = settings.placement, settings.placement_error
    way, sign = (
        rng.uniform(0.5 * np.pi, 1.5 * np.pi),
        rng.choice([-1.0, 1.0]),
    )  # only towards the arm, whose reach is limited
    turned = replace(stated, yaw_rad=stated.yaw_rad + sign * np.deg2rad(degrees))
    middle = nodes[0].mean(axis=0)
    shift = stated.to_world(middle) - turned.to_world(middle)
    shift += 1e-3 * millimetres * np.array([np.cos(way), np.sin(way), 0.0])
    return replace(turned, origin_m=tuple(np.array(stated.origin_m) + shift))


def _write_log(writer: RawEpisodeWriter, robot: Robot, times: Floats, joints: Floats, settings: RecorderSettings) -> None:
    """Write the joint log at its own rate. Each row has the arm's state `clock_offset_s` before the row's time.

    The motion is interpolated smoothly between images, and at rest before the first and after the last.

    Args:
        times: [T] times of the images [s].
        joints: [T, J] joint angles at these times [rad].
    """
    start, end = times[0] - _BEFORE_S, times[-1] + _BEFORE_S
    clock = start + np.arange(int(np.ceil((end - start) * settings.joint_rate_hz)) + 1) / settings.joint_rate_hz
    continuous = np.unwrap(joints, axis=0)
    true_times = np.clip(clock - settings.clock_offset_s, times[0], times[-1])
    if len(times) > 1:
        from scipy.interpolate import CubicSpline  # slow to import

        logged = CubicSpline(times, continuous, bc_type="clamped")(true_times)
    else:
        logged = np.repeat(continuous, len(clock), axis=0)
    tool = robot.tool_pose(logged)
    quaternion = Rotation.from_matrix(tool[:, :3, :3]).as_quat(scalar_first=True)
    for row in range(len(clock)):  # a file is written row by row
        writer.add_robot(RobotSample(clock[row], logged[row], _GRIPPER_CLOSED, tool[row, :3, 3], quaternion[row]))
