"""An arm whose calls take their time, and which writes down when each of them reaches it."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from diffcloud.errors import HardwareError
from diffcloud.hardware import ArmReading


class SlowArm:
    """A line for each call that arrives: monotonic time, name. `slow` maps names to the seconds they are on their way."""

    joint_count = 7

    def __init__(self, log: Path, slow: dict[str, float]) -> None:
        self._log, self._slow = log, slow

    def describe(self):
        return {"model": "slow"}

    def _arrives(self, name: str) -> None:
        time.sleep(self._slow.get(name, 0.0))
        with self._log.open("a") as stream:
            stream.write(f"{time.monotonic()} {name}\n")

    def prepare(self):
        self._arrives("prepare")

    def read(self):
        self._arrives("read")
        return ArmReading(np.zeros(7), np.zeros(3), np.array([1.0, 0, 0, 0]), 0.0, np.zeros(6))

    def send_velocity(self, linear_m_s):
        self._arrives("twist")

    def stop(self):
        self._arrives("stop")

    def emergency_stop(self):
        self._arrives("emergency stop")

    def close(self):
        pass


class Unsendable(SlowArm):
    """Its driver returns what cannot be pickled."""

    def read(self):
        return lambda: None


def broken():
    raise HardwareError("No arm answers.")


def crashing():
    raise ZeroDivisionError("a bug")
