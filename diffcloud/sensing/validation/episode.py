"""Checks of a raw episode. Each finding states the file, what was found, and what to try. The checks are independent,
so that one run reports all faults of a recording."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffcloud.errors import EpisodeError
from diffcloud.io.images import png_size, read_color, read_depth
from diffcloud.io.raw_episodes import (
    RobotLog,
    first_backwards,
    read_camera_info,
    read_description,
    read_robot_log,
    read_timestamps,
)
from diffcloud.sensing.tool_poses import not_unit, turning, unreachable
from diffcloud.sensing.validation.calibration import calibration_findings, exchanged_cameras
from diffcloud.sensing.validation.findings import Finding, RecordedCamera

if TYPE_CHECKING:
    from diffcloud.sensing.robot import Robot

_GAP = 2.5
"""A gap is longer than this multiple of the median interval."""
NEAREST_M, FARTHEST_M = 0.1, 8.0
"""Plausible range of the median depth of a table-top scene [m]."""
_GEN3_JOINTS = 7
_FEWEST_JOINTS = 6
"""An arm with fewer joints cannot reach arbitrary tool poses, so columns are probably missing."""
_FAR_RAD, _WINDOW_S = 2.5 * np.pi, 0.5
"""A joint angle beyond the first value is in degrees, or belongs to a continuous joint. Its speed over windows of the
second value [s] decides."""
_ALIKE = ("depth.emitter_enabled", "depth.laser_power", "depth.visual_preset")
_PACE = "depth.inter_cam_sync_mode"
_SPARSE = 0.02
"""Fraction of valid pixels below which a warning is given."""


def validate_raw_episode(folder: Path, *, calibration: Path | None = None, robot: Robot | None = None) -> list[Finding]:
    """Return all findings about a raw episode, faults first.

    Args:
        calibration: a calibration file that should contain the cameras. Those that camera.json names are read anyway.
        robot: robot whose joints robot.csv should have. If None, a number of joints other than the Gen3's is a warning.
    """
    folder = Path(folder)
    if not folder.is_dir():
        return [Finding("fault", "missing", str(folder), "No such folder.")]
    try:
        description = read_description(folder)
    except EpisodeError as error:
        return [Finding("fault", "description", "episode.json", str(error))]
    findings: list[Finding] = []
    if description.get("status") == "recording":
        findings.append(
            Finding(
                "warning",
                "unfinished",
                "episode.json",
                "The recording was never closed (a crash, a power cut, a full disk); the frames that "
                "timestamps.csv lists are whole.",
            )
        )
    cameras = []
    for name in description["cameras"]:
        camera, found = _open_camera(folder / "cameras" / name, name)
        findings += found
        if camera is not None:
            cameras.append(camera)
    for camera in cameras:
        findings += [*_clock(camera, description), *_images(camera), *calibration_findings(camera, folder, calibration)]
    findings += [*_settings(cameras)]
    findings += exchanged_cameras(cameras, folder, calibration)
    if description.get("robot") is not None:
        try:
            log = read_robot_log(folder / "robot.csv", torn=True)
        except EpisodeError as error:
            findings.append(Finding("fault", "robot_log", "robot.csv", str(error)))
        else:
            findings += [*_robot(log), *_joint_count(log, robot), *_coverage(log, cameras)]
    return sorted(findings, key=lambda finding: finding.severity != "fault")


def _open_camera(folder: Path, name: str) -> tuple[RecordedCamera | None, list[Finding]]:
    findings = []
    info = None
    try:
        info = read_camera_info(folder / "camera.json")
    except EpisodeError as error:
        findings.append(Finding("fault", "camera", f"cameras/{name}/camera.json", str(error)))
    try:
        frames, times = read_timestamps(folder / "timestamps.csv", torn=True)
    except EpisodeError as error:
        return None, [*findings, Finding("fault", "timestamps", f"cameras/{name}/timestamps.csv", str(error))]
    if not len(frames):
        message = "No frame was finished: the camera delivered nothing, or stopped at once."
        return None, [*findings, Finding("fault", "no_frames", f"cameras/{name}", message)]
    return RecordedCamera(name, folder, info, frames, times), findings


def _clock(camera: RecordedCamera, description: dict[str, Any]) -> Iterator[Finding]:
    place = f"cameras/{camera.name}/timestamps.csv"
    times = camera.times
    bad = first_backwards(times)
    if bad is not None:
        yield Finding(
            "fault",
            "clock_backwards",
            place,
            f"Row {bad + 1}: the time runs backwards ({times[bad]:.6f} s after {times[bad - 1]:.6f} s). The clock was set "
            "while recording, or rows were mixed up; sort the frames or record again.",
        )
        return
    skipped = np.flatnonzero(np.diff(camera.frames) != 1)
    if len(skipped):
        first = int(camera.frames[skipped[0]])
        yield Finding(
            "fault",
            "missing_frames",
            place,
            f"Frame {first} is followed by frame {int(camera.frames[skipped[0] + 1])} ({len(skipped)} such places): frames "
            "were deleted. Times still hold; renumber, or copy the recording again.",
        )
    if len(times) < 3:
        return
    intervals = np.diff(times)
    usual = float(np.median(intervals))
    gaps = np.flatnonzero(intervals > _GAP * usual)
    if len(gaps):
        worst = int(gaps[np.argmax(intervals[gaps])])
        yield Finding(
            "fault",
            "clock_gap",
            place,
            f"{len(gaps)} gaps; the longest is {intervals[worst]:.3f} s after frame {int(camera.frames[worst])}, where "
            f"{usual:.3f} s is usual. Computer, disk or USB link were too slow: lower the frame rate, use USB 3.",
        )
    rate = description.get("rate_hz")
    if isinstance(rate, int | float) and rate > 0 and not 0.75 < usual * rate < 1.33:
        yield Finding(
            "warning",
            "rate",
            place,
            f"Frames come every {usual:.4f} s, but episode.json states {rate:g} Hz"
            + (": these times are milliseconds." if 750 < usual * rate < 1330 else "."),
        )


def _images(camera: RecordedCamera) -> Iterator[Finding]:
    place = f"cameras/{camera.name}"
    if list((camera.folder / "depth").glob("*.[jJ][pP]*[gG]")):
        yield Finding(
            "fault",
            "jpeg_depth",
            f"{place}/depth",
            "Depth is stored as JPEG, which changes it by centimetres at every border and cannot be repaired: record "
            "16-bit PNG.",
        )
        return
    empty: list[int] = []
    sparse: list[int] = []
    medians: list[float] = []
    for frame in camera.frames:  # image by image, to bound the memory
        path = camera.folder / "depth" / f"{frame:06d}.png"
        where = f"{place}/depth/{path.name}"
        try:
            depth = read_depth(path)
        except EpisodeError as error:
            yield Finding("fault", _image_code(path, str(error)), where, str(error))
            continue
        if camera.info is not None and depth.shape != (camera.info.intrinsics.height, camera.info.intrinsics.width):
            stated = camera.info.intrinsics
            yield Finding(
                "fault",
                "image_size",
                where,
                f"{depth.shape[1]} x {depth.shape[0]} pixels, but camera.json states {stated.width} x {stated.height}: the "
                "intrinsics belong to another resolution.",
            )
            return
        valid = depth[depth > 0]
        if not len(valid):
            empty.append(int(frame))
        else:
            if len(valid) < _SPARSE * depth.size:
                sparse.append(int(frame))
            medians.append(float(np.median(valid)))
    yield from _colour(camera)
    if empty:
        yield Finding(
            "fault",
            "no_depth",
            f"{place}/depth",
            f"{_numbers(empty)} 0 valid depth (every pixel is 0): lens covered, emitter off, nearer than 0.2 m, or "
            "the depth stream was not enabled.",
        )
    if sparse:
        yield Finding("warning", "sparse_depth", f"{place}/depth", f"{_numbers(sparse)} depth in under 2 % of the pixels.")
    if medians and camera.info is not None:
        distance = float(np.median(medians)) * camera.info.depth_scale_m
        if not NEAREST_M <= distance <= FARTHEST_M:
            factor = 1000 if distance > FARTHEST_M else 0.001
            hint = f"; depth_scale_m is off by a factor of {factor:g} (millimetres for metres)"
            plausible = NEAREST_M <= distance / factor <= FARTHEST_M
            yield Finding(
                "fault",
                "depth_unit",
                f"{place}/camera.json",
                f"The median depth is {distance:.3g} m with depth_scale_m = {camera.info.depth_scale_m:g}"
                + (hint if plausible else "")
                + f". A table-top scene lies between {NEAREST_M} and {FARTHEST_M} m.",
            )


def _image_code(path: Path, message: str) -> str:
    if not path.is_file():
        return "missing_frames"
    for word, code in (("truncated", "truncated_image"), ("JPEG", "jpeg_depth"), ("damaged", "damaged_image")):
        if word in message:
            return code
    return "image"


def _colour(camera: RecordedCamera) -> Iterator[Finding]:
    folder = camera.folder / "color"
    place = f"cameras/{camera.name}/color"
    if not folder.is_dir():
        yield Finding("warning", "no_colour", place, "No colour images: masks and pictures will do without.")
        return
    for frame in camera.frames:
        path = folder / f"{frame:06d}.png"
        try:
            read_color(path)
            size = png_size(path)
        except EpisodeError as error:
            yield Finding("fault", _image_code(path, str(error)), f"{place}/{path.name}", str(error))
            continue
        if camera.info is not None and size != (camera.info.intrinsics.width, camera.info.intrinsics.height):
            message = f"{size[0]} x {size[1]} pixels; depth and colour of an episode are aligned and of one size."
            yield Finding("fault", "image_size", f"{place}/{path.name}", message)
            return


def _settings(cameras: list[RecordedCamera]) -> Iterator[Finding]:
    """Check that all cameras of the episode have equal settings."""
    told = {camera.name: camera.info.settings for camera in cameras if camera.info is not None and camera.info.settings}
    for name, settings in told.items():
        free = [key for key in ("depth.enable_auto_exposure", "color.enable_auto_exposure") if settings.get(key)]
        if free:
            message = (
                f"Its exposure follows the picture ({', '.join(free)}): the noise of depth changes from frame to frame."
            )
            yield Finding("warning", "auto_exposure", f"cameras/{name}/camera.json", message)
    for key in _ALIKE:
        values = {name: settings[key] for name, settings in told.items() if key in settings}
        if len(set(values.values())) > 1:
            yield Finding("warning", "settings_differ", "cameras", f"{key} is not the same in all cameras: {values}.")
    paces = {name: settings[_PACE] for name, settings in told.items() if _PACE in settings}
    if any(paces.values()) and sorted(paces.values()) != [1.0, *[2.0] * (len(paces) - 1)]:
        message = f"{_PACE} is {paces}: one camera must be the master (1), all others slaves (2), or all free (0)."
        yield Finding("warning", "pace", "cameras", message)


def _robot(log: RobotLog) -> Iterator[Finding]:
    place = "robot.csv"
    if not len(log.times):
        yield Finding("fault", "robot_log", place, "The joint log is empty.")
        return
    bad = first_backwards(log.times)
    if bad is not None:
        message = f"Row {bad + 1}: the time runs backwards ({log.times[bad]:.6f} s after {log.times[bad - 1]:.6f} s)."
        yield Finding("fault", "clock_backwards", place, message)
    first, largest = float(np.abs(log.joints_rad[0]).max()), float(np.abs(log.joints_rad).max())
    # a continuous joint may make several turns, but not one per second
    if first > _FAR_RAD or (largest > _FAR_RAD and bad is None and _fastest(log) > 2 * np.pi):
        yield Finding(
            "fault",
            "angle_unit",
            place,
            f"A joint angle is {largest:.1f} in radians. If these are degrees, as the arm itself reports them, multiply by "
            "pi / 180; if a joint without end had turned before, subtract its whole turns.",
        )
    reach = unreachable(log.tool_position_m)
    if reach is not None:
        yield Finding("fault", "length_unit", place, reach)
    grip = log.gripper[np.isfinite(log.gripper)]
    if len(grip) and (grip.min() < -0.05 or grip.max() > 1.05):
        unit = "percent" if grip.max() <= 105 else "another unit"
        message = f"The gripper lies between {grip.min():g} and {grip.max():g}; it is 0 (open) to 1 (closed), not {unit}."
        yield Finding("fault", "gripper_unit", place, message)
    orientation = not_unit(log.tool_quaternion)
    if orientation is not None:
        yield Finding("fault", "quaternion", place, orientation)
    elif (turned := turning(log.tool_quaternion)) is not None:
        yield Finding("warning", "tool_turns", place, turned)
    if bad is None and len(log.times) > 3:
        intervals = np.diff(log.times)
        usual = float(np.median(intervals))
        if intervals.max() > max(_GAP * usual, 0.25):
            worst = int(intervals.argmax())
            message = (
                f"A gap of {intervals[worst]:.3f} s after {log.times[worst]:.3f} s, where {usual:.3f} s is usual: where "
                "the arm was meanwhile is not known. Log at the arm's own rate, and record again or cut the episode there."
            )
            yield Finding("fault", "clock_gap", place, message)


def _fastest(log: RobotLog) -> float:
    """Return the largest speed of any joint over any half second [rad/s]."""
    later = np.minimum(log.times + _WINDOW_S, log.times[-1])
    ahead = np.stack([np.interp(later, log.times, column) for column in log.joints_rad.T], axis=1)
    return float(np.abs(ahead - log.joints_rad).max()) / _WINDOW_S


def _joint_count(log: RobotLog, robot: Robot | None) -> Iterator[Finding]:
    logged, wanted = log.joints_rad.shape[1], _GEN3_JOINTS if robot is None else len(robot.arm)
    if logged == wanted:
        return
    if robot is None:
        message = f"It has {logged} joints, the Gen3 {wanted}: give `preprocess` the description of this arm with --urdf."
        yield Finding("warning" if logged >= _FEWEST_JOINTS else "fault", "joint_count", "robot.csv", message)
    else:
        message = f"It has {logged} joints, the description {robot.description.name} has {wanted}."
        yield Finding("fault", "joint_count", "robot.csv", message)


def _coverage(log: RobotLog, cameras: list[RecordedCamera]) -> Iterator[Finding]:
    if not len(log.times):
        return
    usual = float(np.median(np.diff(log.times))) if len(log.times) > 1 else 0.0
    slack = max(2 * usual, 0.05)
    for camera in cameras:
        outside = (camera.times < log.times.min() - slack) | (camera.times > log.times.max() + slack)
        if outside.any():
            yield Finding(
                "fault",
                "short_robot_log",
                "robot.csv",
                f"The joint log covers {log.times.min():.2f} to {log.times.max():.2f} s, camera {camera.name} "
                f"{camera.times.min():.2f} to {camera.times.max():.2f} s: {int(outside.sum())} of {len(outside)} frames "
                "have no joint angles. Start the log before the cameras and stop it after; check that both use one clock.",
            )


def _numbers(frames: list[int]) -> str:
    shown = ", ".join(map(str, frames[:5])) + (", ..." if len(frames) > 5 else "")
    return f"Frames {shown} ({len(frames)} in all) have" if len(frames) > 1 else f"Frame {shown} has"
