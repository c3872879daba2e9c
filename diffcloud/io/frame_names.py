"""Order files of frames by the number in their names, which is a frame number or a time.

The last number of a name is used: `frame_000123_1.5.ply` gives 1.5. All names in a folder are interpreted alike:

- Times in seconds, if any name has a decimal point, or a date with time of day.
- Times since 1970, if all numbers give years 1990 to 2100 in seconds, milliseconds, microseconds or nanoseconds.
- Frame numbers, if the numbers are other whole numbers.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError
from diffcloud.io.files import files_in

_NUMBER = re.compile(r"(?:(?<![^\W_])-)?\d+(?:\.\d+)?(?:[eE][+-]\d+)?")
"""A hyphen is a minus sign only if no letter or digit precedes it: frame-0001 is frame 1."""
_DATE_TIME = re.compile(
    r"(?<!\d)((?:19|20)\d\d)-?(\d\d)-?(\d\d)[T_ -](\d\d)[-:_](\d\d)[-:_](\d\d)(?:[.,_](\d{1,9})(?!\d))?"
)
_SECONDS_NANOSECONDS = re.compile(r"(?<!\d)(\d{9,10})[_-](\d{9})$")
"""Matches a ROS time stamp written as seconds and nanoseconds."""
_EPOCH_S = (631_152_000, 4_102_444_800)
"""Years 1990 to 2100 [s since 1970]."""
_UNITS = {"seconds": 0, "milliseconds": 3, "microseconds": 6, "nanoseconds": 9}
_MOST_FRAMES = 100_000_000
_LEAST_HZ, _MOST_HZ = 0.01, 1000.0
"""Plausible frame rates, from time-lapse to fast simulation. Other numbers cannot be times in seconds."""
_SAME_RATE = 0.05
"""Tolerance between a stated frame rate and the rate of times in names, which may be rounded (fraction)."""


@dataclass(frozen=True)
class NamedFrames:
    """Files of a folder in the order of their numbers."""

    paths: tuple[Path, ...]
    numbers: tuple[int, ...]
    """[N] frame numbers, or 0, 1, ... if names are times."""
    times: NDArray[np.float64] | None
    """[N] times in the names [s] from an arbitrary start. None if names are frame numbers."""

    @property
    def rate_hz(self) -> float | None:
        """Median frame rate of the times in names. None without times, or for a single frame."""
        if self.times is None or len(self.times) < 2:
            return None
        return float(1 / np.median(np.diff(self.times)))

    def check_rate(self, rate_hz: float | None, folder: Path) -> None:
        """Compare a stated frame rate [Hz] with the times in the names.

        Raises:
            EpisodeError: they contradict each other.
        """
        own = self.rate_hz
        if rate_hz is not None and own is not None and not abs(own / rate_hz - 1) < _SAME_RATE:
            raise EpisodeError(
                f"{folder}: the file names are times, {self.paths[0].name} to {self.paths[-1].name}, at {own:.4g} frames a "
                f"second, but --rate-hz says {rate_hz:g}. Leave --rate-hz out to use the names' times, or rename the files "
                "to frame numbers (000, 001, ...) to use the rate."
            )


def named_frames(folder: Path, formats: tuple[str, ...], *, kind: str, gaps: bool = False) -> NamedFrames:
    """List the files of a folder in the order of the numbers in their names. Files without a number are skipped.

    Args:
        formats: suffixes in lower case.
        kind: kind of files, for messages, such as "clouds".
        gaps: allow missing frame numbers.

    Raises:
        EpisodeError: the folder or files are missing, two files have one number, frame numbers are missing, or numbers
            are neither frame numbers nor plausible times.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise EpisodeError(f"No such folder of {kind}: {folder}.")
    found: dict[Decimal, Path] = {}
    are_times = False
    for path in files_in(folder, *formats):
        value, is_time = _number(path.stem)
        if value is None:
            continue
        are_times |= is_time
        if value in found:
            what = f"of the time {value} s" if is_time else f"frame {value}"
            raise EpisodeError(f"{folder}: {found[value].name} and {path.name} are both {what}; keep one of them.")
        found[value] = path
    if not found:
        raise EpisodeError(f"{folder} holds no numbered {kind} ({', '.join(formats)}), such as 000{formats[0]}.")
    values = sorted(found)
    paths = tuple(found[value] for value in values)
    unit = next((name for name, digits in _UNITS.items() if _is_since_1970(values, digits)), None)
    if unit is not None:
        values = [value.scaleb(-_UNITS[unit]) for value in values]
    elif not are_times and values[-1] <= _MOST_FRAMES:
        numbers = tuple(int(value) for value in values)
        if not gaps:
            _refuse_gaps(numbers, folder)
        return NamedFrames(paths, numbers, None)
    frames = NamedFrames(paths, tuple(range(len(paths))), np.array([float(value) for value in values]))
    if (unit is None and abs(values[-1]) > _MOST_FRAMES) or not _LEAST_HZ <= (frames.rate_hz or 1.0) <= _MOST_HZ:
        raise EpisodeError(
            f"{folder}: the names {paths[0].name} to {paths[-1].name} are neither frame numbers nor times of a recording. "
            f"Times are decimal seconds, or whole seconds, milliseconds, microseconds or nanoseconds since 1970, at "
            f"{_LEAST_HZ:g} to {_MOST_HZ:g} frames a second. Number the files in order from 0, and give the times by "
            "--rate-hz or in a CSV with t_s."
        )
    return frames


def _number(stem: str) -> tuple[Decimal | None, bool]:
    """Return the number in a file name (or None), and whether its form shows that it is a time [s]."""
    match = _DATE_TIME.search(stem)
    if match is not None:
        *parts, fraction = match.groups()
        try:
            whole = int(datetime(*map(int, parts), tzinfo=UTC).timestamp())  # type: ignore[arg-type, misc]
        except ValueError:
            pass  # not a valid date
        else:
            return whole + Decimal(f"0.{fraction or 0}"), True
    match = _SECONDS_NANOSECONDS.search(stem)
    if match is not None and _EPOCH_S[0] <= int(match[1]) < _EPOCH_S[1]:
        return Decimal(f"{match[1]}.{match[2]}"), True
    texts = _NUMBER.findall(stem)
    return (Decimal(texts[-1]), not texts[-1].lstrip("-").isdecimal()) if texts else (None, False)


def _is_since_1970(values: list[Decimal], digits: int) -> bool:
    low, high = (Decimal(bound).scaleb(digits) for bound in _EPOCH_S)
    return low <= values[0] and values[-1] < high


def _refuse_gaps(numbers: tuple[int, ...], folder: Path) -> None:
    gaps = [(before, after) for before, after in pairwise(numbers) if after > before + 1]
    if gaps:  # list only the first missing numbers, since a gap may be huge
        missing = [number for before, after in gaps[:10] for number in range(before + 1, min(after, before + 11))][:10]
        raise EpisodeError(
            f"{folder}: frames {missing} are missing between {numbers[0]} and {numbers[-1]}; renumber or record again. If "
            "the names are times in another unit than seconds, number the files and give the times in a CSV with t_s."
        )
