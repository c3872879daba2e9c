"""What writes a recording while it runs: nothing here is waited for by the arm's control loop.

Each camera has a thread that takes its frames and one that writes them; the arm's readings have a queue and a thread that
writes them, many rows at a time when the disk is slow. So neither a slow disk nor a slow camera holds up the arm.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Sequence

from diffcloud.errors import DiffCloudError, HardwareError
from diffcloud.hardware.devices import ArmReading, Camera, CameraFrame
from diffcloud.io.raw_episodes import RawEpisodeWriter, RobotSample

_QUEUED_FRAMES = 64
_QUEUED_ROWS = 1500
"""Half a minute of the arm's readings."""


class Clock:
    """Seconds since the start of the recording. Monotonic: setting the computer's time changes nothing."""

    def __init__(self) -> None:
        self.start = time.monotonic()

    def now(self) -> float:
        return time.monotonic() - self.start

    def of(self, monotonic_s: float) -> float:
        return monotonic_s - self.start


class Recorders:
    """All cameras and, where there is one, the arm's log; the first failure of any is raised in the control loop.

    Args:
        keep_every: of a camera's frames, one in so many is written.
        camera_timeout_s: a camera that is silent for longer has failed.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        writer: RawEpisodeWriter,
        clock: Clock,
        *,
        keep_every: int,
        camera_timeout_s: float,
        with_arm: bool,
    ) -> None:
        self._failed = threading.Event()
        self._cameras = [
            _CameraRecorder(camera, writer, clock, self._failed, keep_every=keep_every, timeout_s=camera_timeout_s)
            for camera in cameras
        ]
        self._arm = _ArmRecorder(writer, self._failed) if with_arm else None

    def start(self) -> None:
        for recorder in self._all():
            recorder.start()

    def add_reading(self, t_s: float, reading: ArmReading) -> None:
        """A row of robot.csv, written by another thread.

        Raises:
            HardwareError: so many rows wait that the disk must have stopped.
        """
        assert self._arm is not None
        self._arm.add(
            RobotSample(
                t_s, reading.joints_rad, reading.gripper, reading.tool_position_m, reading.tool_quaternion, reading.wrench
            )
        )

    def end_cameras(self) -> None:
        """No more frames are taken; what is queued is written."""
        for recorder in self._cameras:
            recorder.end()
        for recorder in self._cameras:
            recorder.join()

    def finish(self) -> None:
        """Everything that is queued is written."""
        self.end_cameras()
        if self._arm is not None:
            self._arm.end()
            self._arm.join()

    def wait(self, seconds: float) -> None:
        self._failed.wait(seconds)
        self.raise_failure()

    def raise_failure(self) -> None:
        if self._failed.is_set():
            for recorder in self._all():
                if recorder.error is not None:
                    raise recorder.error

    def _all(self) -> list[_CameraRecorder | _ArmRecorder]:
        return [*self._cameras, *([] if self._arm is None else [self._arm])]


class _CameraRecorder:
    """Takes and writes the frames of one camera, in two threads."""

    def __init__(
        self,
        camera: Camera,
        writer: RawEpisodeWriter,
        clock: Clock,
        failed: threading.Event,
        *,
        keep_every: int,
        timeout_s: float,
    ) -> None:
        self.error: DiffCloudError | None = None
        self._camera, self._writer, self._clock = camera, writer, clock
        self._keep_every, self._timeout_s = keep_every, timeout_s
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
        count, last = 0, 0.0
        try:
            while not self._ending.is_set():
                frame = self._camera.read(self._timeout_s)
                t = self._clock.of(frame.time_s)
                if count == 0 and t < 0:  # left over from before the start
                    continue
                if count and t <= last:  # left out in silence, such frames would make a gap look like a recording
                    raise HardwareError(
                        f"Camera {self._camera.name}: its clock ran backwards by {last - t:.3f} s; frames cannot be placed "
                        "in time."
                    )
                last = t
                if count % self._keep_every == 0:
                    self._frames.put(frame, timeout=self._timeout_s)
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
                self._writer.add_frame(self._camera.name, self._clock.of(frame.time_s), frame.depth, frame.color)
            except DiffCloudError as error:
                refused = True
                self._fail(error)

    def _fail(self, error: DiffCloudError) -> None:
        if self.error is None:
            self.error = error
        self._failed.set()


class _ArmRecorder:
    """Writes the arm's readings in a thread."""

    def __init__(self, writer: RawEpisodeWriter, failed: threading.Event) -> None:
        self.error: DiffCloudError | None = None
        self._writer, self._failed = writer, failed
        self._rows: queue.Queue[RobotSample | None] = queue.Queue(_QUEUED_ROWS)
        self._thread = threading.Thread(target=self._write, name="robot_write", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def add(self, sample: RobotSample) -> None:
        try:
            self._rows.put_nowait(sample)
        except queue.Full as error:
            raise HardwareError(
                f"{_QUEUED_ROWS} rows of robot.csv wait for the disk: it has stopped, or is far too slow."
            ) from error

    def end(self) -> None:
        self._rows.put(None)

    def join(self) -> None:
        if self._thread.is_alive():
            self._thread.join()

    def _write(self) -> None:
        ended = refused = False
        while not ended:
            rows = [self._rows.get()]
            while not self._rows.empty():  # all that has come: the disk is waited for once
                rows.append(self._rows.get())
            ended = None in rows
            if refused:  # only empty the queue
                continue
            try:
                self._writer.add_robot(*(row for row in rows if row is not None))
            except DiffCloudError as error:
                refused, self.error = True, error
                self._failed.set()
