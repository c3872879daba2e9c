"""Decode RVL, a lossless compression of depth images (Wilson 2017, "Fast lossless depth image compression").

Runs of pixels without a measurement alternate with runs of measured pixels. A measured pixel is stored as the
difference to the previous one, with the sign in the lowest bit. Numbers are stored in groups of three bits, lowest
first. A fourth bit of each group is set if another group follows. Eight groups fill a 32-bit word from the top.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError

_LARGEST_PIXELS = 64_000_000
_MOST_GROUPS = 10
"""Largest number of groups of one number (30 bits)."""


def decode_rvl(data: bytes, name: str) -> NDArray[np.uint16]:
    """Decode a depth image [H, W].

    Args:
        data: width and height as 32-bit integers, then the RVL code, as in ROS messages.
        name: name of the image, for messages.

    Raises:
        EpisodeError: the data are damaged.
    """
    if len(data) < 8:
        raise EpisodeError(f"An RVL image of {name} has {len(data)} bytes; the recording is damaged.")
    width, height = (int(value) for value in np.frombuffer(data[:8], "<i4"))
    if not (width > 0 and height > 0 and width * height <= _LARGEST_PIXELS):
        raise EpisodeError(f"An RVL image of {name} states {width} x {height} pixels; the recording is damaged.")
    numbers = _numbers(data[8:])
    pixels = np.zeros(width * height, np.uint16)
    measured, coded = [], []
    place = read = 0
    while place < len(pixels) and read + 1 < len(numbers):  # one iteration per run; images have few runs
        place += int(numbers[read])
        count = int(numbers[read + 1])
        if place + count > len(pixels) or read + 2 + count > len(numbers):
            break
        measured.append(np.arange(place, place + count))
        coded.append(numbers[read + 2 : read + 2 + count])
        place, read = place + count, read + 2 + count
    if place != len(pixels):
        read_pixels = f"{min(place, len(pixels))} of {len(pixels)} pixels"
        raise EpisodeError(f"An RVL image of {name} ends after {read_pixels}; it is damaged.")
    signed = np.concatenate([np.zeros(0, np.int64), *coded])
    depth = np.cumsum((signed >> 1) ^ -(signed & 1))
    if depth.size and not (depth.min() >= 0 and depth.max() <= 65535):
        raise EpisodeError(f"An RVL image of {name} holds values beyond 16 bits; it is damaged.")
    pixels[np.concatenate([np.zeros(0, np.int64), *measured])] = depth
    return pixels.reshape(height, width)


def _numbers(code: bytes) -> NDArray[np.int64]:
    """Return all numbers of a code. Padding in the last word gives zeros."""
    words = np.frombuffer(code[: len(code) // 4 * 4], "<u4")
    groups = ((words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)) & 0xF).ravel().astype(np.int64)
    last = np.flatnonzero(groups < 8)
    if not len(last):
        return np.zeros(0, np.int64)
    first = np.concatenate([[0], last[:-1] + 1])
    order = np.arange(last[-1] + 1) - np.repeat(first, last - first + 1)
    # Too many groups are a sign of damage. Their high bits are dropped, so the image then has the wrong size.
    parts = np.where(order < _MOST_GROUPS, (groups[: last[-1] + 1] & 7) << (3 * np.minimum(order, _MOST_GROUPS)), 0)
    return np.add.reduceat(parts, first)
