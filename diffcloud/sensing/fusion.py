"""Fusion of a raw episode into clouds of the cloth: unproject depth, remove robot and table, merge the views.

All steps use the robot's base frame; the last one transforms points and gripper to the scene's frame. The table plane
is fitted separately for each camera, so that a calibration error of millimetres does not matter. Points clearly above
the plane are kept. Points within the plane's noise are kept only if their colour differs from the table's. So cloth
that lies flat is found by its colour.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from diffcloud.errors import EpisodeError
from diffcloud.io.calibrations import Calibration, read_calibration
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.episodes import Episode, Pinhole
from diffcloud.io.raw_episodes import CameraInfo, RawCamera, RawEpisode, ScenePlacement
from diffcloud.sensing.cameras import inverse, project, rays, transform
from diffcloud.sensing.filters import in_large_clusters
from diffcloud.sensing.masking import RobotMask, Spoilt, View, joints_at, spoilt_pixels
from diffcloud.sensing.refinement import Sight, refine_extrinsics
from diffcloud.sensing.robust import deviation
from diffcloud.sensing.smoothing import smooth_depth
from diffcloud.sensing.tool_poses import turning

Floats = NDArray[np.float64]
Box = tuple[tuple[float, float, float], tuple[float, float, float]]

_OVERLAP_M = 0.03
"""Points of two views overlap if they are closer than this [m]."""
_STEEPEST = 0.94
"""Cosine of the largest tilt of a table, 20 degrees."""
_TABLE_POINTS = 4000
_TABLE_TRIALS = 300
_TABLE_FRAMES = 5
_ON_TABLE_M = 0.005
_REFINED_FRAMES = 10
_REFINED_POINTS = 1000
_DEEPEST_M = 0.03
"""Points farther below the plane than this [m] do not belong to the table."""
_CLEAR_DEVIATIONS = 4.0
"""Clearance above the table, in standard deviations of its heights. Only 3 in 100,000 table points are higher."""
_MOST_CLEARANCE_M = 0.02
"""Maximum clearance [m]. A larger spread may come from a lower object beside the table."""
_LEAST_TABLE = 0.15
"""A plane is accepted as the table if it contains at least this fraction of the points."""


@dataclass(frozen=True)
class FusionSettings:
    """Settings of the fusion of raw episodes."""

    workspace_m: Box = ((0.3, -0.5, -0.05), (1.0, 0.5, 0.7))
    """Lowest and highest corner of a box in the base frame. Points outside are dropped."""
    imager_offsets_m: tuple[float, ...] = (0.015, 0.065)
    """See `masking.spoilt_pixels`."""
    depth_jump_m: float = 0.02
    clock_offset_s: float = 0.0
    """Offset of the joint log's times: logged time minus true time."""
    table: bool = True
    """Fit the table plane and remove its points."""
    clearance_m: float = 0.006
    """Points higher above the plane than this are kept whatever their colour, and points deeper below it are removed.
    If four standard deviations of the table's heights are more, that applies, up to 2 cm."""
    color_difference: float = 30.0
    """Points within the clearance are kept if any colour channel differs from the table's by more than this, of 255."""
    smoothing_px: int = 2
    """Radius of the depth smoothing (`smoothing`); 0: none."""
    cluster_gap_m: float = 0.03
    """Minimum distance between clusters of the merged cloud; 0: keep all clusters."""
    min_cluster_fraction: float = 0.05
    """Clusters with fewer points than this fraction of the largest cluster are removed."""
    subpixel_px: float = 0.08
    """Standard deviation of the stereo disparity, in pixels of the camera's infrared imagers."""
    imager_focal_px: float = 425.0
    """Focal length of the infrared imagers, whatever the image's size: a D435's at 848 columns."""
    baseline_m: float = 0.05
    refine: bool = True
    """Refine the other cameras' poses relative to the first one's from the recording (`refinement`)."""
    placement: ScenePlacement | None = None
    """Pose of the scene in the base frame; None: as episode.json states."""

    @property
    def sigma_per_m(self) -> float:
        """Standard deviation of inverse depth [1/m], the same at all distances: σ_z = z² σ_px / (f · baseline)."""
        return self.subpixel_px / (self.imager_focal_px * self.baseline_m)


