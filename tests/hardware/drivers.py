"""Drivers with one fault each, for the conformance tests; and cameras."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from diffcloud.errors import HardwareError
from diffcloud.hardware.examples.simulated_ur5e import SimulatedUR5e
from diffcloud.io.images import write_color, write_depth
from tests.hardware.simulated import TestCard


class InDegrees(SimulatedUR5e):
    def read(self):
        reading = super().read()
        return replace(reading, joints_rad=np.rad2deg(reading.joints_rad))


class InMillimetres(SimulatedUR5e):
    def read(self):
        reading = super().read()
        return replace(reading, tool_position_m=1000 * reading.tool_position_m)


class ScalarFirst(SimulatedUR5e):
    """Gives (x, y, z, w) where (w, x, y, z) is asked for."""

    def read(self):
        reading = super().read()
        return replace(reading, tool_quaternion=np.roll(reading.tool_quaternion, -1))


class Twisted(SimulatedUR5e):
    def read(self):
        return replace(super().read(), wrench=np.array([0.0, 0.0, 0.0, 0.0, 0.0, 8.0]))


class Slow(SimulatedUR5e):
    def read(self):
        time.sleep(0.05)
        return super().read()


class InTheToolsFrame(SimulatedUR5e):
    """The tool looks down."""

    def send_velocity(self, linear_m_s):
        super().send_velocity(np.array(linear_m_s) * [1.0, -1.0, -1.0])


class HardlyStopping(SimulatedUR5e):
    """A Stop that takes half a second to be carried out."""

    def stop(self):
        threading.Timer(0.5, super().stop).start()


class NoArm:
    def read(self):
        pass


class Dated(TestCard):
    """Stamps are the time of day."""

    def read(self, timeout_s):
        return replace(super().read(timeout_s), time_s=time.time())


class Metres(TestCard):
    def read(self, timeout_s):
        frame = super().read(timeout_s)
        return replace(frame, depth=frame.depth.astype(np.float32) / 1000)


class Undead(TestCard):
    """Delivers after it was closed, as all test cards do."""


class Silent(TestCard):
    def read(self, timeout_s):
        if self.delivered >= 3:
            time.sleep(timeout_s)
            raise HardwareError(f"no frame for {timeout_s:g} s")
        return super().read(timeout_s)


def write_images(folder: Path, ending: threading.Event, *, shape: tuple[int, int], rate_hz: float = 30.0) -> None:
    """Until told to end: depth of 0.8 m and a colour image, first under other names."""
    number = 0
    while not ending.wait(1 / rate_hz):
        name = f"{number:06d}.png"
        write_color(folder / "color" / name, np.full((*shape, 3), number % 256, np.uint8))
        write_depth(folder / "depth" / name, np.full(shape, 800 + number % 7, np.uint16))
        number += 1
