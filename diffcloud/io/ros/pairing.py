"""Order the images of a ROS camera in time, and assign colour images to depth images.

All stamps are read before the first image is written. Messages that arrived out of order are sorted. A clock that was
set back is an error. Each depth image gets the nearest colour image in time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffcloud.errors import EpisodeError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_LATEST_S = 0.5
"""Largest delay of a message in a network. An older stamp means that the clock was changed."""
_PAIR_S = (0.02, 0.05)
"""Limits of the time tolerance between colour and depth. Within 50 ms, the cloth's edge may move by centimetres."""


@dataclass(frozen=True)
class Pairing:
    """The frames of one camera in order of time, as message numbers in order of arrival."""

    times: Floats
    """[T] stamps of the depth images [s]."""
    depths: Integers
    """[T] number of the depth message."""
    colors: Integers
    """[T] number of the colour message, -1 for none."""
    warnings: tuple[str, ...]


def pair(camera: str, depth_topic: str, depth_s: ArrayLike, color_s: ArrayLike | None) -> Pairing:
    """Sort depth images and assign a colour image to each.

    The tolerance is half a frame interval of the slower stream, limited to 20 to 50 ms.

    Args:
        depth_s: stamps of the depth images in order of arrival [s].
        color_s: stamps of the colour images that are aligned to depth. None if there is no such stream.

    Raises:
        EpisodeError: a stamp is more than half a second older than an earlier message's.
    """
    warnings: list[str] = []
    stamps = np.array(depth_s)
    depths, late = sorted_stamps(depth_topic, stamps)
    if late:
        warnings.append(f"Camera {camera}: {late} of {len(stamps)} depth images arrived out of order; they were sorted.")
    if len(depths) < len(stamps):
        warnings.append(
            f"Camera {camera}: {len(stamps) - len(depths)} of {len(stamps)} depth images have the stamp of another; only "
            "the first of each was taken."
        )
    times = stamps[depths]
    colors = np.full(len(depths), -1)
    sent = None if color_s is None else np.array(color_s, dtype=np.float64)
    if sent is not None and not len(sent):
        warnings.append(f"Camera {camera}: its colour topic has no message, so no frame has colour.")
    elif sent is not None:
        colors, off, tolerance = nearest(times, sent)
        lost = colors < 0
        if lost.any():
            warnings.append(
                f"Camera {camera}: {int(lost.sum())} of {len(times)} frames have no colour. The nearest colour image is "
                f"{1000 * np.median(off[lost]):.0f} ms away (median), and {1000 * tolerance:.0f} ms are allowed (half a "
                f"frame interval, between {1000 * _PAIR_S[0]:.0f} and {1000 * _PAIR_S[1]:.0f}): the streams were not "
                "synchronised, or images were lost."
            )
    return Pairing(times, depths, colors, tuple(warnings))


def nearest(times: Floats, sent: Floats) -> tuple[Integers, Floats, float]:
    """Find the message of another stream that is nearest to each time.

    Args:
        times: [T] in order [s].
        sent: [N] stamps of the messages in any order [s], one or more.

    Returns:
        [T] numbers of the messages, -1 where the nearest is farther than the tolerance; [T] how far it is; the tolerance,
        half a frame interval of the slower stream, within 20 and 50 ms.
    """
    tolerance = _tolerance_s(times, np.sort(sent))
    order = np.argsort(sent, kind="stable")
    clock = sent[order]
    after = np.searchsorted(clock, times).clip(0, len(clock) - 1)
    before = (after - 1).clip(0)
    chosen = np.where(np.abs(clock[before] - times) < np.abs(clock[after] - times), before, after)
    off = np.abs(clock[chosen] - times)
    return np.where(off <= tolerance, order[chosen], -1), off, tolerance


def sorted_stamps(topic: str, stamps: Floats) -> tuple[Integers, int]:
    """Return message numbers sorted by stamp without duplicate stamps, and the number of messages that arrived late."""
    youngest = np.maximum.accumulate(stamps)
    behind = youngest - stamps
    worst = int(behind.argmax())
    if behind[worst] > _LATEST_S:
        first = int(np.flatnonzero(behind > _LATEST_S)[0])
        raise EpisodeError(
            f"{topic}: message {first + 1} is stamped {behind[first]:.2f} s before one that came earlier "
            f"({stamps[first]:.6f} s after {youngest[first]:.6f} s). The clock was set back while recording, or a "
            "recording was played into this one: cut the recording there, and import the pieces."
        )
    order = np.argsort(stamps, kind="stable")
    once = np.concatenate([[True], np.diff(stamps[order]) > 0])
    return order[once], int((behind > 0).sum())


def _tolerance_s(depth: Floats, color: Floats) -> float:
    intervals = [float(np.median(np.diff(times))) for times in (depth, color) if len(times) > 1]
    return float(np.clip(0.5 * max(intervals, default=0.0), *_PAIR_S))
