"""What `diffcloud view` shows of a recording before a fit: the scene that `fit` would find, and what looks wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import DiffCloudError, EpisodeError
from diffcloud.identification import found_cloth, found_layout
from diffcloud.io.clouds import FORMATS
from diffcloud.io.episodes import Episode
from diffcloud.io.files import files_in
from diffcloud.io.grippers import tracks_beside
from diffcloud.io.imports import cloud_folder
from diffcloud.scene.scenarios import Scenario
from diffcloud.scene.scenarios.catalogue import make_scenario, own_options

_RATE_HZ = 10.0
"""Frame rate of a folder of clouds that states no times."""
_FEW, _LONG = 0.4, 1.6
"""Points of a frame, and time between two frames, relative to the median, from which they look wrong."""
_FASTEST_M_S = 2.0
"""Speed of the gripper, above which its track looks wrong."""
_BELOW_M = 0.02
_BEYOND = 1.3
"""Reach of the cloth from the gripper, relative to its diagonal."""
_PART = 0.01
"""Part of a frame's points, from which they look wrong."""


def is_cloud_folder(path: Path) -> bool:
    return not files_in(path, ".npz") and any(files_in(path, suffix) for suffix in FORMATS)


def cloud_recording(path: Path) -> tuple[Episode, list[str]]:
    """Read a folder of numbered clouds, with its tracks if there are any. Return the episode and what is missing.

    Raises:
        EpisodeError: a damaged cloud or track.
    """
    if any(path.glob("gripper*.csv")):
        return cloud_folder(path, grippers=tracks_beside(path)), []
    try:
        return cloud_folder(path), []
    except EpisodeError as error:
        if "Frame times are unknown" not in str(error):
            raise
        return cloud_folder(path, rate_hz=_RATE_HZ), [f"No frame times were found. This page assumes {_RATE_HZ:g} Hz."]


def proposed_scene(episode: Episode, name: str) -> tuple[Scenario | None, list[str]]:
    """Return the scene that `fit` would find in a recording, and sentences on what looks wrong.

    The scene is None if `fit` would refuse the recording. Then the first sentence says why.
    """
    problems, scenario, table = list[str](), None, None
    size: tuple[float, float] = (np.inf, np.inf)
    try:
        cloth: dict[str, Any] = {key: one.value for key, one in found_cloth([episode]).items()}
        size = (cloth["size_m"][0], cloth["size_m"][1])
        layout = found_layout(episode, cloth)
        fields: dict[str, Any] = cloth | {key: one.value for key, one in layout.fields.items()}
        table = fields.get("table_height_m")
        scenario = make_scenario(own_options(fields, name, f"scene of {name}", folder=Path()))
        problems += [f"{text[0].upper()}{text[1:]}." for text in layout.warnings]
    except DiffCloudError as error:
        problems.append(str(error))
    return scenario, [*problems, *_odd_frames(episode), *_odd_points(episode, table, float(np.hypot(*size)))]


def _odd_frames(episode: Episode) -> list[str]:
    """Return sentences on frames with few points, on gaps in time, and on jumps of the gripper."""
    found, counts = [], np.diff(episode.offsets)
    middle = float(np.median(counts))
    few = np.flatnonzero(counts < _FEW * middle)
    if len(few):
        found.append(
            f"{_frames(few)} {'has' if len(few) == 1 else 'have'} few points (least {counts[few].min()}, median "
            f"{middle:.0f}). Was the cloth hidden or cropped?"
        )
    steps = np.diff(episode.times)
    gaps = np.flatnonzero(steps > _LONG * np.median(steps)) if len(steps) else few[:0]
    if len(gaps):
        found.append(
            f"{steps[gaps].max():.2f} s pass after frame {gaps[steps[gaps].argmax()]}, usually {np.median(steps):.2f} s. "
            "Frames may be missing."
        )
    if episode.gripper is not None and len(steps):
        speeds = np.linalg.norm(np.diff(episode.gripper, axis=0), axis=-1).max(axis=1) / steps
        if speeds.max() > _FASTEST_M_S:
            found.append(
                f"The gripper moves at {speeds.max():.1f} m/s after frame {speeds.argmax()}. Check the unit and "
                "the frame of gripper.csv."
            )
    return found


def _odd_points(episode: Episode, table_m: float | None, diagonal_m: float) -> list[str]:
    """Return sentences on points below the table, and on points that the held cloth cannot reach."""
    found = []
    frames = range(episode.frame_count)
    if table_m is not None:
        below = [float((episode.frame(one)[:, 2] < table_m - _BELOW_M).mean()) for one in frames]
        found += _odd_part(below, f"points more than {100 * _BELOW_M:.0f} cm below the table. Remove them, or correct z.")
    if episode.gripper is not None and np.isfinite(diagonal_m):
        grippers = [episode.gripper[one].mean(axis=0) for one in frames]
        far = [
            float((np.linalg.norm(episode.frame(one) - gripper, axis=1) > _BEYOND * diagonal_m).mean())
            for one, gripper in zip(frames, grippers, strict=True)
        ]
        found += _odd_part(far, "points farther from the gripper than the cloth reaches. Do they belong to something else?")
    return found


def _odd_part(parts: list[float], what: str) -> list[str]:
    odd = np.flatnonzero(np.array(parts) > _PART)
    most = f" (up to {100 * max(parts):.0f} %)" if len(odd) else ""
    return [f"{_frames(odd)}{most}: {what}"] if len(odd) else []


def _frames(numbers: NDArray[np.int64]) -> str:
    """Name up to three frames."""
    more = f" and {len(numbers) - 3} more" if len(numbers) > 3 else ""
    return f"Frame{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers[:3]))}{more}"
