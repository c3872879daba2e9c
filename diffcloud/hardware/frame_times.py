"""A camera's timestamps on this computer's monotonic clock.

Drivers stamp frames with the computer's time of day, or with the camera's own counter. The time of day can be set while a
recording runs (by a person, by a time server), backwards or forwards; the monotonic clock cannot, and the arm's log is on
it. So the stamps' clock is tied to it once, and from then on checked against two things that nobody sets: the numbers of
the frames, which cannot come faster than the camera's rate, and the moment of arrival, before which a frame was taken. A
stamp that contradicts them shows that its clock was set, and the clock is tied anew. Changes of less than half a frame's
distance backwards, or `_AHEAD_S` forwards, go unnoticed.
"""

from __future__ import annotations

import time

from diffcloud.errors import HardwareError

_AHEAD_S = 0.05
"""A stamp may lie this far after the frame's arrival: drivers estimate the camera's clock, and the estimate wavers."""


def monotonic_of_day(readings: int = 5) -> float:
    """What is added to the time of day to make it `time.monotonic()` [s], now.

    Of several pairs of readings the closest counts: a thread that is suspended between both clocks, by another one or by
    the system, would put milliseconds between the camera's times and the arm's.
    """

    def one() -> tuple[float, float]:
        before, day, after = time.monotonic(), time.time(), time.monotonic()
        return after - before, (before + after) / 2 - day

    return min(one() for _ in range(readings))[1]


class FrameTimes:
    """Times of one camera's frames.

    Args:
        name: of the camera, for messages.
        period_s: between frames at the set rate, the least there is.
        longest_s: from a frame's stamp to its arrival, with all queues on the way full.
    """

    def __init__(self, name: str, period_s: float, *, longest_s: float) -> None:
        self._name, self._period, self._longest = name, period_s, longest_s
        self._offset: float | None = None
        self._last: tuple[int, float] | None = None
        self.set_count = 0
        """How often the clock of the stamps was found to have been set."""

    def tie(self, offset_s: float) -> None:
        """What is added to stamps; without it, the first frame ties them to its arrival."""
        self._offset = offset_s

    def monotonic(self, number: int, stamp_s: float, arrival_s: float) -> float:
        """time.monotonic() of a frame; rises from frame to frame.

        Args:
            number: the camera's count of frames; rises.
            stamp_s: by the driver's or the camera's clock.
            arrival_s: time.monotonic() when it was handed over.

        Raises:
            HardwareError: the stamp lies seconds before the arrival: it cannot be placed.
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