@dataclass(frozen=True)
class Seen:
    """Remaining points of one image, in the base frame."""

    image: int
    """Index of the image in its camera's sequence."""
    points: Floats
    pixels: NDArray[np.int64]
    colors: NDArray[np.uint8] | None
    depth_m: Floats
    spoilt: Spoilt
    measured: int
    """Number of valid pixels in the workspace."""
    lost: NDArray[np.bool_]
    """[H, W] pixels in which the camera could not have seen cloth."""

    def select(self, kept: NDArray[np.bool_]) -> Seen:
        """Return the points selected by a mask [P]."""
        return replace(
            self,
            points=self.points[kept],
            pixels=self.pixels[kept],
            colors=None if self.colors is None else self.colors[kept],
            depth_m=self.depth_m[kept],
        )


@dataclass(frozen=True)
class Table:
    """Plane of the table, and its colour."""

    normal: Floats
    """[3] unit normal, pointing upwards."""
    offset: float
    """normal · p = offset on the plane [m]."""
    color: Floats | None
    """[3] median, 0..255; None without colour images."""
    deviation: float
    """Standard deviation of the heights of its points [m], from remaining noise and unevenness."""

    def height(self, points: Floats) -> Floats:
        """Return heights [...] of points [..., 3] above the plane [m]."""
        return points @ self.normal - self.offset


def fuse(
    raw: RawEpisode,
    mask: RobotMask | None,
    settings: FusionSettings,
    *,
    calibration: Calibration | None = None,
    tell: Callable[[int, str], None] = lambda done, text: None,
    watch: Callable[[int, Mapping[str, Seen]], None] = lambda frame, parts: None,
) -> Episode:
    """Return the clouds of a raw episode in the scene's frame, with camera, pixel and depth uncertainty of each point.

    Frame times are those of the first camera. Each other camera contributes its image nearest in time, if it is within
    half a frame interval.

    Args:
        mask: mask of the robot; None keeps its points.
        calibration: poses by serial number. Default: those in camera.json, or in the file it names.
        tell: progress callback with (frames done, text).
        watch: callback with each frame and the remaining points of each camera's image.

    Returns:
        An episode. Its meta has `viewpoints` (camera -> position in the scene) and `quality`, with values per frame:
            `points_per_view` and `masked_fraction` by camera, and `overlap_m` (median distance from the second view's
            points to the first's where they overlap, or None). `refinement` in `quality` has the refined poses, the
            arm's excess thickness and the log's clock offset.

    Raises:
        EpisodeError: a mask is given without a robot log, the log does not cover the video, a camera is not calibrated,
            an image has no depth, or no point of a frame remains.
    """
    if mask is not None and raw.robot is None:
        raise EpisodeError("The recording has no joint log (robot.csv), so the robot cannot be masked: go without a mask.")
    views = {
        name: View(camera.info.intrinsics, camera_pose(camera.info, raw.folder, calibration))
        for name, camera in raw.cameras.items()
    }
    cameras, quality = _Cameras(raw, views, mask, settings), _Quality(list(raw.cameras))
    if settings.refine and len(raw.cameras) > 1:
        tell(0, "refining the cameras' places")
        arm = None if mask is None else RobotMask(mask.robot, robot_margin_m=0.0)
        found = refine_extrinsics(
            raw, views, arm, cameras.sight(), sigma_per_m=settings.sigma_per_m, clock_offset_s=settings.clock_offset_s
        )
        quality.figures["refinement"] = {
            "shift_m": {name: round(shift, 6) for name, shift in found.shift_m.items()},
            "T_world_camera": {name: pose.tolist() for name, pose in found.T_world_camera.items()},
            "skin_m": round(found.skin_m, 6),
            "clock_offset_s": round(found.clock_offset_s, 6),
            "lag_sigma_s": round(found.lag_sigma_s, 6),
        }
        settings = replace(settings, clock_offset_s=found.clock_offset_s)
        views = {name: replace(view, T_world_camera=found.T_world_camera[name]) for name, view in views.items()}
        cameras = _Cameras(raw, views, mask, settings)
    frames = []
    for index in range(len(cameras.times)):  # images are read one after the other
        parts = cameras.cloth(index)
        if not sum(len(part.points) for part in parts.values()):
            seen = ", ".join(
                f"{name}: {part.measured} in the workspace, {int(part.spoilt.any.sum())} of them masked"
                for name, part in parts.items()
            )
            raise EpisodeError(
                f"Frame {index}: no point is left ({seen}; the rest was table). Check the workspace box "
                f"{settings.workspace_m}, the calibration, and the table's clearance, at least {settings.clearance_m:g} m."
            )
        quality.add(parts)
        watch(index, parts)
        frames.append(parts)
        tell(index + 1, f"frame {index}")
    return _episode(raw, views, frames, mask, quality, settings)


