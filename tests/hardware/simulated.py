"""An arm and a camera in a few lines, for tests of the session itself; Kortex and RealSense have their own."""

from __future__ import annotations

import time

import numpy as np

from diffcloud.errors import HardwareError
from diffcloud.hardware import ArmReading, CameraFrame, ToolTrajectory
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.raw_episodes import CameraInfo
from diffcloud.sensing.robot import GEN3_HOME_RAD
from tests.hardware.gen3_body import Gen3Body, home_pose, quaternion

START = np.array([0.6, 0.0, 0.3])
SMALL = Intrinsics(32, 24, 31.0, 31.0, 15.5, 11.5)


def short_path(distance=0.02, seconds=0.4):
    times = np.linspace(0, seconds, 5)
    return ToolTrajectory(times, START + np.linspace(0, distance, 5)[:, None] * [0.0, 0.0, 1.0])


class PointArm:
    """A tool that moves exactly as told. `trouble` maps the number of a reading, counted from the first velocity on, to
    what happens then."""

    joint_count = 7

    def __init__(self, trouble=None):
        self.events, self._position, self._velocity = [], START.copy(), np.zeros(3)
        self._rotation = home_pose()[:3, :3]
        self._body, self._turning = Gen3Body(), np.zeros(7)
        self._body.move_tool(START, self._rotation)
        self._time, self.readings, self.trouble = time.monotonic(), 0, trouble or {}
        self.wrench = np.zeros(6)
        self.hold = False
        self.gripper = 0.0

    def describe(self):
        return {"model": "point"}

    def clear_faults(self):
        self.events.append("clear")

    def prepare(self):
        self.events.append("prepare")

    def home_joints(self):
        return GEN3_HOME_RAD.copy()

    def _advance(self):
        now = time.monotonic()
        if not self.hold and self._turning.any():
            self._body.joints = self._body.joints + self._turning * (now - self._time)
            self._position, self._rotation = self._body.pose[:3, 3], self._body.pose[:3, :3]
        elif not self.hold:
            self._position = self._position + self._velocity * (now - self._time)
        self._time = now

    def read(self):
        self._advance()
        if {"twist", "turn"} & set(self.events):
            self.readings += 1
            if self.readings in self.trouble:
                self.trouble[self.readings](self)
        joints = self._body.move_tool(self._position, self._rotation)
        return ArmReading(joints, self._position.copy(), quaternion(self._rotation), self.gripper, self.wrench.copy())

    def send_velocity(self, linear_m_s):
        self._advance()
        self._velocity, self._turning = np.asarray(linear_m_s), np.zeros(7)
        self.events.append("twist")

    def send_joint_velocity(self, rad_s):
        self._advance()
        self._turning = np.asarray(rad_s)
        self.events.append("turn")

    def set_gripper(self, position):
        self.gripper = position
        self.events.append(f"gripper {position:g}")

    def stop(self):
        self._advance()
        self._velocity, self._turning = np.zeros(3), np.zeros(7)
        self.events.append("stop")

    def halt(self):
        self.events.append("halt")

    def emergency_stop(self):
        self.events.append("emergency stop")

    def close(self):
        self.events.append("close")

    @property
    def stopped(self):
        moves = [event for event in self.events if event in ("twist", "turn", "stop")]
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
        moment = time.monotonic()
        return CameraFrame(moment, np.full((24, 32), self.delivered, np.uint16), np.zeros((24, 32, 3), np.uint8))

    def close(self):
        self.events.append("close")
