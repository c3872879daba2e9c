"""The common form of imported recordings (cameras, frames, joint log), and writing it as a raw episode."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError
from diffcloud.io.files import staged
from diffcloud.io.raw_episodes import (
    MOST_HZ,
    CameraInfo,
    RawEpisodeWriter,
    RobotLog,
    RobotSample,
    exists_already,
    first_backwards,
    read_robot_log,
)

EPOCH_S = 1e8
"""Times above this value [s] (three years) are taken as seconds since 1970."""


@dataclass(frozen=True)
class RecordedFrame:
    """A depth image and optional colour image of one camera."""

    camera: str
    time_s: float
    """Time on the recording's clock."""
    depth: NDArray[np.uint16]
    """[H, W] in units of the camera's depth scale."""
    color: NDArray[np.uint8] | None = None
    """[H, W, 3] red, green, blue, aligned to depth."""


@dataclass(frozen=True)
class Recording:
    """A recording made by other software, in a form that `write_recording` can write as a raw episode."""

    cameras: Mapping[str, CameraInfo]
    frames: Iterable[RecordedFrame]
    """Frames in order of time for each camera. The iterable may be consumed only once."""
    source: str
    robot: RobotLog | None = None
    """Joint log on the clock of the frames."""
    warnings: tuple[str, ...] = ()
    """Messages to the user about data that were omitted, guessed or corrected."""


def write_recording(
    folder: Path, recording: Recording, *, rate_hz: float | None = None, meta: Mapping[str, Any] | None = None
) -> dict[str, int]:
    """Write a recording as a raw episode. Times start at the first frame.

    Args:
        rate_hz: frame rate for episode.json. None: measure it from the first camera.

    Returns:
        Number of frames of each camera.

    Raises:
        EpisodeError: there is no frame, times of a camera do not increase, or the rate is invalid.
    """
    check_frame_rate(rate_hz)
    frames = _read(recording)
    first = next(frames, None)
    if first is None:
        raise EpisodeError(f"{recording.source}: no depth image was found.")
    start = first.time_s
    if Path(folder).exists():
        raise exists_already(folder)
    with staged(folder) as temporary:
        return _written(temporary, recording, chain([first], frames), start, rate_hz, meta)


def _read(recording: Recording) -> Iterator[RecordedFrame]:
    """Yield the frames of a recording.

    Raises:
        EpisodeError: the system cannot read a frame.
    """
    try:
        yield from recording.frames
    except OSError as error:
        raise EpisodeError(f"{recording.source} cannot be read: {error}.") from error


def check_frame_rate(rate_hz: float | None) -> None:
    """Check a frame rate. None (unknown) is valid.

    Raises:
        EpisodeError: the rate is not positive, or higher than any camera's.
    """
    if rate_hz is not None and not 0 < rate_hz <= MOST_HZ:
        raise EpisodeError(
            f"A frame rate is in Hz, above 0 and at most {MOST_HZ:g}, got {rate_hz:g}. Correct --rate-hz, or leave it out "
            "where the source has times."
        )


def _written(
    folder: Path,
    recording: Recording,
    frames: Iterator[RecordedFrame],
    start: float,
    rate_hz: float | None,
    meta: Mapping[str, Any] | None,
) -> dict[str, int]:
    """Write the episode into a folder and return the number of frames of each camera."""
    robot = recording.robot
    joint_count = 7 if robot is None else robot.joints_rad.shape[1]
    writer = RawEpisodeWriter(
        folder,
        recording.cameras,
        rate_hz=rate_hz,
        source=recording.source,
        robot=None if robot is None else {"joints": joint_count},
        joint_count=joint_count,
        durable=False,
        meta=meta,
    )
    latest: dict[str, float] = {}
    with writer:
        for sample in [] if robot is None else _samples(robot, start):
            writer.add_robot(sample)
        for frame in frames:
            before = latest.get(frame.camera)
            if before is not None and frame.time_s <= before:
                raise EpisodeError(
                    f"{recording.source}: frame {writer.frame_counts[frame.camera]} of camera {frame.camera} is of "
                    f"{frame.time_s:.6f} s, the one before it of {before:.6f} s. The clock was set back while recording, "
                    "or frames were mixed up: cut the recording there."
                )
            latest[frame.camera] = frame.time_s
            writer.add_frame(frame.camera, frame.time_s - start, frame.depth, frame.color)
        first = next(iter(latest))
        counted = writer.frame_counts[first] - 1
        if rate_hz is None and counted:
            measured = round(counted / (latest[first] - start), 3)
            writer.state_rate(measured if 0 < measured <= MOST_HZ else None)
    return writer.frame_counts


def read_joint_log(path: Path, *, offset_s: float = 0.0, recording_start_s: float = 0.0) -> RobotLog:
    """Read a joint log with the columns of robot.csv, and convert its times to the recording's clock.

    Args:
        offset_s: added to the times of the log.
        recording_start_s: time of the first frame. If only this time is in seconds since 1970, times of the log are assumed
            to count from the first frame. Otherwise both are assumed to have the same clock.

    Raises:
        EpisodeError: the log is missing or damaged, its times do not increase, or its clock is another one.
    """
    log = read_robot_log(path)
    if not len(log.times):
        raise EpisodeError(f"{path} is an empty joint log.")
    bad = first_backwards(log.times)
    if bad is not None:
        raise EpisodeError(
            f"{path}: row {bad + 1}: the time runs backwards ({log.times[bad]:.6f} s after {log.times[bad - 1]:.6f} s); "
            "the clock was set while recording, or rows were mixed up. Sort or cut the log."
        )
    times = log.times + offset_s
    if times[0] < EPOCH_S <= recording_start_s:  # the log counts from the first frame
        times = times + recording_start_s
    if recording_start_s > times[-1] or (times[0] >= EPOCH_S > recording_start_s):
        raise EpisodeError(
            f"{path} covers {times[0]:.2f} to {times[-1]:.2f} s and the recording starts at "
            f"{recording_start_s:.2f} s: they are on different clocks. Give the difference with --clock-offset."
        )
    return replace(log, times=times)


def _samples(log: RobotLog, start: float) -> Sequence[RobotSample]:
    return [
        RobotSample(
            float(log.times[row] - start),
            log.joints_rad[row],
            float(log.gripper[row]),
            log.tool_position_m[row],
            log.tool_quaternion[row],
            log.wrench[row],
        )
        for row in range(len(log.times))
    ]