class _Cameras:
    """Cameras of a recording with their poses, robot masks and table planes."""

    def __init__(
        self, raw: RawEpisode, views: Mapping[str, View], mask: RobotMask | None, settings: FusionSettings
    ) -> None:
        self._raw, self._views, self._mask, self._settings = raw, views, mask, settings
        self.times = next(iter(raw.cameras.values())).times
        """[T] frame times, those of the first camera."""
        self._poses: dict[str, Floats] = {}
        if mask is not None and raw.robot is not None:  # for all images of a camera at once
            self._poses = {
                name: mask.robot.forward_kinematics(
                    mask.robot.configuration(*joints_at(raw.robot, camera.times, clock_offset_s=settings.clock_offset_s))
                )
                for name, camera in raw.cameras.items()
            }
        self._samples: dict[str, list[tuple[Floats, NDArray[np.uint8] | None]]] = {}
        self._tables: dict[str, Table | None] = dict.fromkeys(raw.cameras)
        if settings.table:
            for name, camera in raw.cameras.items():
                chosen = _spread(len(camera.frames), _TABLE_FRAMES)
                self._samples[name] = [_sample(self._cloud(name, index)) for index in chosen]
                self._tables[name] = fit_table(self._samples[name])

    def cloth(self, frame: int) -> dict[str, Seen]:
        """Return the cloth points in each camera's image of a frame. Cameras without a near image are omitted."""
        parts = {
            name: _without_table(self._cloud(name, index), self._tables[name], self._settings)
            for name, index in self._images(frame).items()
        }
        return _without_scraps(parts, self._settings)

    def sight(self) -> Sight:
        """Return the points of a few frames, for the refinement of the poses.

        Raises:
            EpisodeError: no frame has an image of every camera.
        """
        whole = [frame for frame in range(len(self.times)) if len(self._images(frame)) == len(self._views)]
        if not whole:
            raise EpisodeError(
                f"There is no frame in which all cameras ({', '.join(self._views)}) have an image, so their places cannot "
                "be compared. Are they on one clock (timestamps.csv)? Otherwise switch the refinement off, or leave a "
                "camera out."
            )
        frames = [whole[place] for place in _spread(len(whole), _REFINED_FRAMES)]
        images = [self._images(frame) for frame in frames]
        parts = [self.cloth(frame) for frame in frames]
        to_camera = {name: inverse(view.T_world_camera) for name, view in self._views.items()}
        return Sight(
            frames={name: [image[name] for image in images] for name in self._views},
            cloth={
                name: [transform(to_camera[name], _few(part[name].points, _REFINED_POINTS)) for part in parts]
                for name in self._views
            },
            table={name: transform(to_camera[name], self._on_table(name)) for name in self._views},
        )

    def _on_table(self, name: str) -> Floats:
        table = self._tables[name]
        if table is None:
            return np.zeros((0, 3))
        points = np.concatenate([sample for sample, _ in self._samples[name]])
        return _few(points[np.abs(table.height(points)) < _ON_TABLE_M], _TABLE_POINTS)

    def _images(self, frame: int) -> dict[str, int]:
        """Return the index of each camera's nearest image, if it is within half a frame interval."""
        time, near = self.times[frame], {}
        for name, camera in self._raw.cameras.items():
            index = int(np.abs(camera.times - time).argmin())
            if abs(camera.times[index] - time) <= 0.5 * _interval(camera.times) + 1e-6:
                near[name] = index
        return near

    def _cloud(self, name: str, index: int) -> Seen:
        placed = self._poses[name][index] if self._poses else None
        return _cloud(self._raw.cameras[name], index, self._views[name], self._mask, placed, self._settings)


