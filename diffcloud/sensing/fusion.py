"""From a raw episode to clouds of the cloth alone: depth to points, robot and table taken out, views merged.

Everything happens in the robot's base frame; the last step moves points and gripper into the scene's frame. The table
is a plane fitted for each camera, so that a calibration that is millimetres off does not decide what lies on it. Points
clearly above the plane stay; points within its noise stay where their colour is not the table's: cloth that lies flat
is found by its colour.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from diffcloud.errors import EpisodeError
from diffcloud.io.calibrations import Calibration, read_calibration
from diffcloud.io.episodes import Episode
from diffcloud.io.raw_episodes import CameraInfo, RawCamera, RawEpisode
from diffcloud.sensing.cameras import transform
from diffcloud.sensing.masking import RobotMask, Spoilt, View, joints_at, spoilt_pixels

Floats = NDArray[np.float64]
Box = tuple[tuple[float, float, float], tuple[float, float, float]]

_OVERLAP_M = 0.03
"""Points of two views farther apart than this are not of the same place."""
_STEEPEST = 0.94
"""Cosine of the steepest table, 20 degrees."""
_TABLE_POINTS = 4000
_TABLE_TRIALS = 300
_TABLE_FRAMES = 5
_LEAST_TABLE = 0.15
"""A plane with a smaller part of the points is no table."""


@dataclass(frozen=True)
class FusionSettings:
    """How clouds are made of a raw episode."""

    workspace_m: Box = ((0.3, -0.5, -0.05), (1.0, 0.5, 0.7))
    """Lowest and highest corner in the base frame; what lies outside is dropped."""
    eyes_m: tuple[float, ...] = (0.05,)
    """See `masking.spoilt_pixels`."""
    flying_m: float = 0.01
    lag_s: float = 0.0
    """How much later than the truth the joint log's times are."""
    table: bool = True
    """Fit a plane and take it out."""
    clearance_m: float = 0.006
    """Above the plane by this much a point stays, whatever its colour; so much below, it goes."""
    color_difference: float = 30.0
    """Of 255, in any channel: a point within the clearance that differs more from the table's colour stays."""
    subpixel_px: float = 0.08
    """Deviation of the stereo disparity, for the points' `sigma`."""
    baseline_m: float = 0.05
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The scene's origin in the base frame."""
    yaw_rad: float = 0.0
    """p_scene = Rz(yaw) (p_base - origin) / length_unit."""
    length_unit_m: float = 1.0


@dataclass(frozen=True)
class _Cloud:
    """Points of one camera at one time, in the base frame."""

    points: Floats
    pixels: NDArray[np.int64]
    colors: NDArray[np.uint8] | None
    depth_m: Floats
    spoilt: Spoilt
    measured: int
    """Valid pixels in the workspace."""


@dataclass(frozen=True)
class Table:
    """A plane and the colour of what it is of."""

    normal: Floats
    """[3] unit, upwards."""
    offset: float
    """normal · p = offset on the plane [m]."""
    color: Floats | None
    """[3] median, 0..255; None without colour images."""

    def height(self, points: Floats) -> Floats:
        """[...] of points [..., 3] above the plane [m]."""
        return points @ self.normal - self.offset


