"""An arm and a camera in a few lines, for tests of the session itself; Kortex and RealSense have their own."""

from __future__ import annotations

import time

import numpy as np

from diffcloud.errors import HardwareError
from diffcloud.hardware import ArmReading, CameraFrame, ToolTrajectory
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.raw_episodes import CameraInfo

START = np.array([0.5, 0.0, 0.3])
SMALL = Intrinsics(32, 24, 31.0, 31.0, 15.5, 11.5)


def short_path(distance=0.02, seconds=0.2):
    times = np.linspace(0, seconds, 5)
    return ToolTrajectory(times, START + np.linspace(0, distance, 5)[:, None] * [0.0, 0.0, 1.0])


class PointArm:
    """A tool that moves exactly as told. `trouble` maps the number of a reading to what happens then."""

    joint_count = 7

    def __init__(self, trouble=None):
        self.events, self._position, self._velocity = [], START.copy(), np.zeros(3)
        self._time, self.readings, self.trouble = time.monotonic(), 0, trouble or {}
        self.wrench = np.zeros(6)
        self.hold = False

    def describe(self):
        return {"model": "point"}

    def prepare(self):
        self.events.append("prepare")

    def home(self, timeout_s):
        self.events.append("home")

    def _advance(self):
        now = time.monotonic()
        if not self.hold:
            self._position = self._position + self._velocity * (now - self._time)
        self._time = now

    def read(self):
        self._advance()
        self.readings += 1
        if self.readings in self.trouble:
            self.trouble[self.readings](self)
        return ArmReading(np.zeros(7), self._position.copy(), np.array([1.0, 0, 0, 0]), 0.0, self.wrench.copy())

    def send_velocity(self, linear_m_s):
        self._advance()
        self._velocity = np.asarray(linear_m_s)
        self.events.append("twist")

    def set_gripper(self, position):
        self.events.append(f"gripper {position:g}")

    def stop(self):
        self._advance()
        self._velocity = np.zeros(3)
        self.events.append("stop")

    def close(self):
        self.events.append("close")

    @property
    def stopped(self):
        moves = [event for event in self.events if event in ("twist", "stop")]
        return not moves or moves[-1] == "stop"


class TestCard:
    """A camera whose depth tells the frame's number; it can die, and it can lie."""

    __test__ = False

    def __init__(self, name="side", *, fps=100, dies_after=None):
        self.name, self.delivered, self._fps, self._dies_after = name, 0, fps, dies_after
        self.events = []

    def open(self):
        self.events.append("open")
        return CameraInfo(self.name, f"serial-{self.name}", SMALL, 0.001)

    def read(self, timeout_s):
        if self._dies_after is not None and self.delivered >= self._dies_after:
            raise HardwareError(f"Camera {self.name} delivered no frame: unplugged.")
        time.sleep(1 / self._fps)
        self.delivered += 1
        return CameraFrame(time.time(), np.full((24, 32), self.delivered, np.uint16), np.zeros((24, 32, 3), np.uint8))

    def close(self):
        self.events.append("close")
