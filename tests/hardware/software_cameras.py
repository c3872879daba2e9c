"""RealSense software devices: D435s without hardware, driven through the SDK's own pipeline."""

from __future__ import annotations

import threading
import time

import numpy as np

from diffcloud.hardware.frame_times import monotonic_of_day

WIDTH, HEIGHT, FPS = 424, 240, 60
FX, FY, CX, CY = 256.0, 256.0, 212.0, 120.0
_LEAD_S = 0.25
"""Before the first frame: a capture may feed cameras when it says that it records, and then starts its clock."""
DEPTH_SCALE = 1 / 64
"""Short binary fractions: with them the SDK's alignment, which computes in float32 and rounds down, has no rounding error,
so that depth can be compared bit by bit. With others it moves one pixel in ten by one. The scale also has six decimals,
which is what the SDK's recordings keep."""


OPTIONS = {
    "depth": {
        "enable_auto_exposure": (0, 1, 1), "exposure": (1, 165000, 8500), "gain": (16, 248, 16),
        "emitter_enabled": (0, 2, 1), "laser_power": (0, 360, 150), "visual_preset": (0, 6, 0),
        "inter_cam_sync_mode": (0, 2, 0),
    },
    "color": {
        "enable_auto_exposure": (0, 1, 1), "exposure": (1, 10000, 156), "enable_auto_white_balance": (0, 1, 1),
        "white_balance": (2800, 6500, 4600),
    },
}  # fmt: skip
"""Sensor -> option -> lowest, highest and usual value."""
_NOISE = np.random.default_rng(0).integers(20, 120, (HEIGHT, WIDTH)).astype(np.uint16)


def numbered_depth(number: int, seed: int = 0) -> np.ndarray:
    """uint16 [H, W]: noise from 0.3 to 1.9 m, with the frame's number in the first pixel."""
    depth = np.roll(_NOISE, (11 * number, 7 * number + 3 * seed), (0, 1))
    depth[0, 0] = number
    return depth


class SoftwareD435:
    """One camera in a context.

    Args:
        baseline_m: of colour to the depth sensor; 0 makes alignment the identity, so that depth can be compared bit by bit.
        settable: with the options of a D435 (`OPTIONS`), which software devices lack.
        domain: of the stamps, in `rs.timestamp_domain`.
    """

    _uid = 100

    def __init__(
        self,
        rs,
        context,
        serial: str,
        *,
        baseline_m: float = 0.0,
        depth_scale: float = DEPTH_SCALE,
        seed: int = 0,
        settable: bool = False,
        domain: str = "system_time",
    ) -> None:
        self._rs, self.serial, self._seed, self._scale = rs, serial, seed, depth_scale
        self._domain = getattr(rs.timestamp_domain, domain)
        self._device = rs.software_device()
        self._device.register_info(rs.camera_info.serial_number, serial)
        self._device.register_info(rs.camera_info.name, "Intel RealSense D435")
        self._depth_sensor, self._color_sensor = (
            self._device.add_sensor("Stereo Module"),
            self._device.add_sensor("RGB Camera"),
        )
        self._depth_sensor.add_read_only_option(rs.option.depth_units, depth_scale)
        self._depth_sensor.add_read_only_option(rs.option.stereo_baseline, 50.0)
        self.sensors = {"depth": self._depth_sensor, "color": self._color_sensor}
        for kind, options in OPTIONS.items() if settable else ():
            for name, (low, high, default) in options.items():
                span = rs.option_range()
                span.min, span.max, span.step, span.default = low, high, 1.0, default
                self.sensors[kind].add_option(getattr(rs.option, name), span, True)
                self.sensors[kind].set_option(getattr(rs.option, name), default)
        self._depth_profile = self._depth_sensor.add_video_stream(self._stream(rs.stream.depth, rs.format.z16, 2))
        self._color_profile = self._color_sensor.add_video_stream(self._stream(rs.stream.color, rs.format.rgb8, 3))
        for first, second, shift in (
            (self._depth_profile, self._color_profile, baseline_m),
            (self._color_profile, self._depth_profile, -baseline_m),
        ):
            place = rs.extrinsics()
            place.rotation, place.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [shift, 0, 0]
            first.register_extrinsics_to(second, place)
        self._device.create_matcher(rs.matchers.default)
        self._kept = []  # the SDK does not copy what it is given
        self._device.add_to(context)

    def _stream(self, kind, form, bytes_per_pixel):
        rs = self._rs
        SoftwareD435._uid += 1  # unique per process
        stream = rs.video_stream()
        stream.type, stream.index, stream.uid, stream.fmt = kind, 0, SoftwareD435._uid, form
        stream.width, stream.height, stream.fps, stream.bpp = WIDTH, HEIGHT, FPS, bytes_per_pixel
        held = rs.intrinsics()
        held.width, held.height, held.fx, held.fy, held.ppx, held.ppy = WIDTH, HEIGHT, FX, FY, CX, CY
        held.model, held.coeffs = rs.distortion.none, [0.0] * 5
        stream.intrinsics = held
        return stream

    def push(self, number: int, depth: np.ndarray, color: np.ndarray, time_ms: float) -> None:
        rs = self._rs
        for sensor, profile, pixels, width in (
            (self._depth_sensor, self._depth_profile, depth, 2),
            (self._color_sensor, self._color_profile, color, 3),
        ):
            frame = rs.software_video_frame()
            frame.pixels, frame.stride, frame.bpp = pixels, WIDTH * width, width
            frame.timestamp, frame.domain = time_ms, self._domain
            frame.frame_number, frame.profile = number, profile.as_video_stream_profile()
            if width == 2:
                frame.depth_units = self._scale
            self._kept = [*self._kept[-8:], pixels]
            sensor.on_video_frame(frame)

    def push_numbered(self, number: int, time_ms: float) -> None:
        """The number-th noise image, with a colour that tells the number."""
        color = np.full((HEIGHT, WIDTH, 3), number % 256, np.uint8)
        self.push(number, numbered_depth(number, self._seed), color, time_ms)


class Cameras:
    """Two software D435s in one context, fed by a thread until `stop`, or one of them until it dies."""

    SERIALS = ("111111111111", "222222222222")

    def __init__(self, rs, *, interval_s: float = 1 / FPS, **options) -> None:
        self.context = rs.context()
        self._devices = []  # the context loses devices whose list is collected
        self.context.set_devices_changed_callback(lambda change: self._devices.append(change.get_new_devices()))
        self.cameras = [
            SoftwareD435(rs, self.context, serial, seed=index, **options) for index, serial in enumerate(self.SERIALS)
        ]
        self._interval = interval_s
        self.pushed = 0
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    def feed(self, *, count: int | None = None, dies_after: int | None = None) -> None:
        """Push pairs in the background; the second camera falls silent after `dies_after`."""

        def run() -> None:
            start = time.monotonic() + _LEAD_S
            while not self._ending.is_set() and (count is None or self.pushed < count):
                number = self.pushed + 1
                self._ending.wait(max(start + number * self._interval - time.monotonic(), 0.001))
                # what the driver's clock says at that moment, which is the time of day
                stamp = start + number * self._interval - monotonic_of_day()
                for index, camera in enumerate(self.cameras):
                    if index == 0 or dies_after is None or number <= dies_after:
                        camera.push_numbered(number, 1000 * stamp)
                self.pushed = number

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
