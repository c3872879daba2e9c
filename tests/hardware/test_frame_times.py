"""Frames keep their places in time, whatever is done to the clock that stamps them."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.errors import HardwareError
from diffcloud.hardware.frame_times import FrameTimes, monotonic_of_day

PERIOD = 1 / 30
WAY = 0.03
"""From a frame to its arrival."""


def placed(frames, *, wall=lambda t: t + 1e9, arrival=lambda t: t + WAY, tied=True):
    """(times found, FrameTimes) of frames (number, true monotonic time) that are stamped with `wall`."""
    times = FrameTimes("side", PERIOD, longest_s=3.0)
    if tied:
        times.tie(-wall(0.0))
    return np.array([times.monotonic(number, wall(t), arrival(t)) for number, t in frames]), times


def regular(count=60):
    return [(number, 100 + number * PERIOD) for number in range(count)]


def true(frames):
    return np.array([t for _, t in frames])


def test_a_suspension_between_both_clocks_moves_nothing(monkeypatch):
    """Time passes only where it is read, and once, for 4 ms, between the readings of the two clocks."""
    now, naps = [100.0], iter([0.0, 0.004, 0.0, 0.0, 0.0])

    def day():
        now[0] += next(naps)
        return now[0] + 1e9

    monkeypatch.setattr("diffcloud.hardware.frame_times.time.monotonic", lambda: now[0])
    monkeypatch.setattr("diffcloud.hardware.frame_times.time.time", day)
    assert monotonic_of_day() == pytest.approx(-1e9, abs=1e-6)


def test_a_clock_that_nobody_sets_is_believed():
    jittered = [(number, t + 0.004 * (-1) ** number) for number, t in regular()]
    found, times = placed(jittered)
    np.testing.assert_allclose(found, true(jittered), atol=1e-6)
    assert times.set_count == 0


@pytest.mark.parametrize("change", [-3600.0, -5.0, -0.2, 0.2, 5.0, 3600.0])
def test_a_clock_that_is_set_while_it_runs(change):
    frames = regular()
    found, times = placed(frames, wall=lambda t: t + 1e9 + (change if t > 101 else 0))
    np.testing.assert_allclose(found, true(frames), atol=1e-6)
    assert times.set_count == 1


def test_frames_that_were_lost_leave_their_gap():
    frames = [frame for frame in regular() if frame[0] % 7 not in (3, 4, 5)]
    found, times = placed(frames, wall=lambda t: t - 40 + (-0.3 if t > 101 else 0))
    np.testing.assert_allclose(found, true(frames), atol=1e-6)
    assert times.set_count == 1


def test_a_camera_that_pauses_or_slows_down_is_no_clock_that_was_set():
    """Its numbers go on by one: a longer exposure, or a counter that does not count what was not taken."""
    steps = np.array([1, 1, 1, 2, 2, 2, 40, 1, 1]) * PERIOD
    frames = [(number, t) for number, t in enumerate(100 + np.cumsum(steps))]
    found, times = placed(frames)
    np.testing.assert_allclose(found, true(frames), atol=1e-6)
    assert times.set_count == 0


def test_frames_that_waited_in_a_queue_keep_their_time():
    """The reader was busy for a second; then 30 frames arrive at once."""
    frames = regular()
    found, times = placed(frames, arrival=lambda t: max(t + WAY, 102.0) if t > 101 else t + WAY)
    np.testing.assert_allclose(found, true(frames), atol=1e-6)
    assert times.set_count == 0


def test_a_camera_with_a_counter_of_its_own_is_tied_by_its_first_frame():
    frames = regular()
    found, _ = placed(frames, wall=lambda t: t - 99.5, tied=False)
    np.testing.assert_allclose(found, true(frames) + WAY, atol=1e-6)


def test_times_never_run_backwards():
    rng = np.random.default_rng(0)
    frames = regular(300)
    changes = dict(zip(rng.integers(0, 300, 30), rng.uniform(-4, 4, 30), strict=True))
    total, shift = 0.0, []
    for number, _ in frames:
        total += changes.get(number, 0.0)
        shift.append(total)
    found, _ = placed(frames, wall=lambda t: t + 1e9 + (shift[round((t - 100) / PERIOD)] if t else 0.0))
    assert (np.diff(found) > 0).all()
    np.testing.assert_allclose(found, true(frames), atol=WAY + 0.05)


def test_stamps_that_cannot_be_placed_are_refused():
    times = FrameTimes("side", PERIOD, longest_s=3.0)
    times.tie(-10.0)
    with pytest.raises(HardwareError, match=r"Camera side: its frames are stamped 10\.0 s before they arrive"):
        times.monotonic(1, 100.0, 100.0)
