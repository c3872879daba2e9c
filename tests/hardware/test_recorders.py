"""What is queued is written, whenever a signal comes."""

from __future__ import annotations

import sys
import threading
import time
from contextlib import suppress

import numpy as np
import pytest

from diffcloud.errors import HardwareError
from diffcloud.hardware import ArmReading
from diffcloud.hardware.recorders import Clock, Recorders
from tests.hardware.simulated import TestCard

READING = ArmReading(np.zeros(7), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), 0.0, np.zeros(6))


class Rows:
    """A writer that only counts."""

    def __init__(self):
        self.rows = 0

    def add_robot(self, *samples):
        self.rows += len(samples)

    def add_frame(self, *frame):
        pass


class InterruptedAt:
    """Raises KeyboardInterrupt before the n-th instruction of the block's Python functions, as a signal would."""

    def __init__(self, number):
        self.left, self.reached = number, False

    def __enter__(self):
        sys.settrace(self._trace)
        return self

    def __exit__(self, kind, *_):
        sys.settrace(None)
        return kind is KeyboardInterrupt

    def _trace(self, frame, event, _):
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        if event == "opcode" and frame.f_code is not InterruptedAt.__exit__.__code__:
            self.left -= 1
            if self.left < 0:
                self.reached = True
                sys.settrace(None)
                raise KeyboardInterrupt
        return self._trace


class StuckCard(TestCard):
    """Its driver does not come back until it is let go."""

    def __init__(self):
        super().__init__()
        self.go = threading.Event()

    def read(self, timeout_s):
        self.go.wait()
        raise HardwareError("unplugged")


def finished(recorders):
    """Whether everything queued gets written: not where a lock is still held that the interrupted call had taken."""
    ending = threading.Thread(target=recorders.finish, daemon=True)
    ending.start()
    ending.join(5.0)
    return not ending.is_alive()


def recording(*cameras, timeout_s=1.0):
    writer = Rows()
    recorders = Recorders(cameras, writer, Clock(), keep_every=1, camera_timeout_s=timeout_s, with_arm=True)
    recorders.start()
    return recorders, writer


def test_an_interrupt_while_a_row_is_queued_loses_that_row_at_most():
    number = 0
    while True:
        recorders, writer = recording()
        recorders.add_reading(0.0, READING)
        with InterruptedAt(number) as interrupt:
            recorders.add_reading(0.1, READING)
        assert finished(recorders), f"hangs when interrupted before instruction {number}"
        if not interrupt.reached:
            break
        assert writer.rows in (1, 2)
        number += 1
    assert writer.rows == 2
    assert number > 10


def test_an_interrupt_while_cameras_are_told_to_end_leaves_them_to_be_told_again():
    """A signal at the end of the trajectory; they are told again after Stop."""
    number = 0
    while True:
        recorders, _ = recording(TestCard(fps=1000))
        camera = recorders._cameras[0]
        with InterruptedAt(number) as interrupt:
            camera.end()
        assert finished(recorders), f"hangs when interrupted before instruction {number}"
        if not interrupt.reached:
            break
        number += 1
    assert number > 1


@pytest.mark.parametrize("call", ["raise_failure", "wait"])
def test_an_interrupt_while_failures_are_looked_for_leaves_later_ones_to_be_told(call):
    """A driver has hung, which is noticed in the control loop's thread; then its camera, and the disk, fail in theirs."""
    number = 0
    while True:
        card = StuckCard()
        recorders, writer = recording(card, timeout_s=0.0)
        camera = recorders._cameras[0]
        camera._asked = time.monotonic() - 10.0
        with InterruptedAt(number) as interrupt, suppress(HardwareError):
            recorders.raise_failure() if call == "raise_failure" else recorders.wait(0.001)
        card.go.set()
        camera._taker.join(5.0)
        assert not camera._taker.is_alive(), f"hangs when interrupted before instruction {number}"
        writer.add_robot = None  # calling it raises
        recorders.add_reading(0.0, READING)
        assert finished(recorders), f"hangs when interrupted before instruction {number}"
        with pytest.raises(HardwareError):
            recorders.raise_failure()
        if not interrupt.reached:
            break
        number += 1
    assert number > 10
