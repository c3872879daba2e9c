"""Frames that lie in files named by number: by frame number, or by time.

The last number of a name counts: `frame_000123_1.5.ply` is 1.5. What the numbers of a folder mean is decided for all of
them together:

- With a decimal point in any name, or a date and a time of day: times, in seconds.
- Whole or decimal numbers of the size of a time since 1970 (years 1990 to 2100): times, in seconds, milliseconds,
  microseconds or nanoseconds, whichever unit gives such a year.
- Other whole numbers: frame numbers.
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
"""A hyphen is a minus only where no letter or digit stands before it: frame-0001 is frame 1."""
_DATE_TIME = re.compile(
    r"(?<!\d)((?:19|20)\d\d)-?(\d\d)-?(\d\d)[T_ -](\d\d)[-:_](\d\d)[-:_](\d\d)(?:[.,_](\d{1,9})(?!\d))?"
)
_SECONDS_NANOSECONDS = re.compile(r"(?<!\d)(\d{9,10})[_-](\d{9})$")
"""ROS tools write the two parts of a stamp so."""
_EPOCH_S = (631_152_000, 4_102_444_800)
"""1990 to 2100 [s since 1970]."""
_UNITS = {"seconds": 0, "milliseconds": 3, "microseconds": 6, "nanoseconds": 9}
_MOST_FRAMES = 100_000_000
_LEAST_HZ, _MOST_HZ = 0.01, 1000.0
"""Frame rates from a slow time-lapse to a fast simulation. Others mean that the numbers are no times in seconds."""
_SAME_RATE = 0.05
"""Part by which a stated rate may differ from that of the times in names, which may be rounded."""


@dataclass(frozen=True)
class NamedFrames:
    """Files of a folder in the order of their numbers."""

    paths: tuple[Path, ...]
    numbers: tuple[int, ...]
    """[N] Of the frames; 0, 1, ... where the names are times."""
    times: NDArray[np.float64] | None
    """[N] Times that the names state [s], since 1970 or since any other moment; None where names are frame numbers."""

    @property
    def rate_hz(self) -> float | None:
        """Of the names' times (median); None without them, and of a single frame."""
        if self.times is None or len(self.times) < 2:
            return None
        return float(1 / np.median(np.diff(self.times)))

    def check_rate(self, rate_hz: float | None, folder: Path) -> None:
        """
        Raises:
            EpisodeError: a stated frame rate [Hz] contradicts the times in the names.
        """
        own = self.rate_hz
        if rate_hz is not None and own is not None and not abs(own / rate_hz - 1) < _SAME_RATE:
            raise EpisodeError(
                f"{folder}: the file names are times, {self.paths[0].name} to {self.paths[-1].name}, at {own:.4g} frames a "
                f"second, but --rate-hz says {rate_hz:g}. Leave --rate-hz out to use the names' times, or rename the files "
                "to frame numbers (000, 001, ...) to use the rate."
            )


def named_frames(folder: Path, formats: tuple[str, ...], *, kind: str, gaps: bool = False) -> NamedFrames:
    """Data files of a folder in the order of the numbers in their names. Files without a number are left out.

    Args:
        formats: suffixes, in lower case.
        kind: of file, for messages, such as "clouds".
        gaps: whether frame numbers may be missing.

    Raises:
        EpisodeError: no such folder or file, two files of one number, frame numbers that are missing, or numbers that are
            neither frames nor plausible times.
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
    """(number of a name, None without one; whether its form says that it is a time [s])."""
    match = _DATE_TIME.search(stem)
    if match is not None:
        *parts, fraction = match.groups()
        try:
            whole = int(datetime(*map(int, parts), tzinfo=UTC).timestamp())  # type: ignore[arg-type, misc]
        except ValueError:
            pass  # no date
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
    if gaps:  # not each number in them
        missing = [number for before, after in gaps[:10] for number in range(before + 1, min(after, before + 11))][:10]
        raise EpisodeError(
            f"{folder}: frames {missing} are missing between {numbers[0]} and {numbers[-1]}; renumber or record again. If "
            "the names are times in another unit than seconds, number the files and give the times in a CSV with t_s."
        )
