"""RealSense depth cameras: live, recording, and playback.

pyrealsense2 is imported when a camera is opened. All functions accept an `rs.context`, so tests can use software
devices instead of cameras. Depth is aligned to colour, because masks and calibration are in the colour image. No
filters of the SDK are applied, because an episode stores raw measurements.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from diffcloud.errors import HardwareError
from diffcloud.hardware import camera_settings
from diffcloud.hardware.camera_settings import CameraSettings
from diffcloud.hardware.devices import CameraFrame
from diffcloud.hardware.frame_times import FrameTimes, monotonic_of_day
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.libusb import load_libusb
from diffcloud.io.raw_episodes import CameraInfo
from diffcloud.io.recordings import RecordedFrame, Recording

_QUEUED_PAIRS = 64
"""Length of the SDK's queue. Without an explicit queue, a pipeline keeps one pair of images and drops the others."""
_LONGEST_WAY_S = 3.0
"""Longest time from the camera to this queue."""
_PLAYBACK_WAIT_MS = 100
_PLAYBACK_PATIENCE = 50
"""Number of waits without a frame after which playback is considered finished."""


def import_realsense() -> Any:
    """Import pyrealsense2. If the system has no libusb, the one of libusb-package is loaded first.

    Raises:
        HardwareError: it cannot be imported. The message lists what to install.
    """
    try:
        load_libusb()
        import pyrealsense2
    except (ImportError, OSError) as error:
        raise HardwareError(
            f"pyrealsense2 cannot be imported ({error}). Install it with: pip install pyrealsense2 (and on a bare Debian "
            "apt-get install libudev1)."
        ) from error
    return pyrealsense2


def connected_cameras(context: Any | None = None) -> list[dict[str, str]]:
    """Return name, serial, firmware and USB type of each connected camera.

    Raises:
        HardwareError: the library cannot be imported, or cannot search for cameras.
    """
    rs = import_realsense()
    fields = {
        "name": rs.camera_info.name,
        "serial": rs.camera_info.serial_number,
        "firmware": rs.camera_info.firmware_version,
        "usb": rs.camera_info.usb_type_descriptor,
    }
    try:
        devices = (rs.context() if context is None else context).query_devices()
    except RuntimeError as error:  # raised by the library without a home folder or access to USB
        raise HardwareError(
            f"The RealSense library cannot look for cameras ({error}). Set HOME to a folder that exists, and check the "
            "udev rules."
        ) from error
    found = [{key: device.get_info(info) for key, info in fields.items() if device.supports(info)} for device in devices]
    return sorted(found, key=lambda device: device.get("serial", ""))