def fit_table(samples: list[tuple[Floats, NDArray[np.uint8] | None]]) -> Table | None:
    """Return the largest level plane in points of several images; None if it contains too few of them.

    RANSAC tests one set of trials at once. Two least-squares fits to the points within 5 mm follow.

    Args:
        samples: (points [N, 3] [m], colours [N, 3] or None) of each image.
    """
    points = np.concatenate([sample for sample, _ in samples])
    if len(points) < 100:
        return None
    rng = np.random.default_rng(0)
    few = points[rng.permutation(len(points))[:_TABLE_POINTS]]
    a, b, c = few[rng.integers(0, len(few), (3, _TABLE_TRIALS))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    normal = normal / np.maximum(length, 1e-12)[:, None]
    level = (np.abs(normal[:, 2]) > _STEEPEST) & (length > 1e-6)
    if not level.any():
        return None
    near = np.abs(few @ normal[level].T - (normal * a).sum(axis=1)[level]) < _ON_TABLE_M
    best = near.sum(axis=0).argmax()
    if near[:, best].mean() < _LEAST_TABLE:
        return None
    up, offset = normal[level][best], float((normal * a).sum(axis=1)[level][best])
    for _ in range(2):
        held = points[np.abs(points @ up - offset) < _ON_TABLE_M]
        centre = held.mean(axis=0)
        up = np.linalg.svd(held - centre, full_matrices=False)[2][2]
        offset = float(centre @ up)
    up, offset = (up, offset) if up[2] > 0 else (-up, -offset)
    heights = points @ up - offset
    under = heights[(heights < 0) & (heights > -_DEEPEST_M)]  # only table points lie below the plane
    spread = deviation(under) if len(under) else 0.0
    colors = [color[np.abs(sample @ up - offset) < _ON_TABLE_M] for sample, color in samples if color is not None]
    color = np.median(np.concatenate(colors), axis=0) if colors and sum(map(len, colors)) else None
    return Table(up, offset, color, spread)


def _cloud(
    camera: RawCamera, index: int, view: View, mask: RobotMask | None, poses: Floats | None, settings: FusionSettings
) -> Seen:
    depth_m: Floats = camera.depth(index).astype(np.float64) * camera.info.depth_scale_m
    if depth_m.shape != view.directions.shape[:2]:
        raise EpisodeError(
            f"{camera.info.name}, frame {index}: the image is {depth_m.shape[1]} x {depth_m.shape[0]}, camera.json states "
            f"{view.intrinsics.width} x {view.intrinsics.height}."
        )
    if not depth_m.any():
        raise EpisodeError(
            f"{camera.info.name}, frame {index}: 0 valid depth (every pixel is 0): lens covered, or the stream was off. "
            "Leave the frame out."
        )
    world = transform(view.T_world_camera, (view.directions * depth_m[..., None]).reshape(-1, 3)).reshape(*depth_m.shape, 3)
    within = depth_m > 0
    for axis, (low, high) in enumerate(zip(*settings.workspace_m, strict=True)):
        within &= (world[..., axis] >= low) & (world[..., axis] <= high)
    spoilt = spoilt_pixels(
        depth_m,
        view,
        mask,
        poses,
        within=within,
        imager_offsets_m=settings.imager_offsets_m,
        depth_jump_m=settings.depth_jump_m,
        sigma_per_m=settings.sigma_per_m,
    )
    kept, lost = within & ~spoilt.any, (depth_m == 0) | spoilt.any
    if settings.smoothing_px > 0:
        depth_m = smooth_depth(depth_m, kept, settings.smoothing_px, settings.sigma_per_m)
    world = transform(view.T_world_camera, view.directions[kept] * depth_m[kept][:, None])
    row, column = np.nonzero(kept)
    color = camera.color(index)
    colors = None if color is None or color.shape[:2] != depth_m.shape else color[kept]
    return Seen(index, world, np.column_stack([column, row]), colors, depth_m[kept], spoilt, int(within.sum()), lost)


def _spread(count: int, wanted: int) -> list[int]:
    """Return at most `wanted` evenly spaced indices, including the first and the last."""
    return [int(index) for index in np.unique(np.linspace(0, count - 1, wanted).astype(int))] if count else []


def _few(points: Floats, wanted: int) -> Floats:
    """Return about `wanted` of the points [N, 3]."""
    return points[:: max(1, len(points) // wanted)]


def _sample(cloud: Seen) -> tuple[Floats, NDArray[np.uint8] | None]:
    """Subsample a cloud, since a plane fit needs few points."""
    step = max(1, len(cloud.points) // (5 * _TABLE_POINTS))
    return cloud.points[::step], None if cloud.colors is None else cloud.colors[::step]


def _without_table(cloud: Seen, table: Table | None, settings: FusionSettings) -> Seen:
    if table is None:
        return cloud
    height = table.height(cloud.points)
    clearance = max(settings.clearance_m, min(_CLEAR_DEVIATIONS * table.deviation, _MOST_CLEARANCE_M))
    kept = height > clearance
    if cloud.colors is not None and table.color is not None:
        other = np.abs(cloud.colors - table.color).max(axis=1) > settings.color_difference
        kept |= other & (height > -clearance)
    return cloud.select(kept)


def _without_scraps(parts: dict[str, Seen], settings: FusionSettings) -> dict[str, Seen]:
    """Remove small clusters of the merged views, which are remains of table and robot."""
    if settings.cluster_gap_m == 0:
        return parts
    kept = in_large_clusters(
        np.concatenate([part.points for part in parts.values()]), settings.cluster_gap_m, settings.min_cluster_fraction
    )
    ends = np.cumsum([len(part.points) for part in parts.values()])
    return {name: part.select(mine) for (name, part), mine in zip(parts.items(), np.split(kept, ends[:-1]), strict=True)}


class _Quality:
    """Quality figures of each frame."""

    def __init__(self, names: list[str]) -> None:
        self._names = names
        self.figures: dict[str, Any] = {
            "points_per_view": {name: [] for name in names},
            "masked_fraction": {name: [] for name in names},
            "overlap_m": [],
        }

    def add(self, parts: dict[str, Seen]) -> None:
        for name in self._names:
            part = parts.get(name)
            self.figures["points_per_view"][name].append(0 if part is None else len(part.points))
            masked = None if part is None else round(float(part.spoilt.any.sum()) / max(1, part.measured), 6)
            self.figures["masked_fraction"][name].append(masked)
        clouds = [parts[name].points for name in self._names[:2] if name in parts]
        self.figures["overlap_m"].append(_overlap(*clouds) if len(clouds) == 2 else None)


def _overlap(first: Floats, second: Floats) -> float | None:
    if not len(first) or not len(second):
        return None
    distance, _ = cKDTree(first).query(second, distance_upper_bound=_OVERLAP_M)
    near = distance[np.isfinite(distance)]
    return round(float(np.median(near)), 6) if len(near) else None


def _episode(
    raw: RawEpisode,
    views: Mapping[str, View],
    frames: list[dict[str, Seen]],
    mask: RobotMask | None,
    quality: _Quality,
    settings: FusionSettings,
) -> Episode:
    names = list(raw.cameras)
    parts = [(names.index(name), part) for frame in frames for name, part in frame.items()]
    sizes = [sum(len(part.points) for part in frame.values()) for frame in frames]
    placement = settings.placement or raw.placement
    times = raw.cameras[names[0]].times
    tool, turned = _tool(raw, times, mask, settings)
    labels = {
        key: raw.description[key] for key in ("scenario", "fabric", "category", "repeat", "truth") if key in raw.description
    }
    return Episode(
        points=placement.to_scene(np.concatenate([part.points for _, part in parts])).astype(np.float32),
        offsets=np.cumsum([0, *sizes], dtype=np.int64),
        times=times - times[0],
        gripper=None if tool is None else placement.to_scene(tool)[:, None],
        camera=np.concatenate([np.full(len(part.points), index, dtype=np.uint8) for index, part in parts]),
        pixel=np.concatenate([part.pixels for _, part in parts]).astype(np.uint16),
        sigma=np.concatenate([part.depth_m**2 * settings.sigma_per_m for _, part in parts]).astype(np.float32),
        lost=_lost(names, views, frames),
        meta={
            **labels,
            "source": "raw episode",
            "cameras": names,
            "viewpoints": {name: placement.to_scene(views[name].T_world_camera[:3, 3]).tolist() for name in names},
            "pinholes": {name: _pinhole(views[name], placement).described() for name in names},
            "quality": {**quality.figures, "warnings": [] if turned is None else [turned]},
        },
    )


def _lost(names: Sequence[str], views: Mapping[str, View], frames: Sequence[Mapping[str, Seen]]) -> NDArray[np.uint8]:
    """Return the packed invalid-pixel masks [T, C, bytes] of an episode. All pixels of a missing image are invalid."""
    most = max(view.intrinsics.width * view.intrinsics.height for view in views.values())
    lost = np.ones((len(frames), len(names), most), dtype=bool)
    for camera, name in enumerate(names):
        column, row = _ideal_pixels(views[name].intrinsics)
        for index, frame in enumerate(frames):  # images came one after the other
            if name in frame:
                seen = np.pad(frame[name].lost, 1, constant_values=True)  # pixels outside the image are invalid
                lost[index, camera, : row.size] = seen[row + 1, column + 1]
    return np.packbits(lost, axis=-1)


def _ideal_pixels(intrinsics: Intrinsics) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return (column, row) [H W] of the pixels with the same rays as the pixels of an undistorted camera; -1 or the
    image's size outside the image."""
    row, column = np.mgrid[: intrinsics.height, : intrinsics.width].reshape(2, -1)
    straight = rays(np.column_stack([column, row]), replace(intrinsics, distortion="none", coefficients=()))
    found = project(straight, intrinsics).round()
    column, row = np.clip(found, -1, [intrinsics.width, intrinsics.height]).astype(np.int64).T
    return column, row


def _pinhole(view: View, placement: ScenePlacement) -> Pinhole:
    """Return an undistorted camera model in the scene's frame."""
    told = view.intrinsics
    eye = placement.to_scene(view.T_world_camera[:3, 3])
    axes = view.T_world_camera[:3, :3].T @ placement.rotation.T
    pose = np.column_stack([axes, -axes @ eye])
    return Pinhole(told.width, told.height, (told.fx, told.fy), (told.cx, told.cy), pose)


def _tool(
    raw: RawEpisode, times: Floats, mask: RobotMask | None, settings: FusionSettings
) -> tuple[Floats | None, str | None]:
    """Return tool positions [T, 3] in the base frame, and a warning if they may differ from the fingertips. Positions
    are those that the arm reported, else those of the joints, else None."""
    log = raw.robot
    if log is None or not len(log.times):
        return None, None
    if np.isfinite(log.tool_position_m).all():
        clock = log.times - settings.clock_offset_s
        track = np.stack([np.interp(times, clock, column) for column in log.tool_position_m.T], axis=1)
        return track, turning(log.tool_quaternion)
    if mask is not None:
        poses = mask.robot.tool_pose(joints_at(log, times, clock_offset_s=settings.clock_offset_s)[0])
        return poses[:, :3, 3], turning(Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True))
    return None, None


def camera_pose(info: CameraInfo, folder: Path, calibration: Calibration | None) -> Floats:
    """Return T_world_camera [4, 4] of a camera of a raw episode; by default that in its camera.json.

    Raises:
        EpisodeError: there is no calibration, and camera.json has neither a pose nor a calibration file.
        CalibrationError: the calibration is unreadable or lacks this camera.
    """
    if calibration is None and info.calibration is not None:
        calibration = read_calibration(folder / info.calibration)
    if calibration is not None:
        return calibration.camera(info.serial, name=info.name).T_world_camera
    if info.T_world_camera is None:
        raise EpisodeError(
            f"Camera {info.name} is not calibrated: camera.json has neither T_world_camera nor a calibration file. Run "
            "diffcloud data calibrate, and give its file with --calibration."
        )
    return info.T_world_camera


def _interval(times: Floats) -> float:
    return float(np.median(np.diff(times))) if len(times) > 1 else 1.0
