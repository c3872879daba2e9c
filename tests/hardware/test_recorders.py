"""What is queued is written, whenever a signal comes."""

from __future__ import annotations

import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace

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
        self.rows, self.times = 0, []

    def add_robot(self, *samples):
        self.rows += len(samples)

    def add_frame(self, name, t_s, depth, color):
        self.times.append(t_s)


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


class Stamped(TestCard):
    """Frames of given times [s], at once; then it waits to be ended."""

    def __init__(self, times):
        super().__init__()
        self._times, self._start = list(times), time.monotonic()

    def read(self, timeout_s):
        if self.delivered == len(self._times):
            time.sleep(0.01)
            raise HardwareError("no more")
        frame = super().read(timeout_s)
        return replace(frame, time_s=self._start + self._times[self.delivered - 1])


class StuckCard(TestCard):
    """Its driver does not come back until it is let go."""

    def __init__(self):
        super().__init__()
        self.go = threading.Event()

    def read(self, timeout_s):
        self.go.wait()
        raise HardwareError("unplugged")


@pytest.mark.parametrize(
    ("fps", "frames_hz", "kept"),
    [(30, 10, range(0, 30, 3)), (10, 10, range(10)), (60, 20, range(0, 60, 3)), (10, 30, range(10)),
     (30, None, range(30))],
)  # fmt: skip
def test_frames_are_thinned_by_their_times(fps, frames_hz, kept):
    """Stamps tremble by 2 ms, as those of a camera do."""
    times = 0.1 + np.arange(kept[-1] + 1) / fps + np.random.default_rng(0).uniform(-2e-3, 2e-3, kept[-1] + 1)
    np.testing.assert_allclose(written(times, frames_hz), times[list(kept)], atol=5e-3)


def test_a_rate_that_does_not_divide_the_cameras_is_kept_on_average():
    assert len(written(0.1 + np.arange(30) / 30, 20.0)) in (19, 20, 21)


def test_a_gap_is_not_made_up_for():
    times = [0.1, 0.2, 0.3, 0.7, 0.733, 0.766, 0.8, 0.833]
    np.testing.assert_allclose(written(times, 10.0), [0.1, 0.2, 0.3, 0.7, 0.8], atol=5e-3)


def written(times, frames_hz):
    """Those of the frames that come to the writer."""
    writer = Rows()
    recorders = Recorders([Stamped(times)], writer, Clock(), frames_hz=frames_hz, camera_timeout_s=1.0, with_arm=False)
    recorders.start()
    recorders._cameras[0]._taker.join(5.0)
    recorders.finish()
    return writer.times


def finished(recorders):
    """Whether everything queued gets written: not where a lock is still held that the interrupted call had taken."""
    ending = threading.Thread(target=recorders.finish, daemon=True)
    ending.start()
    ending.join(5.0)
    return not ending.is_alive()


def recording(*cameras, timeout_s=1.0):
    writer = Rows()
    recorders = Recorders(cameras, writer, Clock(), frames_hz=None, camera_timeout_s=timeout_s, with_arm=True)
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
