"""Threads that write a recording, so that the arm's control loop never waits.

Each camera has one thread that reads frames and one that writes them. The arm's readings have a queue and a thread,
which writes many rows at once if the disk is slow. So neither a slow disk nor a slow camera delays the arm.

A signal may raise KeyboardInterrupt between almost any two instructions of the control loop's thread. `queue.Queue` and
`threading.Event` take locks in Python code. An interrupt there would leave them locked, and the capture would wait
forever. So this thread uses `SimpleQueue`, whose `put` is one instruction, and plain attributes.
"""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Sequence

from diffcloud.errors import DiffCloudError, HardwareError
from diffcloud.hardware.devices import ArmReading, Camera, CameraFrame
from diffcloud.io.raw_episodes import RawEpisodeWriter, RobotSample

_QUEUED_FRAMES = 64
_QUEUED_ROWS = 1500
"""About half a minute of the arm's readings."""
_OVERDUE_S = 0.5
"""Delay beyond its timeout after which a driver is considered to hang."""
_WATCH_S = 0.1
_FULL_S = 0.005
"""Interval for polling a full queue."""
_AHEAD_S = 1.0
"""Tolerance for frame times in the future. Clock offsets are accurate to milliseconds."""


class Clock:
    """Seconds since the start of the recording. Monotonic, so changes of the computer's time have no effect."""

    def __init__(self) -> None:
        self.start = time.monotonic()

    def now(self) -> float:
        return time.monotonic() - self.start

    def of(self, monotonic_s: float) -> float:
        return monotonic_s - self.start


