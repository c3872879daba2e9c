"""Checks that the cameras of a raw episode match their calibration."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from diffcloud.errors import CalibrationError, EpisodeError
from diffcloud.io.calibrations import Calibration, read_calibration
from diffcloud.io.images import read_depth
from diffcloud.sensing.cameras import depth_points, transform
from diffcloud.sensing.validation.findings import Finding, RecordedCamera

_SWAP_POINTS = 3000
_PLANES, _FLAT_M = 200, 0.01
"""Number of planes to test, and maximum distance of their points [m]."""
_TILTED_DEG, _LEVEL_DEG = 8.0, 4.0
"""Poses count as exchanged if the table is tilted by more than the first value in both views, and by less than the
second one after exchanging them."""
_SWAP_M = 0.02
"""Poses count as exchanged if the views differ by more than this [m], but agree after exchanging them."""


def _calibration_of(camera: RecordedCamera, folder: Path, calibration: Path | None) -> Calibration | None:
    if calibration is not None:
        return read_calibration(calibration)
    if camera.info is None or camera.info.calibration is None:
        return None
    return read_calibration(folder / camera.info.calibration)


def calibration_findings(camera: RecordedCamera, folder: Path, calibration: Path | None) -> Iterator[Finding]:
    """Yield findings about one camera.

    Args:
        folder: folder of the episode, to which camera.json's calibration file is relative.
        calibration: calibration file to use instead.
    """
    place = f"cameras/{camera.name}/camera.json"
    if camera.info is None:
        return
    try:
        held = _calibration_of(camera, folder, calibration)
        if held is None:
            if camera.info.T_world_camera is None:
                message = (
                    "Not calibrated: neither T_world_camera nor a calibration file says where the camera stands, without "
                    "which there are no clouds. Run diffcloud data calibrate."
                )
                yield Finding("fault", "uncalibrated", place, message)
            return
        entry = held.camera(camera.info.serial, name=camera.name)
    except CalibrationError as error:
        yield Finding("fault", "other_calibration", place, str(error))
        return
    if not entry.intrinsics.same_camera(camera.info.intrinsics):
        yield Finding(
            "fault",
            "other_calibration",
            place,
            f"The calibration of serial {camera.info.serial} has other intrinsics ({_brief(entry)} against "
            f"{_brief(camera.info)}): it was made at another resolution or with another camera.",
        )
    if held.objections:
        yield Finding(
            "warning",
            "forced_calibration",
            place,
            f"The calibration was written by force, although: {' '.join(held.objections)}",
        )
    if entry.name and entry.name != camera.name and any(other.name == camera.name for other in held.cameras.values()):
        yield Finding(
            "fault",
            "swapped_cameras",
            place,
            f"Serial {camera.info.serial} is {entry.name!r} in the calibration, but {camera.name!r} here: the cameras were "
            "swapped when the capture was started. Exchange the folder names, or calibrate again if they were moved.",
        )


def _brief(camera: Any) -> str:
    held = camera.intrinsics
    return f"{held.width} x {held.height}, f {held.fx:.1f}, c ({held.cx:.1f}, {held.cy:.1f})"


def _pose(camera: RecordedCamera, folder: Path, calibration: Path | None) -> NDArray[np.float64] | None:
    if camera.info is None:
        return None
    try:
        held = _calibration_of(camera, folder, calibration)
        if held is not None:
            return held.camera(camera.info.serial).T_world_camera
    except CalibrationError:
        return None
    return camera.info.T_world_camera


def exchanged_cameras(cameras: list[RecordedCamera], folder: Path, calibration: Path | None) -> Iterator[Finding]:
    """Yield findings about exchanged cameras. Poses count as exchanged if two views of one scene agree, or the table is
    level, only with each other's pose. Folders count as exchanged if one holds the camera that another is named
    after."""
    names = {camera.name for camera in cameras}
    for camera in cameras:
        if camera.info is not None and camera.info.name != camera.name and camera.info.name in names:
            yield Finding(
                "fault",
                "swapped_cameras",
                f"cameras/{camera.name}",
                f"camera.json says that this is camera {camera.info.name!r}, which has a folder of its own: the folders "
                "were swapped. Exchange their names.",
            )
    for index, first in enumerate(cameras):
        for second in cameras[index + 1 :]:
            views = (first, second)
            poses = [pose for camera in views if (pose := _pose(camera, folder, calibration)) is not None]
            clouds = [points for camera in views if (points := _first_points(camera)) is not None]
            if len(poses) < 2 or len(clouds) < 2:
                continue
            stated = _disagreement(transform(poses[0], clouds[0]), transform(poses[1], clouds[1]))
            exchanged = _disagreement(transform(poses[1], clouds[0]), transform(poses[0], clouds[1]))
            normals = [_plane(cloud) for cloud in clouds]
            tilts = [_tilt_deg(poses[view], normals[view]) for view in (0, 1)]
            other = [_tilt_deg(poses[1 - view], normals[view]) for view in (0, 1)]
            if min(tilts) > _TILTED_DEG and max(other) < _LEVEL_DEG:
                yield Finding(
                    "fault",
                    "swapped_cameras",
                    f"cameras/{first.name}, cameras/{second.name}",
                    f"The table is tilted by {tilts[0]:.0f} and {tilts[1]:.0f} degrees in the two views, and level when "
                    "each takes the other's pose: the cameras' images or calibrations are swapped. Exchange the folders.",
                )
            elif stated > _SWAP_M and exchanged < 0.5 * stated:
                yield Finding(
                    "fault",
                    "swapped_cameras",
                    f"cameras/{first.name}, cameras/{second.name}",
                    f"The two views disagree by {1000 * stated:.0f} mm, and by {1000 * exchanged:.0f} mm when each takes "
                    "the other's pose: the cameras or their calibrations are swapped.",
                )


def _plane(cloud: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the unit normal [3] of the plane with the most points; None if it has less than a third of them."""
    rng = np.random.default_rng(0)
    corners = cloud[rng.integers(len(cloud), size=(_PLANES, 3))]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    normal, origin = normal[length > 1e-6] / length[length > 1e-6, None], corners[length > 1e-6, 0]
    if not len(normal):
        return None
    inside = np.abs(cloud @ normal.T - (normal * origin).sum(axis=1)) < _FLAT_M
    best = int(inside.sum(axis=0).argmax())
    if inside[:, best].mean() < 1 / 3:
        return None
    points = cloud[inside[:, best]]
    found: NDArray[np.float64] = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    return found


def _tilt_deg(pose: NDArray[np.float64], normal: NDArray[np.float64] | None) -> float:
    """Return the angle between the plane and the horizontal; NaN without a plane."""
    return np.nan if normal is None else float(np.degrees(np.arccos(np.clip(abs((pose[:3, :3] @ normal)[2]), 0, 1))))


def _first_points(camera: RecordedCamera) -> NDArray[np.float64] | None:
    if camera.info is None:
        return None
    try:
        depth = read_depth(camera.folder / "depth" / f"{camera.frames[0]:06d}.png")
        step = max(1, int(np.sqrt(depth.size / _SWAP_POINTS)))
        points, _ = depth_points(depth, camera.info.intrinsics, camera.info.depth_scale_m, step=step)
    except (EpisodeError, IndexError):
        return None
    return points if len(points) > 50 else None


def _disagreement(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Return the lower quartile of the distances in both directions, since the views may only overlap by half."""
    there, _ = cKDTree(second).query(first)
    back, _ = cKDTree(first).query(second)
    return float(max(np.quantile(there, 0.25), np.quantile(back, 0.25)))
