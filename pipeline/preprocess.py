"""`diffcloud preprocess`: raw episodes to clouds, and clouds to clean ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from diffcloud.errors import ConfigError, EpisodeError
from diffcloud.io.calibrations import Calibration, read_calibration
from diffcloud.io.episodes import Episode, read_episode, write_episode
from diffcloud.io.files import files_in, folders_in, together
from diffcloud.io.images import write_color
from diffcloud.io.raw_episodes import RawEpisode, read_description, read_raw_episode
from diffcloud.sensing.filters import clean_frame
from diffcloud.sensing.fusion import Seen, fuse
from diffcloud.sensing.masking import RobotMask
from diffcloud.sensing.pictures import cloud_picture, mask_picture
from diffcloud.sensing.robot import Robot, gen3
from pipeline.config import PreprocessConfig, RawConfig, load_config, updated
from pipeline.console import JsonFlag, ParamsFile, Workers, episode_files, errors, finish, warn, writes
from pipeline.workers import Tell, run_all


@writes()
def preprocess(
    recorded: Annotated[
        Path,
        typer.Argument(help="Holds <scenario>/<episode> (.npz or raw); or one raw episode, or a folder of them."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the cleaned episodes: <scenario>/<episode>.npz.")],
    urdf: Annotated[Path | None, typer.Option(help="The robot of raw episodes; without it, as params say.")] = None,
    mask: Annotated[bool, typer.Option(help="Take the robot out of raw episodes.")] = True,
    calibration: Annotated[Path | None, typer.Option(help="Calibration file for the cameras of raw episodes.")] = None,
    workers: Workers = None,
    params: ParamsFile = None,
    json: JsonFlag = False,
) -> None:
    """Raw episodes: depth to points, robot and table out, views merged. All episodes: crop, remove outliers, thin."""
    config = load_config(params)
    raw = updated(config.preprocess.raw, robot=None if urdf is None else str(urdf))
    settings = updated(config.preprocess, raw=raw)
    if not mask:
        settings = settings.model_copy(update={"raw": settings.raw.model_copy(update={"robot": None})})
    sources = _sources(recorded.absolute(), config.scenarios)  # "." has no name
    calibrated = None if calibration is None else read_calibration(calibration)
    if any(path.is_dir() for _, path in sources):
        robot_mask(settings.raw)  # a robot that cannot be read must not cost an episode's time
    jobs = [PreprocessJob(scenario, path, out, settings, calibrated) for scenario, path in sources]
    kept: dict[str, Any] = {}
    failures, warnings = list[str](), list[str]()
    for job, done, error in run_all("preprocess", jobs, workers):
        if error is None:
            kept[f"{job.scenario}/{job.name}"] = done.points
            warnings += [f"{job.label}: {message}" for message in done.warnings]
        else:
            failures.append(error)
    for message in warnings:
        warn(message)
    errors.print(f"Cleaned {len(kept)} episodes into {out}.")
    finish({"out": str(out), "points": kept, "warnings": warnings}, json)
    if failures:
        raise EpisodeError("\n".join(failures))


@dataclass(frozen=True)
class Cleaned:
    """What became of an episode."""

    points: dict[str, list[int]]
    """Per frame, recorded and kept."""
    warnings: list[str]


@dataclass(frozen=True)
class PreprocessJob:
    """One episode to fuse, if it is a raw one, and to clean."""

    scenario: str
    path: Path
    """Episode file or raw episode."""
    out: Path
    settings: PreprocessConfig
    calibration: Calibration | None

    @property
    def name(self) -> str:
        return _stem(self.path)

    @property
    def label(self) -> str:
        return self.path.name

    def run(self, tell: Tell) -> Cleaned:
        """Write the clean episode, with pictures of a raw one.

        Raises:
            EpisodeError: a damaged episode, or one of which nothing is left.
        """
        pictures = None
        try:
            if self.path.is_dir():
                pictures = _Pictures(read_raw_episode(self.path))
                episode = fuse(
                    pictures.raw,
                    robot_mask(self.settings.raw),
                    self.settings.raw.fusion(),
                    calibration=self.calibration,
                    tell=lambda _, text: tell(0.0, text),
                    watch=pictures,
                )
            else:
                episode = read_episode(self.path)
            episode = _clean(episode, self.settings)
        except EpisodeError as error:
            raise EpisodeError(f"{self.path}: {error}") from error
        with together():
            if pictures is not None:
                pictures.write(self.out / self.scenario, self.name, episode)
            write_episode(self.out / self.scenario / f"{self.name}.npz", episode)
        quality = episode.meta["quality"]
        return Cleaned({key: quality[key] for key in ("recorded", "kept")}, quality.get("warnings", []))


def _sources(recorded: Path, scenarios: list[str]) -> list[tuple[str, Path]]:
    """(scenario, episode file or raw episode) of each episode."""
    raw = [recorded] if (recorded / "episode.json").is_file() else _raw_in(recorded)
    if raw:
        return [(_scenario(path), path) for path in raw]
    found = []
    for name in scenarios:
        folder = recorded / name
        paths = _raw_in(folder)
        if not paths or files_in(folder, ".npz"):
            paths += episode_files([folder])
        names = [_stem(path) for path in paths]
        doubled = sorted({stem for stem in names if names.count(stem) > 1})
        if doubled:
            raise ConfigError(f"{folder}: {', '.join(doubled)} is there as raw episode and as .npz; remove one.")
        found += [(name, path) for path in paths]
    return found


def _raw_in(folder: Path) -> list[Path]:
    return [path for path in folders_in(folder) if (path / "episode.json").is_file()]


def _scenario(raw: Path) -> str:
    name = read_description(raw).get("scenario")
    if not isinstance(name, str) or not name.replace("_", "").replace("-", "").isalnum():
        raise ConfigError(
            f"{raw / 'episode.json'} names no scenario (found {name!r}). Put the episode into a folder of the "
            "scenario's name, and give the folder above."
        )
    return name


def _stem(path: Path) -> str:
    return path.name if path.is_dir() else path.stem


@cache
def robot_mask(raw: RawConfig) -> RobotMask | None:
    """Of the robot that the settings name; None where they name none."""
    if raw.robot is None:
        return None
    robot = gen3() if raw.robot == "gen3" else Robot.from_urdf(Path(raw.robot))
    return RobotMask(robot, inflation_m=raw.inflation_m)


class _Pictures:
    """Two pictures of a raw episode's middle frame: <episode>.mask.png and <episode>.cloud.png."""

    def __init__(self, raw: RawEpisode) -> None:
        self.raw = raw
        self._frame = len(next(iter(raw.cameras.values())).frames) // 2

    def __call__(self, frame: int, parts: Mapping[str, Seen]) -> None:
        if frame == self._frame:
            self._mask = mask_picture(self.raw.cameras, parts)

    def write(self, folder: Path, name: str, episode: Episode) -> None:
        write_color(folder / f"{name}.mask.png", self._mask)
        write_color(folder / f"{name}.cloud.png", cloud_picture(episode, self._frame))


def _clean(episode: Episode, config: PreprocessConfig) -> Episode:
    if episode.meta.get("noise_free"):  # nothing to clean; thinning would only take what the loss compares with
        config = config.model_copy(update={"outlier_neighbours": 0, "points": None, "crop_m": None, "radius_m": None})
    rng = np.random.default_rng(config.seed)
    indices, reports = [], []
    for frame in range(episode.frame_count):  # frames are ragged; each is vectorised
        try:
            keep, report = clean_frame(
                episode.frame(frame),
                crop=config.crop_m,
                neighbours=config.outlier_neighbours,
                deviations=config.outlier_deviations,
                radius_m=config.radius_m,
                radius_neighbours=config.radius_neighbours,
                limit=config.points,
                thinning=config.thinning,
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
        meta={**episode.meta, "quality": {**episode.meta.get("quality", {}), **quality}},
    )
