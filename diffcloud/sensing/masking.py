"""Masks of the pixels of a depth image that show the robot or are corrupted by it.

The links' surfaces are inflated by a margin, which covers errors of calibration, robot model and clock, and rendered
into the camera. Measurements at or behind that surface are robot. Stereo needs both imagers: a point that the robot
occludes from one of them is in its occlusion shadow, where depth is unreliable. At borders, stereo may average
foreground and background. Such flying pixels are detected by their few neighbours of similar depth.

Each link has its own ray-casting structure, built once in the link's frame. For each frame the rays are transformed
instead of the triangles, and only pixels whose rays can hit the link are cast. (Rebuilding one structure of all links
takes four times as long per frame.)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.clouds import import_open3d
from diffcloud.io.raw_episodes import RobotLog
from diffcloud.io.urdf import LinkMesh, joined
from diffcloud.sensing.cameras import inverse, rays, rotate, transform
from diffcloud.sensing.robot import Robot

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LONGEST_MITRE = 2.0
"""Maximum displacement of a vertex, in margins; a box's corner needs 1.73."""
_NEAREST_M = 0.01
_OUTSIDE_S = 0.1
"""The joint log may end this much [s] before the images do; the last joints are then held."""
_FEWEST_SUPPORTING = 3
_NOISE_DEVIATIONS = 2.0


@dataclass(frozen=True)
class View:
    """A camera's intrinsics and pose."""

    intrinsics: Intrinsics
    T_world_camera: Floats
    """[4, 4] maps camera points to world points [m]."""

    @cached_property
    def directions(self) -> Floats:
        """[H, W, 3] rays with z = 1 through the pixels."""
        row, column = np.mgrid[: self.intrinsics.height, : self.intrinsics.width]
        return rays(np.stack([column, row], axis=-1).astype(np.float64), self.intrinsics)

    @cached_property
    def _columns(self) -> Floats:
        """[2, W] smallest and largest x of the rays of each column."""
        return np.stack([self.directions[..., 0].min(axis=0), self.directions[..., 0].max(axis=0)])

    @cached_property
    def _rows(self) -> Floats:
        """[2, H] smallest and largest y of the rays of each row."""
        return np.stack([self.directions[..., 1].min(axis=1), self.directions[..., 1].max(axis=1)])

    def window(self, low: Floats, high: Floats) -> tuple[slice, slice]:
        """Return the rows and columns of all rays with (x, y) between `low` [2] and `high` [2]."""
        rows = np.flatnonzero((self._rows[1] >= low[1]) & (self._rows[0] <= high[1]))
        columns = np.flatnonzero((self._columns[1] >= low[0]) & (self._columns[0] <= high[0]))
        if not len(rows) or not len(columns):
            return slice(0, 0), slice(0, 0)
        return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


