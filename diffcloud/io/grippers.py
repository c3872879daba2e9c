"""Read gripper tracks from CSV files: one file for all grippers, or one file each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError
from diffcloud.io.episodes import ONLY_GRIPPER
from diffcloud.io.tables import numbers, read_csv

_AXES = ["x", "y", "z"]
_FARTHEST_M = 20.0
_SAME_TIME_S = 1e-4
_BEYOND_S = 0.2
"""By how much clouds may begin before a track of another rate, or end after it: the gripper stands still there."""


@dataclass(frozen=True)
class GripperTracks:
    """Positions of G grippers in T frames."""

    names: tuple[str, ...]
    """[G]"""
    positions: NDArray[np.float64]
    """[T, G, 3] [m]"""
    times: NDArray[np.float64] | None
    """[T] since the first frame [s]. None if the files have no column t_s."""


def tracks_beside(folder: Path) -> dict[str, Path]:
    """Find the tracks in a folder of clouds: `gripper.csv`, or one `gripper_NAME.csv` for each of several grippers.

    Returns:
        Gripper name -> CSV file.

    Raises:
        EpisodeError: there is no track, only one of several, or both kinds.
    """
    single, several = folder / "gripper.csv", sorted(folder.glob("gripper_*.csv"))
    if single.is_file() and not several:
        return {ONLY_GRIPPER[0]: single}
    if len(several) > 1 and not single.is_file():
        return {path.stem.removeprefix("gripper_"): path for path in several}
    if not several:
        raise EpisodeError(
            f"{folder} holds no gripper.csv with the columns t_s, x, y, z [m], one row per frame. For several grippers, "
            "give one file each, such as gripper_left.csv and gripper_right.csv."
        )
    found = ", ".join(path.name for path in (*filter(Path.is_file, [single]), *several))
    raise EpisodeError(
        f"{folder} holds {found}. A single gripper has gripper.csv, and each of several has gripper_NAME.csv. Add the "
        "missing track, or rename the file."
    )


def read_tracks(files: Mapping[str, Path], frames: int, stamps: NDArray[np.float64] | None = None) -> GripperTracks:
    """Read the tracks of one or several grippers.

    Args:
        files: gripper name -> CSV file with columns x, y, z [m] and optionally t_s [s]. It has one row per frame, or, with
            t_s and `stamps`, rows at any rate, which are interpolated. A single file may hold several grippers: it has a
            column `gripper`, and one row per frame and gripper.
        frames: number of frames T.
        stamps: [T] times of the clouds, on the clock of t_s [s].

    Raises:
        EpisodeError: a file is not readable, columns or rows are missing, positions are not in metres, or times differ.
    """
    tables = {
        name: read_csv(path, kind="gripper file", error=EpisodeError, text=("gripper",)) for name, path in files.items()
    }
    if len(files) == 1:
        (path,), (table,) = files.values(), tables.values()
        if "gripper" in table.columns:
            tables = {str(name): rows for name, rows in table.groupby("gripper", sort=False)}
            files = dict.fromkeys(tables, path)
    elif any("gripper" in table.columns for table in tables.values()):
        raise EpisodeError("A CSV with a column gripper holds all grippers: give this file alone, or one file each.")
    positions, times = [], None
    for name, table in tables.items():
        place = str(files[name]) if len(tables) == 1 else f"{files[name]}, gripper {name!r}"
        track = numbers(table, _AXES, place=place, error=EpisodeError)
        own = numbers(table, ["t_s"], place=place, error=EpisodeError)[:, 0] if "t_s" in table.columns else None
        if len(track) != frames:
            track, own = _interpolated(track, own, frames, stamps, place), stamps
        extent = float(np.ptp(track, axis=0).max())
        if extent > _FARTHEST_M:
            raise EpisodeError(f"{place}: the gripper moves by {extent:.0f}; positions are metres, not millimetres.")
        positions.append(track)
        if own is not None:
            if times is not None and np.abs(own - times).max() > _SAME_TIME_S:
                raise EpisodeError(
                    f"{place}: its times differ from those of the other grippers. Give one row per frame, with the same "
                    "times for all grippers."
                )
            times = own
    return GripperTracks(tuple(tables), np.stack(positions, axis=1), None if times is None else times - times[0])


def _interpolated(
    track: NDArray[np.float64],
    times: NDArray[np.float64] | None,
    frames: int,
    stamps: NDArray[np.float64] | None,
    place: str,
) -> NDArray[np.float64]:
    """[frames, 3] a track of another rate at the times of the clouds.

    Raises:
        EpisodeError: times that are unknown, that do not increase, or that do not cover the clouds.
    """
    if times is None or stamps is None:
        raise EpisodeError(
            f"{place} has {len(track)} rows for {frames} clouds. Give one row per frame, or a column t_s and clouds whose "
            "names are times on the same clock."
        )
    if (np.diff(times) < 0).any():
        raise EpisodeError(f"{place}: t_s decreases after row {int(np.argmax(np.diff(times) < 0))}; sort the rows by time.")
    if stamps[0] < times[0] - _BEYOND_S or stamps[-1] > times[-1] + _BEYOND_S:
        raise EpisodeError(
            f"{place} covers {times[0]:.3f} to {times[-1]:.3f} s, and the clouds {stamps[0]:.3f} to {stamps[-1]:.3f} s. "
            f"Clouds may lie at most {_BEYOND_S:g} s beyond the track. Give both on one clock, and leave out other clouds."
        )
    return np.stack([np.interp(stamps, times, column) for column in track.T], axis=1)


def named_files(given: list[str]) -> dict[str, Path]:
    """Parse NAME=PATH arguments, or a single PATH, into gripper name -> file.

    Raises:
        EpisodeError: a name is missing or occurs twice.
    """
    if len(given) == 1 and "=" not in given[0]:
        return {ONLY_GRIPPER[0]: Path(given[0])}
    pairs = [one.partition("=") for one in given]
    names = [name for name, _, _ in pairs]
    if not all(name and path for name, _, path in pairs) or len(set(names)) < len(names):
        raise EpisodeError(f"Give each gripper's file as NAME=PATH, each name once; got {', '.join(given)}.")
    return {name: Path(path) for name, _, path in pairs}