class RealSenseCamera:
    """A live camera, identified by its serial number.

    Args:
        name: name of the camera in the episode.
        context: an `rs.context`, by default the computer's own.
        fps: frame rate of the camera (a D435 supports 6, 15, 30 and 60).
        record_to: also write a recording of the SDK (`.db3`), in which depth is not aligned.
        warm_up: number of frames dropped at the start, while the exposure adjusts.
        settings: exposure, laser, preset and synchronisation.
    """

    def __init__(
        self,
        name: str,
        serial: str,
        *,
        context: Any | None = None,
        width: int = 640,
        height: int = 480,
        fps: int = 30,
        record_to: Path | None = None,
        warm_up: int = 0,
        settings: CameraSettings | None = None,
    ) -> None:
        self._settings = settings or CameraSettings()
        self.name, self.serial = name, serial
        self._context, self._size, self._fps = context, (width, height), fps
        self._record_to, self._warm_up = record_to, warm_up
        self._pipeline: Any = None
        self._queue: Any = None
        self._align: Any = None
        self._last_number: int | None = None
        self._times: FrameTimes | None = None
        self.dropped = 0
        """Number of frames that were lost, according to the camera's frame numbers."""

    def open(self) -> CameraInfo:
        """Start streaming.

        Raises:
            HardwareError: the camera is not connected, busy, or lacks the stream. The message lists connected cameras.
        """
        rs = import_realsense()
        if self._record_to is not None and self._record_to.suffix != ".db3":
            raise HardwareError(f"The SDK writes recordings as .db3 since 2.58, got {self._record_to.name}.")
        context = rs.context() if self._context is None else self._context
        found = [device["serial"] for device in connected_cameras(context)]
        if self.serial not in found:
            seen = f"connected are {', '.join(found)}" if found else "no RealSense camera is connected"
            raise HardwareError(
                f"Camera {self.name}: no serial {self.serial}; {seen}. Check the cable (USB 3), the number on the housing, "
                "and that no other program has it open."
            )
        config = rs.config()
        config.enable_device(self.serial)
        config.enable_stream(rs.stream.depth, *self._size, rs.format.z16, self._fps)
        config.enable_stream(rs.stream.color, *self._size, rs.format.rgb8, self._fps)
        if self._record_to is not None:
            self._record_to.parent.mkdir(parents=True, exist_ok=True)
            config.enable_record_to_file(str(self._record_to))
        self._pipeline, self._queue = rs.pipeline(context), rs.frame_queue(_QUEUED_PAIRS, keep_frames=True)
        with _explained(f"Camera {self.name} ({self.serial}) could not be opened"):
            profile = self._pipeline.start(config, self._queue)
            self._align = rs.align(rs.stream.color)
            info = _camera_info(rs, self.name, self.serial, profile)
            sensors = _sensors(rs, profile)
        self._last_number, self._times = None, None
        try:
            with _explained(f"Camera {self.name} ({self.serial}) could not be set"):
                camera_settings.apply(rs, sensors, self._settings, self.name)
                for _ in range(self._warm_up):
                    self.read(5.0)
                if self._settings.hold:
                    camera_settings.hold(rs, sensors, self.name)
                info = replace(info, settings=camera_settings.read_back(rs, sensors))
        except HardwareError:
            self.close()
            raise
        self._last_number, self.dropped = None, 0
        return info

    def read(self, timeout_s: float) -> CameraFrame:
        """Wait for the next frame, with depth aligned to colour.

        Raises:
            HardwareError: none came within `timeout_s`: the camera is unplugged, or the USB link is overloaded.
        """
        if self._pipeline is None:
            raise HardwareError(f"Camera {self.name} is not open.")
        end = time.monotonic() + timeout_s
        with _explained(f"Camera {self.name} ({self.serial}) failed"):
            while (left := end - time.monotonic()) > 0:
                come, frame = self._queue.try_wait_for_frame(max(1, int(1000 * left)))
                frames = frame.as_frameset() if come and frame.is_frameset() else None
                if frames and frames.get_depth_frame() and frames.get_color_frame():
                    arrival, depth = time.monotonic(), frames.get_depth_frame()
                    if self._is_new(depth.get_frame_number()):
                        return self._timed(_frame(self._align.process(frames)), depth, arrival)
        raise HardwareError(
            f"Camera {self.name} ({self.serial}) delivered no frame for {timeout_s:g} s: unplugged, or its USB link is "
            "overloaded. Use a port (better a controller) of its own for each camera."
        )

    def close(self) -> None:
        """Stop streaming. Further calls have no effect."""
        if self._pipeline is not None:
            pipeline, self._pipeline = self._pipeline, None
            with _explained(f"Camera {self.name} ({self.serial}) could not be closed"):
                pipeline.stop()

    def _timed(self, frame: CameraFrame, depth: Any, arrival_s: float) -> CameraFrame:
        """Convert the stamp to monotonic time. Stamps are in the computer's time of day or the camera's clock."""
        if self._times is None:
            self._times = FrameTimes(
                f"{self.name} ({self.serial})", 1 / self._fps, longest_s=_QUEUED_PAIRS / self._fps + _LONGEST_WAY_S
            )
            if depth.get_frame_timestamp_domain() != import_realsense().timestamp_domain.hardware_clock:
                self._times.tie(monotonic_of_day())
        t = self._times.monotonic(depth.get_frame_number(), frame.time_s, arrival_s)
        return CameraFrame(t, frame.depth, frame.color)

    def _is_new(self, number: int) -> bool:
        """Whether the depth frame is new. The SDK's syncer may pair one depth image with two colour images."""
        if self._last_number is not None:
            if number <= self._last_number:
                return False
            self.dropped += number - self._last_number - 1
        self._last_number = number
        return True


@contextmanager
def play_recording(path: Path, name: str, *, alone: bool = True) -> Iterator[tuple[CameraInfo, Iterator[CameraFrame]]]:
    """Open a recording of the SDK (`.db3`, or an old `.bag`). Yields the camera and its frames, aligned to colour.

    Playback is as fast as frames are consumed, happens once, and drops no frames.

    Args:
        alone: False if times will be compared with those of other cameras.

    Raises:
        HardwareError: the file is missing, not a recording, or lacks depth or colour. Also if it is stamped by the
            camera's own clock and `alone` is False.
    """
    rs = import_realsense()
    if not Path(path).is_file():
        raise HardwareError(f"No such recording: {path}.")
    config, pipeline = rs.config(), rs.pipeline()
    with _explained(f"{path} is not a RealSense recording with depth and colour"):
        # By default, the SDK repeats the file and drops frames that are not consumed in time.
        config.enable_device_from_file(str(path), repeat_playback=False)
        # Pause before the start, until both sensors stream. Otherwise the first frames of one sensor are dropped.
        playback = config.resolve(rs.pipeline_wrapper(pipeline)).get_device().as_playback()
        playback.set_real_time(False)
        playback.pause()
        profile = pipeline.start(config)
        playback.resume()
    try:
        with _explained(f"{path} is not a RealSense recording with depth and colour"):
            serial = profile.get_device().get_info(rs.camera_info.serial_number)
            info = _camera_info(rs, name, serial, profile)
        ended = partial(_has_ended, playback, rs.playback_status.stopped)
        foreign = None if alone else rs.timestamp_domain.hardware_clock
        yield info, _played(pipeline, rs.align(rs.stream.color), ended, path, foreign)
    finally:
        with _explained(f"{path} could not be closed"):
            pipeline.stop()


