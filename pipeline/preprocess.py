"""`diffcloud preprocess`: clean recorded clouds."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from diffcloud.errors import EpisodeError
from diffcloud.io.episodes import Episode, read_episode, write_episode
from diffcloud.sensing import clean_frame
from pipeline.config import PreprocessConfig, load_config
from pipeline.console import JsonFlag, ParamsFile, episode_files, errors, finish, progress_bar


def preprocess(
    recorded: Annotated[Path, typer.Argument(help="Folder with <scenario>/<episode>.npz.")],
    out: Annotated[Path, typer.Option(help="Folder for the cleaned episodes, same layout.")],
    params: ParamsFile = None,
    json: JsonFlag = False,
) -> None:
    """Crop, remove outliers, thin."""
    config = load_config(params)
    files = [path for name in config.scenarios for path in episode_files([recorded / name])]
    kept: dict[str, Any] = {}
    with progress_bar("preprocess", len(files)) as update:
        for index, path in enumerate(files):
            try:
                episode = _clean(read_episode(path), config.preprocess)
            except EpisodeError as error:
                raise EpisodeError(f"{path}: {error}") from error
            write_episode(out / path.parent.name / path.name, episode)
            kept[path.stem] = {"recorded": episode.meta["quality"]["recorded"], "kept": episode.meta["quality"]["kept"]}
            update(index + 1, path.stem)
    errors.print(f"Cleaned {len(files)} episodes into {out}.")
    finish({"out": str(out), "points": kept}, json)


def _clean(episode: Episode, config: PreprocessConfig) -> Episode:
    if episode.meta.get("noise_free"):  # nothing to clean; thinning would only take what the loss compares with
        config = config.model_copy(update={"outlier_neighbours": 0, "points": None, "crop_m": None})
    rng = np.random.default_rng(config.seed)
    indices, reports = [], []
    for frame in range(episode.frame_count):  # frames are ragged; each is vectorised
        try:
            keep, report = clean_frame(
                episode.frame(frame),
                crop=config.crop_m,
                neighbours=config.outlier_neighbours,
                deviations=config.outlier_deviations,
                limit=config.points,
                rng=rng,
            )
        except EpisodeError as error:
            raise EpisodeError(f"frame {frame}: {error}") from error
        indices.append(keep + episode.offsets[frame])
        reports.append(asdict(report))
    joined = np.concatenate(indices)
    quality = {key: [report[key] for report in reports] for key in reports[0]}
    return replace(
        episode,
        points=episode.points[joined],
        offsets=np.cumsum([0, *(len(index) for index in indices)], dtype=np.int64),
        camera=None if episode.camera is None else episode.camera[joined],
        pixel=None if episode.pixel is None else episode.pixel[joined],
        sigma=None if episode.sigma is None else episode.sigma[joined],
        meta={**episode.meta, "quality": quality},
    )