class Recorders:
    """Recorders of all cameras and of the arm's log. The first failure is raised in the control loop.

    Args:
        frames_hz: number of frames written per second and camera. None writes all.
        camera_timeout_s: a camera that delivers no frame for this time has failed.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        writer: RawEpisodeWriter,
        clock: Clock,
        *,
        frames_hz: float | None,
        camera_timeout_s: float,
        with_arm: bool,
    ) -> None:
        self._cameras = [
            _CameraRecorder(camera, writer, clock, frames_hz=frames_hz, timeout_s=camera_timeout_s) for camera in cameras
        ]
        self._arm = _ArmRecorder(writer) if with_arm else None

    def start(self) -> None:
        for recorder in self._all():
            recorder.start()

    def add_reading(self, t_s: float, reading: ArmReading) -> None:
        """Queue a row of robot.csv, which another thread writes.

        Raises:
            HardwareError: too many rows are queued, so the disk has probably stopped.
        """
        assert self._arm is not None
        self._arm.add(
            RobotSample(
                t_s, reading.joints_rad, reading.gripper, reading.tool_position_m, reading.tool_quaternion, reading.wrench
            )
        )

    def end_cameras(self) -> None:
        """Stop reading frames, and write all queued frames."""
        for recorder in self._cameras:
            recorder.end()
        for recorder in self._cameras:
            recorder.join()

    def finish(self) -> None:
        """Stop all recorders, and write everything that is queued."""
        self.end_cameras()
        if self._arm is not None:
            self._arm.end()
            self._arm.join()

    def wait(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            time.sleep(min(left, _WATCH_S))
            self.raise_failure()

    def raise_failure(self) -> None:
        """Raise the first failure of any recorder.

        Raises:
            DiffCloudError: the error of a camera or the disk, or a camera's driver hangs.
        """
        for camera in self._cameras:
            camera.check_driver()
        for recorder in self._all():
            if recorder.error is not None:
                raise recorder.error

    def _all(self) -> list[_CameraRecorder | _ArmRecorder]:
        return [*self._cameras, *([] if self._arm is None else [self._arm])]


class _CameraRecorder:
    """Reads and writes the frames of one camera, in two threads."""

    def __init__(
        self,
        camera: Camera,
        writer: RawEpisodeWriter,
        clock: Clock,
        *,
        frames_hz: float | None,
        timeout_s: float,
    ) -> None:
        self.error: DiffCloudError | None = None
        self._camera, self._writer, self._clock = camera, writer, clock
        self._timeout_s = timeout_s
        self._period, self._due = (0.0 if frames_hz is None else 1 / frames_hz), -math.inf
        self._ending = False
        self._frames: queue.SimpleQueue[CameraFrame | None] = queue.SimpleQueue()
        self._asked: float | None = None
        """`time.monotonic()` of the current call of the driver. None if no call is in progress."""
        self._taker, self._writing = (
            threading.Thread(target=target, name=f"{camera.name}{target.__name__}", daemon=True)
            for target in (self._take, self._write)
        )

    def start(self) -> None:
        self._taker.start()
        self._writing.start()

    def end(self) -> None:
        self._ending = True

    def join(self) -> None:
        """Wait until all queued frames are written. A thread in a driver that hangs is abandoned."""
        while self._taker.is_alive() and not self._hangs():
            self._taker.join(_WATCH_S)
        if self._taker.is_alive():
            self._frames.put(None)
        if self._writing.is_alive():
            self._writing.join()

    def check_driver(self) -> None:
        """Report a driver that hangs: it neither delivers a frame nor raises an error."""
        if self.error is None and self._hangs():
            self._fail(
                HardwareError(
                    f"Camera {self._camera.name}: its driver has not come back for {self._timeout_s + _OVERDUE_S:g} s, "
                    f"though its timeout is {self._timeout_s:g} s: it hangs. Reconnect the camera."
                )
            )

    def _hangs(self) -> bool:
        asked = self._asked
        return asked is not None and time.monotonic() - asked > self._timeout_s + _OVERDUE_S

    def _take(self) -> None:
        count, last = 0, 0.0
        try:
            while not self._ending:
                self._asked = time.monotonic()
                frame = self._camera.read(self._timeout_s)
                self._asked = None
                t = self._clock.of(frame.time_s)
                if count == 0 and t < 0:  # frame from before the start
                    if self._clock.now() > self._timeout_s:
                        raise HardwareError(
                            f"Camera {self._camera.name}: its clock is behind by {self._clock.now() - t:.3g} s; frames "
                            "cannot be placed in time."
                        )
                    continue
                if count and t <= last:  # an error, since silently dropped frames would hide a gap
                    raise HardwareError(
                        f"Camera {self._camera.name}: its clock ran backwards by {last - t:.3f} s; frames cannot be placed "
                        "in time."
                    )
                if t > self._clock.now() + _AHEAD_S:
                    raise HardwareError(
                        f"Camera {self._camera.name}: its clock is ahead by {t - self._clock.now():.3g} s; frames cannot "
                        "be placed in time."
                    )
                interval, last = (t - last if count else 0.0), t
                if self._is_due(t, interval) and not self._queued(frame):
                    self._fail(HardwareError(f"Camera {self._camera.name}: the disk cannot keep up; lower the frame rate."))
                    break
                count += 1
        except Exception as error:  # any error of a driver must end the capture, not only this thread
            if not self._ending:
                self._fail(_named(f"Camera {self._camera.name}", error))
        finally:
            self._asked = None
            self._frames.put(None)

    def _is_due(self, t: float, interval: float) -> bool:
        """Whether this frame is the one nearest to the next time at which a frame should be written."""
        if t + interval / 2 < self._due:
            return False
        late = t - self._due > self._period / 2  # first frame, or after a gap, whose missed frames are not made up for
        self._due = (t if late else self._due) + self._period
        return True

    def _queued(self, frame: CameraFrame) -> bool:
        """Queue a frame. Wait for the disk at most as long as for the camera, and return False if there is no room."""
        end = time.monotonic() + self._timeout_s
        while self._frames.qsize() >= _QUEUED_FRAMES:
            if time.monotonic() > end:
                return False
            time.sleep(_FULL_S)
        self._frames.put(frame)
        return True

    def _write(self) -> None:
        refused = False
        while (frame := self._frames.get()) is not None:
            if refused:  # after a failure, only empty the queue
                continue
            try:
                self._writer.add_frame(self._camera.name, self._clock.of(frame.time_s), frame.depth, frame.color)
            except Exception as error:  # any error of the encoder or the disk
                refused = True
                self._fail(_named(f"Camera {self._camera.name}, writing a frame", error))

    def _fail(self, error: DiffCloudError) -> None:
        if self.error is None:
            self.error = error


class _ArmRecorder:
    """Writes the arm's readings in a thread."""

    def __init__(self, writer: RawEpisodeWriter) -> None:
        self.error: DiffCloudError | None = None
        self._writer = writer
        self._rows: queue.SimpleQueue[RobotSample | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write, name="robot_write", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def add(self, sample: RobotSample) -> None:
        if self._rows.qsize() >= _QUEUED_ROWS:
            raise HardwareError(
                f"{_QUEUED_ROWS} rows of robot.csv are waiting for the disk: it has stopped, or is far too slow."
            )
        self._rows.put(sample)

    def end(self) -> None:
        self._rows.put(None)

    def join(self) -> None:
        if self._thread.is_alive():
            self._thread.join()

    def _write(self) -> None:
        ended = refused = False
        while not ended:
            rows = [self._rows.get()]
            while not self._rows.empty():  # write all queued rows with a single fsync
                rows.append(self._rows.get())
            ended = None in rows
            if refused:  # after a failure, only empty the queue
                continue
            try:
                self._writer.add_robot(*(row for row in rows if row is not None))
            except Exception as error:
                refused, self.error = True, _named("Writing robot.csv", error)


def _named(where: str, error: Exception) -> DiffCloudError:
    """Return a DiffCloudError unchanged. Convert others, and add their type to the message."""
    return error if isinstance(error, DiffCloudError) else HardwareError(f"{where}: {type(error).__name__}: {error}")
