"""One capture: cameras and arm at once, written while it runs, and the arm stopped whatever happens.

The control loop runs in the caller's thread. Each camera has a thread that takes its frames and one that writes them, so
that neither a slow disk nor a slow camera holds up the arm. Whatever ends the loop (the end of the trajectory, a limit, a
fault, a lost camera or connection, a full disk, Ctrl-C, a termination signal) goes through one `finally`, which sends Stop
before anything else. A watchdog thread sends Stop when the loop itself hangs.

Cameras and arm are the protocols below: `realsense` and `kinova` implement them, tests bring others.
"""

from __future__ import annotations

import queue
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import DiffCloudError, EpisodeError, HardwareError, LimitError
from diffcloud.hardware.trajectory import (
    DEFAULT_GAIN,
    Limits,
    ToolTrajectory,
    VelocityController,
    approach,
    check_trajectory,
)
from diffcloud.io.raw_episodes import CameraInfo, RawEpisodeWriter, RobotSample

Floats = NDArray[np.float64]

_LOG_RATE_HZ = 50.0
"""Robot rows come at least about this often: joint angles are interpolated to the images' times."""
_QUEUED_FRAMES = 64
_STOP_ATTEMPTS = 3


@dataclass(frozen=True)
class CameraFrame:
    """One pair of images."""

    time_s: float
    """Seconds since the epoch, host's clock."""
    depth: NDArray[np.uint16]
    """[H, W] aligned to colour, in units of the camera's depth scale."""
    color: NDArray[np.uint8] | None
    """[H, W, 3] red, green, blue."""


class Camera(Protocol):
    """A depth camera that delivers frames one after the other."""

    name: str

    def open(self) -> CameraInfo:
        """Start streaming. Raises HardwareError if it cannot."""

    def read(self, timeout_s: float) -> CameraFrame:
        """The next frame. Raises HardwareError if none comes in time."""

    def close(self) -> None:
        """Stop streaming; harmless twice."""


@dataclass(frozen=True)
class ArmReading:
    """What the arm measures."""

    joints_rad: Floats
    """[J]."""
    tool_position_m: Floats
    """[3] in the base frame."""
    tool_quaternion: Floats
    """[4] (w, x, y, z)."""
    gripper: float | None
    """0 open to 1 closed."""
    wrench: Floats
    """[6] external force [N] and torque [N·m] at the tool."""


class Arm(Protocol):
    """An arm under Cartesian velocity control. Each call raises HardwareError on a fault or a lost connection."""

    joint_count: int

    def describe(self) -> dict[str, Any]:
        """Model and address, for episode.json."""

    def prepare(self) -> None:
        """Refuse an arm in fault; switch to velocity control."""

    def home(self, timeout_s: float) -> None:
        """Move to the arm's own home position and wait."""

    def read(self) -> ArmReading:
        """Measure."""

    def send_velocity(self, linear_m_s: Floats) -> None:
        """Move the tool with this velocity [3] in the base frame until the next command."""

    def set_gripper(self, position: float) -> None:
        """Drive the gripper to 0 (open) .. 1 (closed); does not wait."""

    def stop(self) -> None:
        """Stop all motion. Must work from another thread."""

    def close(self) -> None:
        """Disconnect; harmless twice."""


@dataclass(frozen=True)
class CaptureSettings:
    """How a capture runs."""

    rate_hz: float = 10.0
    """Of control, and of the episode."""
    keep_every: int = 1
    """Of the camera's frames, one in so many is written."""
    gain: float = DEFAULT_GAIN
    approach_speed_m_s: float = 0.1
    go_home: bool = False
    home_timeout_s: float = 30.0
    hold_s: float = 0.5
    """Recorded at rest after the last keyframe."""
    camera_timeout_s: float = 1.0
    watchdog_s: float = 0.5
    """The loop may hang this long before Stop is sent."""
    durable: bool = True


@dataclass(frozen=True)
class CaptureReport:
    """What a capture that ran to its end recorded."""

    folder: Path
    frames: dict[str, int]
    robot_rows: int
    seconds: float
    largest_error_m: float
    """Of the tool against the trajectory at a control tick."""


