"""Convert a camera's time stamps to this computer's monotonic clock.

Drivers stamp frames with the computer's time of day or with the camera's own counter. A person or a time server may set
the time of day during a recording. The monotonic clock of the arm's log cannot be set. So the offset between both
clocks is measured once and then checked. Frames cannot be faster than the camera's rate, and cannot arrive before they
are taken. If a stamp contradicts this, its clock was set, and the offset is measured again. Changes of less than half a
frame interval backwards, or `_AHEAD_S` forwards, are not noticed.
"""

from __future__ import annotations

import time

from diffcloud.errors import HardwareError

_AHEAD_S = 0.05
"""Tolerance for stamps after the arrival of the frame, since drivers only estimate the camera's clock."""


def monotonic_of_day(readings: int = 5) -> float:
    """Return the current offset from the time of day to `time.monotonic()` [s].

    The closest of several pairs of readings is used. If the thread is suspended between the two readings of a pair, the
    offset is wrong by milliseconds.
    """

    def one() -> tuple[float, float]:
        before, day, after = time.monotonic(), time.time(), time.monotonic()
        return after - before, (before + after) / 2 - day

    return min(one() for _ in range(readings))[1]


class FrameTimes:
    """Converts the time stamps of one camera's frames.

    Args:
        name: name of the camera, for messages.
        period_s: frame interval at the configured rate.
        longest_s: longest possible time from a frame's stamp to its arrival, if all queues are full.
    """

    def __init__(self, name: str, period_s: float, *, longest_s: float) -> None:
        self._name, self._period, self._longest = name, period_s, longest_s
        self._offset: float | None = None
        self._last: tuple[int, float] | None = None
        self.set_count = 0
        """Number of times that the clock of the stamps was found to have been set."""

    def tie(self, offset_s: float) -> None:
        """Set the offset that is added to stamps. Without it, the first frame's arrival defines the offset."""
        self._offset = offset_s

    def monotonic(self, number: int, stamp_s: float, arrival_s: float) -> float:
        """Return the `time.monotonic()` of a frame. Results increase from frame to frame.

        Args:
            number: frame number of the camera, increasing.
            stamp_s: stamp by the clock of the driver or camera.
            arrival_s: `time.monotonic()` when the frame was received.

        Raises:
            HardwareError: the stamp is seconds before the arrival, so the time is unknown.
        """
        if self._offset is None:
            self._offset = arrival_s - stamp_s
        t = stamp_s + self._offset
        expected = arrival_s
        set_back = False
        if self._last is not None:
            distance = (number - self._last[0]) * self._period
            expected = min(self._last[1] + distance, max(arrival_s + _AHEAD_S, self._last[1] + distance / 2))
            set_back = t - self._last[1] < distance / 2
        if set_back or t > arrival_s + _AHEAD_S:
            t = expected
            self._offset = t - stamp_s
            self.set_count += 1
        if arrival_s - t > self._longest:
            raise HardwareError(
                f"Camera {self._name}: its frames are stamped {arrival_s - t:.1f} s before they arrive; its clock, or this "
                "computer's, does not run evenly."
            )
        self._last = (number, t)
        return t