@contextmanager
def play_recordings(paths: Mapping[str, Path]) -> Iterator[Recording]:
    """Open simultaneous recordings of several cameras (camera name -> path), merged in order of time."""
    with ExitStack() as stack:
        alone = len(paths) == 1
        played = {name: stack.enter_context(play_recording(path, name, alone=alone)) for name, path in paths.items()}
        streams = [_renamed(name, frames) for name, (_, frames) in played.items()]
        merged = heapq.merge(*streams, key=lambda frame: frame.time_s)
        files = ", ".join(Path(path).name for path in paths.values())
        yield Recording({name: info for name, (info, _) in played.items()}, merged, f"RealSense recording {files}")


def _renamed(name: str, frames: Iterator[CameraFrame]) -> Iterator[RecordedFrame]:
    for frame in frames:
        yield RecordedFrame(name, frame.time_s, frame.depth, frame.color)


def _has_ended(playback: Any, stopped: Any) -> bool:
    return bool(playback.current_status() == stopped)


def _played(pipeline: Any, align: Any, ended: Callable[[], bool], path: Path, foreign: Any) -> Iterator[CameraFrame]:
    """Yield the frames of a playback.

    Args:
        foreign: clock domain of stamps that is refused. None accepts all.
    """
    last, waits = -1, 0
    while True:
        at_end = ended()  # ask first, since a frame may arrive between the wait and this question
        come, frames = pipeline.try_wait_for_frames(_PLAYBACK_WAIT_MS)
        waits = 0 if come else waits + 1
        if not come:
            if at_end or waits > _PLAYBACK_PATIENCE:
                return
            continue
        if frames.get_depth_frame() and frames.get_color_frame():
            number = frames.get_depth_frame().get_frame_number()
            if foreign is not None and frames.get_depth_frame().get_frame_timestamp_domain() == foreign:
                raise HardwareError(
                    f"{path} is stamped by the camera's own clock, which has nothing to do with that of another camera: "
                    "recordings of several cameras cannot be brought together. Import each alone, or record with global "
                    "time enabled, which stamps frames with the computer's time."
                )
            if number > last:  # the SDK's syncer may pair one depth image with two colour images
                last = number
                yield _frame(align.process(frames))


def _frame(frames: Any) -> CameraFrame:
    depth, color = frames.get_depth_frame(), frames.get_color_frame()
    # Copy the images, because the SDK reuses its buffers.
    return CameraFrame(depth.get_timestamp() / 1000, np.array(depth.get_data()), np.array(color.get_data()))


def _sensors(rs: Any, profile: Any) -> dict[str, Any]:
    """Return the sensors "depth" and, if it is a separate sensor, "color"."""
    # first_depth_sensor() fails here, since a device that is being recorded has a wrapper without the sensor type.
    found = list(profile.get_device().query_sensors())
    depth = next((sensor for sensor in found if sensor.supports(rs.option.depth_units)), None)
    others = [sensor for sensor in found if not sensor.supports(rs.option.depth_units)]
    return {} if depth is None else {"depth": depth, **({"color": others[0]} if others else {})}


def _camera_info(rs: Any, name: str, serial: str, profile: Any) -> CameraInfo:
    """Describe the camera of a started pipeline. Depth is aligned to colour, so the intrinsics are those of colour."""
    sensors = _sensors(rs, profile)
    if not sensors:
        raise HardwareError(f"Camera {name} ({serial}) states no depth scale: it is not a depth camera.")
    scale = sensors["depth"].get_option(rs.option.depth_units)
    held = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
    models = {
        rs.distortion.none: "none",
        rs.distortion.brown_conrady: "brown_conrady",
        rs.distortion.inverse_brown_conrady: "inverse_brown_conrady",
    }
    if held.model not in models and any(held.coeffs):
        raise HardwareError(f"Camera {name} ({serial}) has the distortion model {held.model}, which is not supported.")
    distorted = any(held.coeffs)
    intrinsics = Intrinsics(
        held.width,
        held.height,
        held.fx,
        held.fy,
        held.ppx,
        held.ppy,
        distortion=models[held.model] if distorted else "none",  # type: ignore[arg-type]  # a str from `models`
        coefficients=tuple(held.coeffs) if distorted else (),
    )
    # Remove the rounding of float32, in which the SDK returns 0.001.
    return CameraInfo(name, serial, intrinsics, float(np.format_float_positional(np.float32(scale), unique=True)))


@contextmanager
def _explained(what: str) -> Iterator[None]:
    """Convert the RuntimeErrors of the SDK to HardwareErrors with a context."""
    try:
        yield
    except RuntimeError as error:
        raise HardwareError(f"{what}: {error}.") from error