def capture(
    folder: Path,
    cameras: Sequence[Camera],
    *,
    arm: Arm | None = None,
    trajectory: ToolTrajectory | None = None,
    limits: Limits | None = None,
    settings: CaptureSettings | None = None,
    seconds: float | None = None,
    meta: Mapping[str, Any] | None = None,
    T_world_camera: Mapping[str, Floats] | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> CaptureReport:
    """Record one raw episode.

    Args:
        folder: of the episode; must not exist.
        cameras: one or more, not yet open; they are closed at the end.
        arm: connected; None to record cameras alone for `seconds`. It is stopped at the end, and left connected.
        T_world_camera: by serial, where the cameras are calibrated.
        tell: is called with what happens.

    Raises:
        LimitError: the trajectory is refused before anything moves; or a limit was broken while moving.
        HardwareError: a camera or the arm failed. Frames so far are on disk, and Stop has been sent where a link exists.
        DiffCloudError: the disk refused a frame.
    """
    limits, settings = limits or Limits(), settings or CaptureSettings()
    if not cameras:
        raise HardwareError("A capture needs at least one camera; give --camera NAME=SERIAL.")
    if (arm is None) != (trajectory is None):
        raise HardwareError("An arm needs a trajectory, and a trajectory an arm.")
    if trajectory is None and not (seconds is not None and seconds > 0):
        raise HardwareError("Without an arm, say how long to record: --seconds.")
    # all that can be refused is refused before a camera is opened, and long before the arm moves
    if Path(folder).exists():
        raise EpisodeError(f"{folder} exists; raw episodes are never overwritten. Choose another name.")
    if trajectory is not None:
        check_trajectory(trajectory, limits)
    import_module("cv2")  # encodes the images; imported at the first of them it would hold the control loop up
    opened: list[Camera] = []
    try:
        infos = {}
        for camera in cameras:
            opened.append(camera)
            infos[camera.name] = _placed(camera.open(), T_world_camera or {})
            tell(f"camera {camera.name} ({infos[camera.name].serial}) streams")
        with _stopping(arm, settings.watchdog_s) as guard:
            motion = None
            if arm is not None and trajectory is not None:
                motion = _Motion(arm, trajectory, limits, settings, guard)
                _go_to_start(motion, tell)
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
            return _record(writer, opened, motion, settings, seconds or 0.0)
    finally:
        for camera in opened:
            with suppress(HardwareError):
                camera.close()


def _placed(info: CameraInfo, poses: Mapping[str, Floats]) -> CameraInfo:
    if info.serial not in poses:
        return info
    return CameraInfo(info.name, info.serial, info.intrinsics, info.depth_scale_m, poses[info.serial])


class _Guard:
    """Stops the arm when the control loop has not given a sign for too long."""

    def __init__(self, arm: Arm | None, allowed_s: float) -> None:
        self._arm, self._allowed = arm, allowed_s
        self._beat = time.monotonic()
        self._armed = False
        self._ended = threading.Event()
        self.tripped = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        self._thread.start()

    def beat(self) -> None:
        """The loop is alive; from the first call on it is watched.

        Raises:
            HardwareError: the watchdog has already stopped the arm.
        """
        self._beat, self._armed = time.monotonic(), True
        if self.tripped.is_set():
            raise HardwareError(
                f"The control loop hung for more than {self._allowed:g} s and the watchdog stopped the arm: the computer "
                "or the link to the arm is too slow. Close other programs, use a cable, or lower the rate."
            )

    def rest(self) -> None:
        """The arm does not move by velocity commands now; nothing to watch."""
        self._armed = False

    def end(self) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(self._allowed / 5):
            if self._armed and self._arm is not None and time.monotonic() - self._beat > self._allowed:
                self._armed = False
                self.tripped.set()
                with suppress(HardwareError):
                    self._arm.stop()


@contextmanager
def _stopping(arm: Arm | None, watchdog_s: float) -> Iterator[_Guard]:
    """Whatever leaves this block, Stop is sent first; termination signals leave it like Ctrl-C does."""
    guard = _Guard(arm, watchdog_s)
    try:
        with _signals_raise():
            yield guard
    finally:
        with _signals_held():
            guard.end()
            if arm is not None:
                _stop(arm)


def _stop(arm: Arm) -> None:
    for attempt in range(_STOP_ATTEMPTS):
        try:
            arm.stop()
            return
        except HardwareError:  # the link may be gone: the arm then stops by its own timeout
            if attempt + 1 < _STOP_ATTEMPTS:
                time.sleep(0.05)


@contextmanager
def _signals_raise() -> Iterator[None]:
    """SIGTERM and SIGHUP (a closed terminal) end the capture as Ctrl-C does."""

    def interrupt(number: int, _: FrameType | None) -> None:
        raise KeyboardInterrupt(f"signal {signal.Signals(number).name}")

    with _handlers({signal.SIGTERM: interrupt, signal.SIGHUP: interrupt}):
        yield


@contextmanager
def _signals_held() -> Iterator[None]:
    """A second Ctrl-C must not interrupt the Stop that the first one causes."""
    with _handlers(dict.fromkeys((signal.SIGINT, signal.SIGTERM, signal.SIGHUP), signal.SIG_IGN)):
        yield


@contextmanager
def _handlers(handlers: Mapping[signal.Signals, Any]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():  # only the main thread may set handlers
        yield
        return
    former = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


@dataclass(frozen=True)
class _Motion:
    """An arm and what it is to do."""

    arm: Arm
    trajectory: ToolTrajectory
    limits: Limits
    settings: CaptureSettings
    guard: _Guard


def _go_to_start(motion: _Motion, tell: Callable[[str], None]) -> None:
    arm, limits, settings = motion.arm, motion.limits, motion.settings
    arm.prepare()
    if settings.go_home:
        tell("moving home")
        arm.home(settings.home_timeout_s)
    position = arm.read().tool_position_m
    if limits.outside(position, limits.box_slack_m):
        raise LimitError(
            f"The tool is at {position.round(3).tolist()} m, outside the workspace box {limits.box_low_m} to "
            f"{limits.box_high_m}. Bring it inside first (--home, or by hand), or widen --box."
        )
    if motion.trajectory.gripper is not None:
        arm.set_gripper(float(motion.trajectory.gripper[0]))
    goal = motion.trajectory.positions[0]
    # a box is convex: between a start and a goal inside it the straight line is inside too
    path = approach(position, goal, speed_m_s=min(settings.approach_speed_m_s, limits.speed_m_s))
    if path is None:
        return
    tell(f"approaching the first keyframe, {path.duration_s:.1f} s")
    loop = _ArmLoop(replace(motion, trajectory=path))
    for t in _ticks(time.monotonic(), 1 / settings.rate_hz, path.duration_s + settings.hold_s):
        loop.command(t, loop.measure(t))
    arm.stop()
    motion.guard.rest()


def _record(
    writer: RawEpisodeWriter, cameras: Sequence[Camera], motion: _Motion | None, settings: CaptureSettings, seconds: float
) -> CaptureReport:
    largest = 0.0
    with writer:
        clock = _Clock()
        recorders = _Recorders(cameras, writer, clock, settings)
        try:
            recorders.start()
            if motion is None:
                recorders.wait(seconds)
            else:
                largest = _drive(motion, writer, clock, recorders)
        except BaseException:
            if motion is not None:
                with _signals_held():
                    _stop(motion.arm)  # at once; then there is time for the frames still in the queues
            recorders.finish()
            raise
        recorders.finish()
        recorders.raise_failure()
        if motion is not None:  # one row after the last image, so that every image lies between two rows
            writer.add_robot(_sample(clock.now(), motion.arm.read()))
    return CaptureReport(writer.folder, writer.frame_counts, writer.robot_rows, clock.now(), largest)


def _drive(motion: _Motion, writer: RawEpisodeWriter, clock: _Clock, recorders: _Recorders) -> float:
    """The control loop; returns the largest tracking error [m]."""
    loop = _ArmLoop(motion)
    rate_hz = motion.settings.rate_hz
    readings_per_tick = max(1, round(_LOG_RATE_HZ / rate_hz))
    duration = motion.trajectory.duration_s + motion.settings.hold_s
    for index, t in enumerate(_ticks(clock.start, 1 / rate_hz / readings_per_tick, duration)):
        recorders.raise_failure()
        before = clock.now()
        reading = loop.measure(t)
        writer.add_robot(_sample((before + clock.now()) / 2, reading))
        if index % readings_per_tick == 0:
            loop.command(t, reading)
    motion.arm.stop()
    motion.guard.rest()
    return loop.largest_error_m


class _ArmLoop:
    """Measure, check, command: the same for the approach and the recording."""

    def __init__(self, motion: _Motion) -> None:
        self._arm, self._guard = motion.arm, motion.guard
        self._trajectory, self._limits = motion.trajectory, motion.limits
        self._controller = VelocityController(
            motion.trajectory, motion.limits, period_s=1 / motion.settings.rate_hz, gain=motion.settings.gain
        )
        self._gripper: float | None = None
        self._rest_wrench: Floats | None = None
        self.largest_error_m = 0.0

    def measure(self, t: float) -> ArmReading:
        reading = self._arm.read()
        self._guard.beat()
        if self._rest_wrench is None:
            self._rest_wrench = reading.wrench
        self._check(t, reading)
        return reading

    def command(self, t: float, reading: ArmReading) -> None:
        gripper = self._trajectory.gripper_at(t)
        if gripper is not None and gripper != self._gripper:
            self._arm.set_gripper(gripper)
            self._gripper = gripper
        self._arm.send_velocity(self._controller.velocity(t, reading.tool_position_m))
        self._guard.beat()

    def _check(self, t: float, reading: ArmReading) -> None:
        limits, position = self._limits, reading.tool_position_m
        if limits.outside(position, limits.box_slack_m):
            raise LimitError(f"At t = {t:.2f} s the tool left the workspace box: {position.round(3).tolist()} m.")
        assert self._rest_wrench is not None
        wrench = reading.wrench - self._rest_wrench
        force, torque = float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(wrench[3:]))
        if force > limits.force_N or torque > limits.torque_Nm:
            raise LimitError(
                f"At t = {t:.2f} s the tool felt {force:.1f} N and {torque:.1f} N·m; limits are {limits.force_N:g} N and "
                f"{limits.torque_Nm:g} N·m. Something is in the way, or the cloth is caught."
            )
        error = float(np.linalg.norm(position - self._trajectory.position(t)))
        self.largest_error_m = max(self.largest_error_m, error)
        if error > limits.tracking_error_m:
            raise LimitError(
                f"At t = {t:.2f} s the tool is {1000 * error:.0f} mm from the trajectory; the limit is "
                f"{1000 * limits.tracking_error_m:.0f} mm. Something holds it, or the motion is too fast."
            )


class _Clock:
    """Seconds since the start of the recording, of this host, for arm and images alike."""

    def __init__(self) -> None:
        self.start = time.monotonic()
        self._epoch = time.time()

    def now(self) -> float:
        return time.monotonic() - self.start

    def of_epoch(self, time_s: float) -> float:
        return time_s - self._epoch


class _Recorders:
    """All cameras; the first failure of any is raised in the control loop."""

    def __init__(
        self, cameras: Sequence[Camera], writer: RawEpisodeWriter, clock: _Clock, settings: CaptureSettings
    ) -> None:
        self._failed = threading.Event()
        self._recorders = [_Recorder(camera, writer, clock, settings, self._failed) for camera in cameras]

    def start(self) -> None:
        for recorder in self._recorders:
            recorder.start()

    def finish(self) -> None:
        """No more frames are taken; what is queued is written."""
        for recorder in self._recorders:
            recorder.end()
        for recorder in self._recorders:
            recorder.join()

    def wait(self, seconds: float) -> None:
        self._failed.wait(seconds)
        self.raise_failure()

    def raise_failure(self) -> None:
        if self._failed.is_set():
            for recorder in self._recorders:
                if recorder.error is not None:
                    raise recorder.error


class _Recorder:
    """Takes and writes the frames of one camera, in two threads."""

    def __init__(
        self,
        camera: Camera,
        writer: RawEpisodeWriter,
        clock: _Clock,
        settings: CaptureSettings,
        failed: threading.Event,
    ) -> None:
        self.error: DiffCloudError | None = None
        self._camera, self._writer, self._clock, self._settings = camera, writer, clock, settings
        self._failed, self._ending = failed, threading.Event()
        self._frames: queue.Queue[CameraFrame | None] = queue.Queue(_QUEUED_FRAMES)
        self._threads = [
            threading.Thread(target=target, name=f"{camera.name}{target.__name__}", daemon=True)
            for target in (self._take, self._write)
        ]

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def end(self) -> None:
        self._ending.set()

    def join(self) -> None:
        for thread in self._threads:
            if thread.is_alive():
                thread.join()

    def _take(self) -> None:
        count = 0
        try:
            while not self._ending.is_set():
                frame = self._camera.read(self._settings.camera_timeout_s)
                if self._clock.of_epoch(frame.time_s) < 0:  # left over from before the start
                    continue
                if count % self._settings.keep_every == 0:
                    self._frames.put(frame, timeout=self._settings.camera_timeout_s)
                count += 1
        except queue.Full:
            self._fail(HardwareError(f"Camera {self._camera.name}: the disk cannot keep up; lower the frame rate."))
        except Exception as error:  # whatever a driver raises must end the capture, not only this thread
            if not self._ending.is_set():
                self._fail(error if isinstance(error, DiffCloudError) else HardwareError(f"{self._camera.name}: {error}"))
        finally:
            self._frames.put(None)

    def _write(self) -> None:
        refused = False
        while (frame := self._frames.get()) is not None:
            if refused:  # only empty the queue
                continue
            try:
                self._writer.add_frame(self._camera.name, self._clock.of_epoch(frame.time_s), frame.depth, frame.color)
            except DiffCloudError as error:
                refused = True
                self._fail(error)

    def _fail(self, error: DiffCloudError) -> None:
        if self.error is None:
            self.error = error
        self._failed.set()


def _ticks(start: float, period: float, duration: float) -> Iterator[float]:
    """Times since `start`, each yielded when it has come; a late loop skips none but does not wait."""
    count = int(np.ceil(duration / period)) + 1
    for index in range(count):
        ahead = start + index * period - time.monotonic()
        if ahead > 0:
            time.sleep(ahead)
        yield index * period if ahead > -period else time.monotonic() - start


def _sample(t_s: float, reading: ArmReading) -> RobotSample:
    return RobotSample(
        t_s, reading.joints_rad, reading.gripper, reading.tool_position_m, reading.tool_quaternion, reading.wrench
    )