def fuse(
    raw: RawEpisode,
    mask: RobotMask | None,
    settings: FusionSettings,
    *,
    calibration: Calibration | None = None,
    tell: Callable[[int, str], None] = lambda done, text: None,
) -> Episode:
    """The clouds of a raw episode in the scene's frame, with camera, pixel and deviation of each point.

    Frames are the first camera's; each other camera adds its image nearest in time, if one is within half a frame.

    Args:
        mask: of the robot; None leaves it in.
        calibration: poses by serial; without it camera.json's own, or the file it names.
        tell: called with (frames done, text).

    Returns:
        An episode whose meta holds `quality`, figures for each frame: `points_per_view` and `masked_fraction` by camera,
        `overlap_m` (median distance of the second view's points to the first's where they overlap; None without any).

    Raises:
        EpisodeError: no robot log though a mask is asked for, a log that does not cover the video, a camera that is not
            calibrated, an image without depth, or a frame of which nothing is left.
    """
    views = {
        name: View(camera.info.intrinsics, _pose(camera.info, raw, calibration)) for name, camera in raw.cameras.items()
    }
    first = next(iter(raw.cameras.values()))
    poses = None
    if mask is not None:
        if raw.robot is None:
            raise EpisodeError(
                "The recording has no joint log (robot.csv), so the robot cannot be masked: go without a mask."
            )
        # of all images of all cameras at once
        poses = {
            name: mask.robot.forward_kinematics(
                mask.robot.configuration(*joints_at(raw.robot, camera.times, lag_s=settings.lag_s))
            )
            for name, camera in raw.cameras.items()
        }

    def cloud(name: str, index: int) -> _Cloud:
        placed = None if poses is None else poses[name][index]
        return _cloud(raw.cameras[name], index, views[name], mask, placed, settings)

    tables: dict[str, Table | None] = dict.fromkeys(raw.cameras)
    if settings.table:
        for name, camera in raw.cameras.items():
            chosen = np.unique(np.linspace(0, len(camera.frames) - 1, _TABLE_FRAMES).astype(int))
            tables[name] = fit_table([_sample(cloud(name, int(index))) for index in chosen])
    frames, quality = [], _Quality(list(raw.cameras))
    for index, time in enumerate(first.times):  # images are read one after the other
        parts = {}
        for name, camera in raw.cameras.items():
            nearest = int(np.abs(camera.times - time).argmin())
            if abs(camera.times[nearest] - time) <= 0.5 * _interval(camera.times) + 1e-6:
                parts[name] = _without_table(cloud(name, nearest), tables[name], settings)
        if not sum(len(part.points) for part in parts.values()):
            seen = ", ".join(
                f"{name}: {part.measured} in the workspace, {int(part.spoilt.any.sum())} of them masked"
                for name, part in parts.items()
            )
            raise EpisodeError(
                f"Frame {index}: no point is left ({seen}; the rest was table). Check the workspace box "
                f"{settings.workspace_m}, the calibration, and the table's clearance of {settings.clearance_m:g} m."
            )
        quality.add(parts)
        frames.append(parts)
        tell(index + 1, f"frame {index}")
    return _episode(raw, frames, views, mask, quality, settings)


