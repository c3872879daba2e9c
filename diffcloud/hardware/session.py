"""One capture: record cameras and arm together, and stop the arm in all cases.

The control loop (`motion`) runs in the caller's thread. Other threads read and write the recorded data (`recorders`).
The arm's connection belongs to another process (`arm_process`). The loop may end at the end of the trajectory, or by a
limit, a fault, a lost device, a full disk or a signal. In each case, Stop is sent before anything else. If this process
cannot send it, the arm's process does.

Cameras and arm implement the protocols in `devices`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import HardwareError
from diffcloud.hardware.arm_limits import ArmChecker, ArmLimits
from diffcloud.hardware.devices import ArmReading, Camera, GuardedArm
from diffcloud.hardware.interruption import Interruption
from diffcloud.hardware.motion import Motion, ToolFollower, go_to_start, run
from diffcloud.hardware.recorders import Clock, Recorders
from diffcloud.hardware.settings import CaptureSettings
from diffcloud.hardware.trajectory import Limits, ToolTrajectory, check_control_rate, check_trajectory
from diffcloud.io.raw_episodes import CameraInfo, RawEpisodeWriter, exists_already

if TYPE_CHECKING:
    from diffcloud.sensing.robot import Robot

Floats = NDArray[np.float64]
Tell = Callable[[str], None]


@dataclass(frozen=True)
class CaptureReport:
    """Result of a complete capture."""

    folder: Path
    frames: dict[str, int]
    robot_rows: int
    seconds: float
    largest_error_m: float
    """Largest distance between the tool and the trajectory [m]."""


def capture(
    folder: Path,
    cameras: Sequence[Camera],
    *,
    arm: GuardedArm | None = None,
    trajectory: ToolTrajectory | None = None,
    limits: Limits | None = None,
    arm_limits: ArmLimits | None = None,
    robot: Robot | None = None,
    settings: CaptureSettings | None = None,
    seconds: float | None = None,
    meta: Mapping[str, Any] | None = None,
    T_world_camera: Mapping[str, Floats] | None = None,
    tell: Tell = lambda _: None,
) -> CaptureReport:
    """Record one raw episode.

    Args:
        folder: folder of the episode. It must not exist.
        cameras: at least one, not open yet. All are closed at the end.
        arm: connected arm in its own process (`ArmProcess`), or None to record only cameras for `seconds`. It is
            stopped at the end and stays connected.
        robot: description of the arm with its tool. None: the package's own Gen3 with a 2F-85.
        T_world_camera: serial number -> [4, 4] camera pose, for calibrated cameras.
        tell: called with progress messages.

    Raises:
        LimitError: the trajectory was refused before the motion, or a limit was exceeded during the motion.
        UnconfirmedStopError: the arm has not confirmed the final Stop, and may still be moving.
        HardwareError: a camera or the arm failed. Frames so far are on disk, and Stop has been sent if a link exists.
        DiffCloudError: the disk refused a frame.
        KeyboardInterrupt: Ctrl-C, Ctrl-Z, a termination signal, or a closed terminal.
    """
    limits, settings = limits or Limits(), settings or CaptureSettings()
    if not cameras:
        raise HardwareError("A capture needs at least one camera: cameras in rig.yaml.")
    if (arm is None) != (trajectory is None):
        raise HardwareError("An arm needs a trajectory, and a trajectory an arm.")
    if arm is not None and not isinstance(arm, GuardedArm):
        raise HardwareError(
            "capture() takes an arm that is stopped even if this process dies: ArmProcess(partial(KinovaArm, address)), "
            f"got {type(arm).__name__}."
        )
    if trajectory is None and not (seconds is not None and seconds > 0):
        raise HardwareError("Without an arm, say how long to record: --seconds.")
    # Make all checks before a camera is opened, and long before the arm moves.
    if Path(folder).exists():
        raise exists_already(folder)
    if trajectory is not None:
        check_trajectory(trajectory, limits)
        check_control_rate(settings.rate_hz, settings.gain)
    import_module("cv2")  # encodes images; an import at the first image would delay the control loop
    opened: list[Camera] = []
    try:
        infos = {}
        for camera in cameras:
            opened.append(camera)
            infos[camera.name] = _placed(camera.open(), T_world_camera or {})
            tell(f"camera {camera.name} ({infos[camera.name].serial}) streams")
        with _stopping(arm, tell) as interruption:
            motion = follower = None
            if arm is not None and trajectory is not None:
                checker = ArmChecker(robot or _gen3(), limits, arm_limits or ArmLimits())
                motion = Motion(arm, checker, limits, settings, interruption.check)
                rest, contact = go_to_start(motion, trajectory, tell)
                follower = ToolFollower(motion, "trajectory", trajectory, rest, contact)
            writer = RawEpisodeWriter(
                folder,
                infos,
                rate_hz=settings.rate_hz,
                source="capture",
                robot=None if arm is None else arm.describe(),
                joint_count=7 if arm is None else arm.joint_count,
                durable=settings.durable,
                meta=meta,
            )
            tell("recording")
            with writer:
                clock = Clock()
                recorders = Recorders(
                    opened,
                    writer,
                    clock,
                    frames_hz=settings.frames_hz,
                    camera_timeout_s=settings.camera_timeout_s,
                    with_arm=arm is not None,
                )
                try:
                    recorders.start()
                    if motion is None or follower is None:
                        recorders.wait(seconds or 0.0)
                    else:
                        _drive(motion, follower, recorders, clock)
                except BaseException:
                    if arm is not None:
                        with interruption.held():
                            _stop(arm, tell)  # first, then there is time to write queued frames
                    recorders.finish()
                    raise
                recorders.finish()
                recorders.raise_failure()
            largest = 0.0 if follower is None else follower.largest_error_m
            return CaptureReport(writer.folder, writer.frame_counts, writer.robot_rows, clock.now(), largest)
    finally:
        for camera in opened:
            with suppress(Exception):  # close the other cameras even if this driver fails
                camera.close()


def _gen3() -> Robot:
    from diffcloud.sensing.robot import gen3  # imported here because it imports torch

    return gen3()


def _placed(info: CameraInfo, poses: Mapping[str, Floats]) -> CameraInfo:
    if info.serial not in poses:
        return info
    return replace(info, T_world_camera=poses[info.serial])


def _drive(motion: Motion, follower: ToolFollower, recorders: Recorders, clock: Clock) -> None:
    """Execute the trajectory and log the arm."""

    def heard(moment: float, reading: ArmReading) -> None:
        recorders.raise_failure()
        recorders.add_reading(clock.of(moment), reading)

    run(motion, follower, start=clock.start, heard=heard)
    recorders.end_cameras()
    # Add a row after the last image, so that every image is between two rows.
    recorders.add_reading(clock.now(), motion.arm.read())


@contextmanager
def _stopping(arm: GuardedArm | None, tell: Tell) -> Iterator[Interruption]:
    """Send Stop when this block ends in any way.

    Raises:
        UnconfirmedStopError: the arm has not confirmed Stop, and there was no other error.
    """
    with Interruption(lambda: None if arm is None else arm.halt()) as interruption:
        try:
            yield interruption
        except BaseException:
            if arm is not None:
                with interruption.held():
                    _stop(arm, tell)
            raise
        if arm is not None:
            with interruption.held():
                arm.stop()


def _stop(arm: GuardedArm, tell: Tell) -> None:
    """Stop the arm. If this fails, only print the error, since another error is already ending the capture."""
    try:
        arm.stop()
    except HardwareError as error:
        tell(str(error))