class RobotMask:
    """A robot's inflated surface, prepared for ray casting.

    Args:
        robot_margin_m: margin [m] around every link, or by link; links without an entry have none.
    """

    def __init__(self, robot: Robot, *, robot_margin_m: float | Mapping[str, float] = 0.01) -> None:
        self.robot = robot
        self._indices: list[int] = []
        """Indices of the links that have a surface."""
        self._scenes: list[Any] = []
        """Ray-casting scenes of these links."""
        open3d = import_open3d()
        boxes: list[Floats] = []
        for name, mesh in robot.description.meshes.items():
            solid = inflate(mesh, robot_margin_m.get(name, 0.0) if isinstance(robot_margin_m, Mapping) else robot_margin_m)
            scene = open3d.t.geometry.RaycastingScene(nthreads=1)  # threads cost more than they gain on these few rays
            scene.add_triangles(solid.vertices.astype(np.float32), solid.faces.astype(np.uint32))
            ends = np.stack([solid.vertices.min(axis=0), solid.vertices.max(axis=0)])
            corners = np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(8, 3)
            self._indices.append(robot.links.index(name))
            self._scenes.append(scene)
            boxes.append(corners)
        self._corners = np.array(boxes).reshape(-1, 8, 3)
        """Corners of the links' bounding boxes."""

    def surface(self, view: View, poses: Floats) -> NDArray[np.float32]:
        """Return the z-depth [H, W] [m] of the inflated robot; infinite beside it.

        Args:
            poses: [L, 4, 4] T_world_link.
        """
        return self.first_hits(view, poses)[0]

    def first_hits(self, view: View, poses: Floats) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Return z-depth [H, W] [m] of the inflated robot and index of the link [H, W]; infinite and -1 beside it."""
        depth = np.full(view.directions.shape[:2], np.inf, dtype=np.float32)
        link = np.full(depth.shape, -1)
        for index, scene, T_link_camera, low, high in self._placed(view.T_world_camera, poses, np.zeros(3)):
            window = view.window(low, high)
            directions = view.directions[window]
            if directions.size:
                hit = _cast(scene, T_link_camera, np.zeros(3), directions)  # rays have z = 1: their length is z-depth
                nearer = hit < depth[window]
                depth[window][nearer], link[window][nearer] = hit[nearer], index
        return depth, link

    def hides(
        self, points: Floats, T_world_camera: Floats, poses: Floats, *, eye: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> Mask:
        """Return whether the inflated robot occludes or contains points, [N].

        Args:
            points: [N, 3] in the camera's frame [m].
            poses: [L, 4, 4] T_world_link.
            eye: [3] viewpoint in the camera's frame [m].
        """
        from_eye = points - eye
        x, y = np.ascontiguousarray((from_eye[:, :2] / np.maximum(from_eye[:, 2:], _NEAREST_M)).T)
        hidden = np.zeros(len(points), dtype=bool)
        for _, scene, T_link_camera, low, high in self._placed(T_world_camera, poses, np.asarray(eye)):
            near = np.flatnonzero((x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1]) & ~hidden)
            if len(near):
                hidden[near] = _cast(scene, T_link_camera, np.asarray(eye), from_eye[near]) <= 1.0
        return hidden

    def _placed(
        self, T_world_camera: Floats, poses: Floats, eye: Floats
    ) -> Iterator[tuple[int, Any, Floats, Floats, Floats]]:
        """Yield (link, scene, T_link_camera, lowest and highest (x, y) of rays that can hit it) for each link."""
        T_link_camera = inverse(poses[self._indices]) @ T_world_camera
        seen = transform(inverse(T_link_camera), self._corners) - eye
        behind = seen[..., 2] < _NEAREST_M
        plane = seen[..., :2] / np.maximum(seen[..., 2:], _NEAREST_M)
        low, high = plane.min(axis=1), plane.max(axis=1)
        anywhere = behind.any(axis=1)  # its projection is unbounded if it reaches behind the camera
        low[anywhere], high[anywhere] = -np.inf, np.inf
        for row in np.flatnonzero(~behind.all(axis=1)):  # each link has its own search tree
            yield self._indices[row], self._scenes[row], T_link_camera[row], low[row], high[row]


@dataclass(frozen=True)
class Spoilt:
    """Masks [H, W] of one depth image. Pixels without depth are in none of them."""

    robot: Mask
    """At or behind the robot's inflated surface."""
    shadow: Mask
    """Occluded by the robot from one of the camera's imagers."""
    flying: Mask
    """Flying pixels, between foreground and background."""

    @property
    def any(self) -> Mask:
        return self.robot | self.shadow | self.flying


def spoilt_pixels(
    depth_m: NDArray[np.floating[Any]],
    view: View,
    mask: RobotMask | None = None,
    poses: Floats | None = None,
    *,
    within: Mask | None = None,
    imager_offsets_m: Sequence[float] = (0.05,),
    depth_jump_m: float = 0.01,
    sigma_per_m: float = 0.0,
) -> Spoilt:
    """Return the pixels that cannot show cloth because of the robot or a depth border.

    Args:
        depth_m: [H, W] z-depth [m]; 0 is no measurement.
        mask, poses: the robot and its [L, 4, 4] T_world_link; None without a robot.
        within: [H, W] pixels to classify, such as those in the workspace. None: all.
        imager_offsets_m: positions of the other stereo imagers along the image's x [m]. A D435's second one is at 0.05
            from its depth image.
        depth_jump_m: see `flying_pixels`; 0 keeps them.
        sigma_per_m: standard deviation of the inverse depth [1/m]. Measurements in front of the robot within noise are
            robot.
    """
    valid = depth_m > 0 if within is None else (depth_m > 0) & within
    robot, shadow = np.zeros_like(valid), np.zeros_like(valid)
    if mask is not None and poses is not None:
        robot = valid & (depth_m + _NOISE_DEVIATIONS * sigma_per_m * depth_m**2 >= mask.surface(view, poses))
        free = valid & ~robot
        points = view.directions[free] * depth_m[free][:, None]
        hidden = np.zeros(len(points), dtype=bool)
        for x in imager_offsets_m:
            hidden |= mask.hides(points, view.T_world_camera, poses, eye=(x, 0.0, 0.0))
        shadow[free] = hidden
    flying = flying_pixels(depth_m, depth_jump_m) & valid & ~robot & ~shadow if depth_jump_m > 0 else np.zeros_like(valid)
    return Spoilt(robot, shadow, flying)


