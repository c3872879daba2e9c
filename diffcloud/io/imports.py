"""Import other recordings as episodes: the published data, and folders of cloud files."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EmptyCloudError, EpisodeError
from diffcloud.io.clouds import FORMATS, read_cloud
from diffcloud.io.episodes import Episode
from diffcloud.io.files import folders_in
from diffcloud.io.frame_names import NamedFrames, named_frames
from diffcloud.io.grippers import read_tracks
from diffcloud.io.pickles import load_npy

RELEASE_FRAME_TIME = 0.04
"""Time step of the published scenes [s]."""
RELEASE_FOLDERS = {
    "lift": ("lift_real_pcls", 1),
    "fold": ("fold_real_pcls", 1),
    "band": ("band_sim_pcls", 0),
    "hang": ("hang_sim_pcls", 0),
}
"""Motion -> (folder, number of steps before file 0). In real recordings, file j belongs to the state after j + 1 steps,
as in the published scripts. Simulated recordings start with the initial state, so file j belongs to the state after j
steps. The published scripts are one step off there."""
ASSUMED_CATEGORIES = {
    "polka": "highly deformable",
    "navy": "medium",
    "tan": "medium",
    "redblack": "shape retaining",
    "paper": "shape retaining",
}
"""Fabric -> category. The paper does not state this assignment; it is our interpretation of the text and figures."""
_MODELS = ("mlp", "pointnet2", "meteornet")
_MOST_NAMED = 5
"""Largest number of empty frames that a message lists."""
_SAME_STEP = 0.5
"""Tolerance between times in a CSV and times in file names (fraction of a frame interval)."""


def release_episodes(folder: Path) -> Iterator[tuple[str, str, Episode]]:
    """Yield (scenario, name, episode) for each recording in the published folder layout.

    Args:
        folder: folder with `lift_real_pcls/` and similar folders. Missing ones are skipped.

    Raises:
        EpisodeError: none of the folders exists, or a file is damaged.
    """
    folder = Path(folder)
    found = {name: folder / sub for name, (sub, _) in RELEASE_FOLDERS.items() if (folder / sub).is_dir()}
    if not found:
        expected = ", ".join(sub for sub, _ in RELEASE_FOLDERS.values())
        raise EpisodeError(f"{folder} holds none of {expected}; give the folder of the published data that does.")
    for scenario, source in found.items():
        predictions = {model: _table(source / f"preds_{model}.npy") for model in _MODELS}
        truth = _table(source / "gt.npy")
        for episode in folders_in(source):
            meta: dict[str, Any] = {"scenario": f"release_{scenario}", "source": "published data"}
            meta |= _fabric(episode.name, scenario)
            meta["predictions"] = {
                model: _pair(table[episode.name]) for model, table in predictions.items() if episode.name in table
            }
            if episode.name in truth:
                meta["truth"] = _pair(truth[episode.name])
            frames = [read_cloud(path) for path in named_frames(episode, (".npy",), kind="clouds").paths]
            times = RELEASE_FRAME_TIME * (np.arange(len(frames), dtype=np.float64) + RELEASE_FOLDERS[scenario][1])
            yield f"release_{scenario}", episode.name, Episode.from_frames(frames, times, meta=meta)


def cloud_folder(
    folder: Path,
    *,
    grippers: Mapping[str, Path] | None = None,
    rate_hz: float | None = None,
    meta: dict[str, Any] | None = None,
) -> Episode:
    """Build an episode from a folder of numbered clouds, one file per frame.

    Args:
        folder: files `<anything><number>.(npy|ply|xyz|pcd)` [m] in the scene's frame. The numbers are frame numbers
            without gaps, or times (`io.frame_names`).
        grippers: gripper name -> CSV file (see `io.grippers`).
        rate_hz: frame rate, if neither a CSV nor the file names have times.

    Raises:
        EpisodeError: clouds are missing, damaged or empty, frame numbers have gaps, a CSV does not match, or times
            contradict each other.
    """
    frames, empty = [], []
    named = named_frames(Path(folder), tuple(FORMATS), kind="clouds")
    named.check_rate(rate_hz, Path(folder))
    for number, path in zip(named.numbers, named.paths, strict=True):
        try:
            frames.append(read_cloud(path))
        except EmptyCloudError:
            empty.append(number)
    if empty:
        first = ", ".join(map(str, empty[:_MOST_NAMED])) + (" and more" if len(empty) > _MOST_NAMED else "")
        raise EpisodeError(
            f"{folder}: {len(empty)} of {len(empty) + len(frames)} clouds are empty (frames {first}). Every frame needs "
            "points of the cloth: lower the height below which points were cut off, or leave these frames out and renumber "
            "the others."
        )
    stamps = named.times if named.times is not None or rate_hz is None else np.arange(len(frames)) / rate_hz
    tracks = read_tracks(grippers, len(frames), stamps) if grippers else None
    times = _times(named, None if tracks is None else tracks.times, rate_hz, Path(folder))
    about = {"source": "clouds", **(meta or {})}
    if tracks is None:
        return Episode.from_frames(frames, times, meta=about)
    return Episode.from_frames(frames, times, gripper=tracks.positions, grippers=tracks.names, meta=about)


def _times(
    named: NamedFrames, stated: NDArray[np.float64] | None, rate_hz: float | None, folder: Path
) -> NDArray[np.float64]:
    """[T] times since the first frame [s]: from a CSV, from the file names, or from the frame rate, in this order."""
    if named.times is not None:
        own = named.times - named.times[0]
        if stated is not None and len(own) > 1 and np.abs(stated - own).max() > _SAME_STEP * np.median(np.diff(own)):
            worst = int(np.abs(stated - own).argmax())
            raise EpisodeError(
                f"{folder}: the file names are times, and the gripper's t_s disagrees: {named.paths[worst].name} is "
                f"{own[worst]:.4g} s after the first frame, and its row says {stated[worst]:.4g} s. Correct t_s, or rename "
                "the files to frame numbers (000, 001, ...) to use t_s alone."
            )
        return own if stated is None else stated
    if stated is not None:
        return stated
    if rate_hz is None or not 0 < rate_hz < math.inf:
        raise EpisodeError("Frame times are unknown: give --rate-hz, or a gripper CSV with a t_s column.")
    return np.asarray(np.arange(len(named.paths)) / rate_hz)


def _table(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {}
    value = load_npy(path)
    if not isinstance(value, dict):
        raise EpisodeError(f"{path} must hold a dictionary of episodes, got {type(value).__name__}.")
    return {str(key): entry for key, entry in value.items()}


def _pair(value: Any) -> dict[str, float]:
    pair = np.asarray(value, dtype=np.float64).reshape(-1)
    if pair.shape != (2,) or not np.isfinite(pair).all():
        raise EpisodeError(f"A published parameter pair must be two finite numbers (stretching, density), got {value!r}.")
    return {"stretching": float(pair[0]), "density": float(pair[1])}


def _fabric(name: str, scenario: str) -> dict[str, Any]:
    match = re.fullmatch(rf"{scenario}_([a-z]+?)(\d*)", name)
    if match is None:
        return {}
    fabric = match.group(1)
    known = {"category": ASSUMED_CATEGORIES[fabric], "category_assumed": True} if fabric in ASSUMED_CATEGORIES else {}
    return {"fabric": fabric, "repeat": int(match.group(2) or 1), **known}
