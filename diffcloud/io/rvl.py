"""RVL, a lossless code for depth images (Wilson 2017, "Fast lossless depth image compression").

Runs of pixels without a measurement alternate with runs of measured ones. Each measured pixel is stored as its difference
from the one before, with the sign in the lowest bit. All numbers are written in groups of three bits, the lowest first,
each with a fourth bit that says whether another group follows; eight such groups fill a 32-bit word from the top.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError

_LARGEST_PIXELS = 64_000_000
_MOST_GROUPS = 10
"""Of one number: thirty bits."""


def decode_rvl(data: bytes, name: str) -> NDArray[np.uint16]:
    """Depth [H, W].

    Args:
        data: width and height as 32-bit integers, then the code, as ROS sends it.
        name: of the image, for messages.

    Raises:
        EpisodeError: damaged.
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
    while place < len(pixels) and read + 1 < len(numbers):  # one step for each run, of which an image has few
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
    """All numbers of a code; the padding of the last word gives zeros."""
    words = np.frombuffer(code[: len(code) // 4 * 4], "<u4")
    groups = ((words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)) & 0xF).ravel().astype(np.int64)
    last = np.flatnonzero(groups < 8)
    if not len(last):
        return np.zeros(0, np.int64)
    first = np.concatenate([[0], last[:-1] + 1])
    order = np.arange(last[-1] + 1) - np.repeat(first, last - first + 1)
    # numbers of too many groups are damage; their high bits fall away, and what follows does not fit
    parts = np.where(order < _MOST_GROUPS, (groups[: last[-1] + 1] & 7) << (3 * np.minimum(order, _MOST_GROUPS)), 0)
    return np.add.reduceat(parts, first)