def flying_pixels(depth_m: NDArray[np.floating[Any]], step_m: float) -> Mask:
    """Return measured pixels [H, W] with fewer than 3 of 8 neighbours within `step_m` in depth."""
    padded = np.pad(depth_m, 1)
    height, width = depth_m.shape
    supporting = np.zeros(depth_m.shape, dtype=np.uint8)
    for row, column in ((r, c) for r in range(3) for c in range(3) if (r, c) != (1, 1)):  # eight shifted images
        neighbour = padded[row : row + height, column : column + width]
        supporting += (neighbour > 0) & (np.abs(neighbour - depth_m) <= step_m)
    return (depth_m > 0) & (supporting < _FEWEST_SUPPORTING)


def inflate(mesh: LinkMesh, margin_m: float) -> LinkMesh:
    """Return the surface with every face moved outwards by `margin_m`, joined with the original; a negative margin
    gives only the moved surface.

    Vertices move along the mean normal of their faces, farther at edges, so that the faces move by the whole margin.
    The original is kept because a scanned mesh may have faces with wrong orientation.
    """
    if margin_m == 0:
        return mesh
    moved = offset(mesh, margin_m)
    return joined([mesh, moved]) if margin_m > 0 else moved


def offset(mesh: LinkMesh, margin_m: float) -> LinkMesh:
    """Return the surface moved outwards by `margin_m` (inwards if negative), with equal vertices merged."""
    corner, same = np.unique(np.round(mesh.vertices, 7), axis=0, return_inverse=True)  # STL repeats its vertices
    faces = same.reshape(-1)[mesh.faces]
    normal = np.cross(corner[faces[:, 1]] - corner[faces[:, 0]], corner[faces[:, 2]] - corner[faces[:, 0]])
    length = np.linalg.norm(normal, axis=1)
    faces, normal = faces[length > 0], normal[length > 0] / length[length > 0, None]
    # weighted by the angle at the vertex, so that how a plane is cut into triangles does not matter
    edge = corner[np.roll(faces, -1, axis=1)] - corner[faces]
    edge /= np.maximum(np.linalg.norm(edge, axis=2, keepdims=True), 1e-12)
    angle = np.arccos(np.clip(-(edge * np.roll(edge, 1, axis=1)).sum(axis=2), -1.0, 1.0))
    mean = np.zeros_like(corner)
    np.add.at(mean, faces, angle[..., None] * normal[:, None])
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    cosine = np.ones(len(corner))
    np.minimum.at(cosine, faces, (mean[faces] * normal[:, None]).sum(axis=2))
    return LinkMesh(corner + margin_m * mean / np.maximum(cosine, 1 / _LONGEST_MITRE)[:, None], faces)


def joints_at(log: RobotLog, times: Floats, *, clock_offset_s: float = 0.0) -> tuple[Floats, Floats]:
    """Interpolate the joint log at image times: joints [T, J] [rad], gripper [T] from 0 to 1 or NaN.

    Args:
        times: [T] image times on the true clock [s].
        clock_offset_s: logged time minus true time.

    Raises:
        EpisodeError: the log is empty or does not cover the images.
    """
    if not len(log.times):
        raise EpisodeError(
            "The joint log is empty; without it the robot cannot be masked. Record again, or go without a mask."
        )
    clock = log.times - clock_offset_s
    if times[0] < clock[0] - _OUTSIDE_S or times[-1] > clock[-1] + _OUTSIDE_S:
        raise EpisodeError(
            f"The joint log covers {clock[0]:.2f} to {clock[-1]:.2f} s, the images {times[0]:.2f} to {times[-1]:.2f} s: "
            "the robot's pose is unknown for some images. Trim the images, import the complete log, or correct the log's "
            "times with --clock-offset."
        )
    continuous = np.unwrap(log.joints_rad, axis=0)  # arms report angles within one turn
    joints = np.stack([np.interp(times, clock, column) for column in continuous.T], axis=1)
    known = np.isfinite(log.gripper)
    if not known.any():
        return joints, np.full(len(times), np.nan)
    return joints, np.interp(times, clock[known], log.gripper[known])


def _cast(scene: Any, T_link_camera: Floats, eye: Floats, directions: Floats) -> NDArray[np.float32]:
    """Return the distance [...] to the first hit in lengths of `directions` [..., 3], from `eye` in the camera's
    frame."""
    bundle = np.empty((*directions.shape[:-1], 6), dtype=np.float32)
    bundle[..., :3] = T_link_camera[:3, :3] @ eye + T_link_camera[:3, 3]
    bundle[..., 3:] = rotate(T_link_camera, directions)
    hit: NDArray[np.float32] = scene.cast_rays(bundle, nthreads=1)["t_hit"].numpy()
    return hit