def fit_table(samples: list[tuple[Floats, NDArray[np.uint8] | None]]) -> Table | None:
    """The largest level plane among points of several images, or None where none holds a fair part of them.

    RANSAC with one set of trials tested at once, then least squares over what lies within 5 mm, twice.

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
    near = np.abs(few @ normal[level].T - (normal * a).sum(axis=1)[level]) < 0.005
    best = near.sum(axis=0).argmax()
    if near[:, best].mean() < _LEAST_TABLE:
        return None
    up, offset = normal[level][best], float((normal * a).sum(axis=1)[level][best])
    for _ in range(2):
        held = points[np.abs(points @ up - offset) < 0.005]
        centre = held.mean(axis=0)
        up = np.linalg.svd(held - centre, full_matrices=False)[2][2]
        offset = float(centre @ up)
    up, offset = (up, offset) if up[2] > 0 else (-up, -offset)
    colors = [color[np.abs(sample @ up - offset) < 0.005] for sample, color in samples if color is not None]
    return Table(up, offset, np.median(np.concatenate(colors), axis=0) if colors and sum(map(len, colors)) else None)


def _cloud(
    camera: RawCamera, index: int, view: View, mask: RobotMask | None, poses: Floats | None, settings: FusionSettings
) -> _Cloud:
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
    low, high = settings.workspace_m
    within = (depth_m > 0) & ((world >= low) & (world <= high)).all(axis=-1)
    spoilt = spoilt_pixels(depth_m, view, mask, poses, within=within, eyes_m=settings.eyes_m, flying_m=settings.flying_m)
    kept = within & ~spoilt.any
    row, column = np.nonzero(kept)
    color = camera.color(index)
    colors = None if color is None or color.shape[:2] != depth_m.shape else color[kept]
    return _Cloud(world[kept], np.column_stack([column, row]), colors, depth_m[kept], spoilt, int(within.sum()))


def _sample(cloud: _Cloud) -> tuple[Floats, NDArray[np.uint8] | None]:
    """Every few points: a plane needs no more."""
    step = max(1, len(cloud.points) // (5 * _TABLE_POINTS))
    return cloud.points[::step], None if cloud.colors is None else cloud.colors[::step]


def _without_table(cloud: _Cloud, table: Table | None, settings: FusionSettings) -> _Cloud:
    if table is None:
        return cloud
    height = table.height(cloud.points)
    kept = height > settings.clearance_m
    if cloud.colors is not None and table.color is not None:
        other = np.abs(cloud.colors - table.color).max(axis=1) > settings.color_difference
        kept |= other & (height > -settings.clearance_m)
    colors = None if cloud.colors is None else cloud.colors[kept]
    return replace(cloud, points=cloud.points[kept], pixels=cloud.pixels[kept], colors=colors, depth_m=cloud.depth_m[kept])


class _Quality:
    """Figures of each frame."""

    def __init__(self, names: list[str]) -> None:
        self._names = names
        self.figures: dict[str, Any] = {
            "points_per_view": {name: [] for name in names},
            "masked_fraction": {name: [] for name in names},
            "overlap_m": [],
        }

    def add(self, parts: dict[str, _Cloud]) -> None:
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
    frames: list[dict[str, _Cloud]],
    views: dict[str, View],
    mask: RobotMask | None,
    quality: _Quality,
    settings: FusionSettings,
) -> Episode:
    names = list(raw.cameras)
    parts = [(names.index(name), part) for frame in frames for name, part in frame.items()]
    sizes = [sum(len(part.points) for part in frame.values()) for frame in frames]
    per_metre = [
        settings.subpixel_px / (views[names[index]].intrinsics.fx * settings.baseline_m) for index, _ in parts
    ]  # σ_z = z² σ_px / (f · baseline)
    times = raw.cameras[names[0]].times
    labels = {key: raw.description[key] for key in ("scenario", "fabric", "category", "repeat") if key in raw.description}
    return Episode(
        points=to_scene(np.concatenate([part.points for _, part in parts]), settings).astype(np.float32),
        offsets=np.cumsum([0, *sizes], dtype=np.int64),
        times=times - times[0],
        gripper=_gripper(raw, times, mask, settings),
        camera=np.concatenate([np.full(len(part.points), index, dtype=np.uint8) for index, part in parts]),
        pixel=np.concatenate([part.pixels for _, part in parts]).astype(np.uint16),
        sigma=np.concatenate([part.depth_m**2 * factor for factor, (_, part) in zip(per_metre, parts, strict=True)]).astype(
            np.float32
        ),
        meta={**labels, "source": "raw episode", "cameras": names, "quality": quality.figures},
    )


def _gripper(raw: RawEpisode, times: Floats, mask: RobotMask | None, settings: FusionSettings) -> Floats | None:
    """[T, 3] of the tool in the scene's frame: as the arm reported it, else by its joints; None where neither is known."""
    log = raw.robot
    if log is None or not len(log.times):
        return None
    clock = log.times - settings.lag_s
    if np.isfinite(log.tool_position_m).all():
        tool = np.stack([np.interp(times, clock, column) for column in log.tool_position_m.T], axis=1)
    elif mask is not None:
        tool = mask.robot.tool_pose(joints_at(log, times, lag_s=settings.lag_s)[0])[:, :3, 3]
    else:
        return None
    return to_scene(tool, settings)


def to_scene(points: Floats, settings: FusionSettings) -> Floats:
    """Base-frame points [..., 3] [m] in the scene's frame and length unit."""
    c, s = np.cos(settings.yaw_rad), np.sin(settings.yaw_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return (points - np.array(settings.origin_m)) @ turn.T / settings.length_unit_m


def _pose(info: CameraInfo, raw: RawEpisode, calibration: Calibration | None) -> Floats:
    if calibration is None and info.calibration is not None:
        calibration = read_calibration(raw.folder / info.calibration)
    if calibration is not None:
        return calibration.camera(info.serial, name=info.name).T_world_camera
    if info.T_world_camera is None:
        raise EpisodeError(
            f"Camera {info.name} is not calibrated: camera.json has neither T_world_camera nor a calibration file. Run "
            "diffcloud calibrate, and give its file with --calibration."
        )
    return info.T_world_camera


def _interval(times: Floats) -> float:
    return float(np.median(np.diff(times))) if len(times) > 1 else 1.0
