"""RealSense depth cameras: live, recorded, and played back.

The package pyrealsense2 is imported when a camera is opened. Everything takes an `rs.context`, so that the same code runs
on software devices: no camera is needed to test it. Depth is aligned to colour, since masks and calibration live in the
colour image; no filter of the SDK is applied, since an episode keeps what was measured.
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
"""The SDK keeps so many for us; a pipeline without a queue of its own keeps one, and drops the rest when we are late."""
_LONGEST_WAY_S = 3.0
"""From the camera to that queue."""
_PLAYBACK_WAIT_MS = 100
_PLAYBACK_PATIENCE = 50
"""Waits without a frame, while the file is not at its end."""


def import_realsense() -> Any:
    """pyrealsense2, with libusb found where the system has none.

    Raises:
        HardwareError: it cannot be imported; says what to install.
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
    """Name, serial, firmware and USB type of each camera that is plugged in.

    Raises:
        HardwareError: the library cannot be imported, or cannot look for cameras.
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
    except RuntimeError as error:  # of the library: no home folder, or no access to USB
        raise HardwareError(
            f"The RealSense library cannot look for cameras ({error}). Set HOME to a folder that exists, and check the "
            "udev rules."
        ) from error
    found = [{key: device.get_info(info) for key, info in fields.items() if device.supports(info)} for device in devices]
    return sorted(found, key=lambda device: device.get("serial", ""))


class RealSenseCamera:
    """A live camera, opened by its serial number.

    Args:
        name: the camera's name in the episode.
        context: an `rs.context`; None for the computer's own.
        fps: of the camera (a D435 knows 6, 15, 30 and 60).
        record_to: also write the SDK's own recording (`.db3`), which keeps depth as it was before alignment.
        warm_up: pairs dropped at the start, while exposure settles.
        settings: exposure, laser, preset and pace.
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
        """Frames that the camera numbered and nobody received."""

    def open(self) -> CameraInfo:
        """Start streaming.

        Raises:
            HardwareError: not connected, busy, or without such a stream; lists what is connected.
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
        """The next pair, depth aligned to colour.

        Raises:
            HardwareError: none came within `timeout_s`: unplugged, or the USB link is overloaded.
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
        """Stop streaming; harmless twice."""
        if self._pipeline is not None:
            pipeline, self._pipeline = self._pipeline, None
            with _explained(f"Camera {self.name} ({self.serial}) could not be closed"):
                pipeline.stop()

    def _timed(self, frame: CameraFrame, depth: Any, arrival_s: float) -> CameraFrame:
        """Stamps are in the computer's time of day or, of some drivers, in the camera's own, which the first frame ties."""
        if self._times is None:
            self._times = FrameTimes(
                f"{self.name} ({self.serial})", 1 / self._fps, longest_s=_QUEUED_PAIRS / self._fps + _LONGEST_WAY_S
            )
            if depth.get_frame_timestamp_domain() != import_realsense().timestamp_domain.hardware_clock:
                self._times.tie(monotonic_of_day())
        t = self._times.monotonic(depth.get_frame_number(), frame.time_s, arrival_s)
        return CameraFrame(t, frame.depth, frame.color)

    def _is_new(self, number: int) -> bool:
        """The syncer may pair one depth image with two colour images; only the first counts."""
        if self._last_number is not None:
            if number <= self._last_number:
                return False
            self.dropped += number - self._last_number - 1
        self._last_number = number
        return True


@contextmanager
def play_recording(path: Path, name: str, *, alone: bool = True) -> Iterator[tuple[CameraInfo, Iterator[CameraFrame]]]:
    """A recording of the SDK (`.db3`, or an old `.bag`): the camera, and its frames with depth aligned to colour.

    Plays as fast as the frames are taken, once, without dropping any.

    Args:
        alone: otherwise its times will be compared with those of other cameras.

    Raises:
        HardwareError: missing, not a recording, without depth and colour, or stamped by the camera's own clock though it is
            not alone.
    """
    rs = import_realsense()
    if not Path(path).is_file():
        raise HardwareError(f"No such recording: {path}.")
    config, pipeline = rs.config(), rs.pipeline()
    with _explained(f"{path} is not a RealSense recording with depth and colour"):
        # from here on the SDK would repeat the file and drop what is not taken in time, unless told otherwise
        config.enable_device_from_file(str(path), repeat_playback=False)
        # before the start, and paused until both sensors stream, or the first frames of one are already dropped
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
    """Recordings of several cameras that ran together, by the camera's name, merged in order of time."""
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
    """
    Args:
        foreign: the domain of stamps that is refused; None where all are good.
    """
    last, waits = -1, 0
    while True:
        at_end = ended()  # asked first: a frame may come between the wait and the question
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
            if number > last:  # the syncer may pair one depth image with two colour images
                last = number
                yield _frame(align.process(frames))


def _frame(frames: Any) -> CameraFrame:
    depth, color = frames.get_depth_frame(), frames.get_color_frame()
    # copies: the SDK takes its buffers back
    return CameraFrame(depth.get_timestamp() / 1000, np.array(depth.get_data()), np.array(color.get_data()))


def _sensors(rs: Any, profile: Any) -> dict[str, Any]:
    """depth, and color where it is a sensor of its own."""
    # not first_depth_sensor(): the wrapper around a device that is being recorded does not know its kind
    found = list(profile.get_device().query_sensors())
    depth = next((sensor for sensor in found if sensor.supports(rs.option.depth_units)), None)
    others = [sensor for sensor in found if not sensor.supports(rs.option.depth_units)]
    return {} if depth is None else {"depth": depth, **({"color": others[0]} if others else {})}


def _camera_info(rs: Any, name: str, serial: str, profile: Any) -> CameraInfo:
    """Of a started pipeline; depth is aligned to colour, so the intrinsics are those of colour."""
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
        distortion=models[held.model] if distorted else "none",  # type: ignore[arg-type]  # str, of the literals above
        coefficients=tuple(held.coeffs) if distorted else (),
    )
    # 0.001 arrives as a float32
    return CameraInfo(name, serial, intrinsics, float(np.format_float_positional(np.float32(scale), unique=True)))


@contextmanager
def _explained(what: str) -> Iterator[None]:
    """The SDK raises RuntimeError for everything."""
    try:
        yield
    except RuntimeError as error:
        raise HardwareError(f"{what}: {error}.") from error
