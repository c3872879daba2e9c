"""Convert raw episodes to clouds, and clean clouds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from hashlib import sha256
from pathlib import Path

import numpy as np

from diffcloud.console import errors, warn
from diffcloud.errors import ConfigError, EpisodeError
from diffcloud.io.calibrations import Calibration, read_calibration
from diffcloud.io.episodes import Episode, read_episode, write_episode
from diffcloud.io.files import files_in, folders_in, together
from diffcloud.io.fingerprints import fingerprint
from diffcloud.io.images import write_color
from diffcloud.io.manifests import read_manifest, read_marks, remove_files, remove_manifest, write_manifest
from diffcloud.io.raw_episodes import RawEpisode, raw_episode_files, read_description, read_raw_episode
from diffcloud.jobs.pool import Tell, run_all
from diffcloud.jobs.settings import Config, PreprocessConfig, RawConfig
from diffcloud.sensing.agreement import agreement, corrected
from diffcloud.sensing.filters import clean_frame
from diffcloud.sensing.fusion import Seen, fuse
from diffcloud.sensing.masking import RobotMask
from diffcloud.sensing.pictures import cloud_picture, mask_picture
from diffcloud.sensing.robot import Robot, gen3

PICTURES = ("mask", "cloud")
"""Kinds of pictures of a raw episode: <episode>.<kind>.png beside its clouds."""
_CODE = ("mesh", "io", "clouds", "sensing")
"""Packages whose source code affects the clouds."""


def preprocess(
    recorded: Sequence[Path],
    out: Path,
    config: Config,
    settings: PreprocessConfig,
    *,
    calibration: Path | None = None,
    workers: int | None = None,
) -> tuple[dict[str, dict[str, list[int]]], list[str], list[str]]:
    """Clean every recording and write it to OUT/<scenario>/<episode>.npz.

    Finished episodes are reused until the recording, a setting or the code changes. If whole folders are given, clouds
    whose recording was deleted are removed.

    Args:
        recorded: raw episodes, or folders of recordings.
        calibration: calibration file of the cameras of raw episodes.

    Returns:
        <scenario>/<episode> -> points per frame, recorded and kept; warnings; errors of episodes that failed.

    Raises:
        ConfigError: there is no recording, or two have the same name.
    """
    sources = _sources([path.absolute() for path in recorded], config.scenes)  # absolute, because "." has no name
    calibrated = None if calibration is None else read_calibration(calibration)
    if any(path.is_dir() for _, path in sources):
        robot_mask(settings.raw)  # load the robot first, so that errors in its description are found early
    jobs = [PreprocessJob(scenario, path, out, settings, calibrated) for scenario, path in sources]
    whole = not any((path / "episode.json").is_file() for path in recorded)
    written, marks = read_manifest(out), read_marks(out)
    wanted = {job.result: job.fingerprint() for job in jobs}
    cleaned = {name: done for name, mark in wanted.items() if marks.get(name) == mark and (done := _kept(out / name))}
    finished = {name: wanted[name] for name in cleaned}
    # Write the manifest first, so that files of an interrupted call are known, and considered unfinished.
    others = {} if whole else {name: mark for name, mark in marks.items() if name not in wanted}
    marks = others | finished
    write_manifest(out, written | {name for job in jobs for name in job.files}, marks)
    failures = list[str]()
    for job, done, error in run_all("preprocess", [job for job in jobs if job.result not in finished], workers):
        if error is None:
            cleaned[job.result], marks[job.result] = done, wanted[job.result]
            write_manifest(out, read_manifest(out), marks)
        else:
            failures.append(error)
    if failures and not (cleaned or written):
        remove_manifest(out)
    if whole and not failures:
        inside = {name for job in jobs for name in job.files}
        if removed := remove_files(out, sorted(read_manifest(out) - inside)):
            errors.print(f"Removed clouds whose recording is gone: {', '.join(removed)}.", soft_wrap=True)
        write_manifest(out, inside, marks)
    told = [(job, cleaned[job.result]) for job in jobs if job.result in cleaned]
    kept = {f"{job.scenario}/{job.name}": done.points for job, done in told}
    warnings = [f"{job.label}: {message}" for job, done in told for message in done.warnings]
    for message in warnings:
        warn(message)
    errors.print(f"Cleaned {len(kept) - len(finished)} episodes into {out}; {len(finished)} were finished already.")
    return kept, warnings, failures


@dataclass(frozen=True)
class Cleaned:
    """Summary of a cleaned episode."""

    points: dict[str, list[int]]
    """Number of points per frame: recorded and kept."""
    warnings: list[str]


@dataclass(frozen=True)
class PreprocessJob:
    """One episode to clean. A raw episode is converted to clouds first."""

    scenario: str
    path: Path
    """Path of an episode file or of a raw episode."""
    out: Path
    settings: PreprocessConfig
    calibration: Calibration | None

    @property
    def name(self) -> str:
        return _stem(self.path)

    @property
    def label(self) -> str:
        return self.path.name

    @property
    def result(self) -> str:
        """Path of the cleaned episode, relative to `out`."""
        return f"{self.scenario}/{self.name}.npz"

    @property
    def files(self) -> list[str]:
        """Paths of the files that `run` writes, relative to `out`."""
        pictures = [f"{self.scenario}/{self.name}.{kind}.png" for kind in PICTURES] if self.path.is_dir() else []
        return [self.result, *pictures]

    def fingerprint(self) -> str:
        """Return the fingerprint of the recording's files and of everything that affects the result."""
        names = raw_episode_files(self.path)[0] if self.path.is_dir() else [""]
        recording = {name: sha256((self.path / name).read_bytes()).hexdigest() for name in names}
        robot = _robot(self.settings.raw) if self.path.is_dir() else None
        plan = [self.scenario, self.name, recording, self.settings.model_dump(), self.calibration]
        return fingerprint([*plan, None if robot is None else robot.description], packages=_CODE)

    def run(self, tell: Tell) -> Cleaned:
        """Write the cleaned episode, and pictures if it is a raw episode.

        Raises:
            EpisodeError: the episode is damaged, or no points remain.
        """
        pictures = raw = None
        try:
            if self.path.is_dir():
                raw = read_raw_episode(self.path)
                pictures = _Pictures(raw)
                episode = fuse(
                    raw,
                    robot_mask(self.settings.raw),
                    self.settings.raw.fusion(),
                    calibration=self.calibration,
                    tell=lambda _, text: tell(0.0, text),
                    watch=pictures,
                )
            else:
                episode = read_episode(self.path)
            episode = _clean(aligned(episode, self.settings, self.name, raw), self.settings)
        except EpisodeError as error:
            raise EpisodeError(f"{self.path}: {error}") from error
        with together():
            if pictures is not None:
                pictures.write(self.out / self.scenario, self.name, episode)
            write_episode(self.out / self.scenario / f"{self.name}.npz", episode)
        return _told(episode)


def _kept(path: Path) -> Cleaned | None:
    """Summarise the result of an earlier run, or return None if it is missing or damaged."""
    try:
        return _told(read_episode(path))
    except EpisodeError:
        return None


def _told(episode: Episode) -> Cleaned:
    quality = episode.meta["quality"]
    return Cleaned({key: quality[key] for key in ("recorded", "kept")}, quality.get("warnings", []))


def _sources(recorded: list[Path], scenarios: list[str]) -> list[tuple[str, Path]]:
    """List all recordings as (scenario, path of an episode file or raw episode).

    Raises:
        ConfigError: there is no recording, two in one scenario have the same name, or a raw episode given by its path
            has no scenario.
    """
    found = [source for path in recorded for source in _within(path, scenarios)]
    names = [f"{scenario}/{_stem(path)}" for scenario, path in found]
    if doubled := sorted({name for name in names if names.count(name) > 1}):
        places = ", ".join(str(path) for name, (_, path) in zip(names, found, strict=True) if name in doubled)
        raise ConfigError(f"Two recordings are called {', '.join(doubled)} ({places}). Rename or remove one of them.")
    if not found:
        raise ConfigError(
            f"{' and '.join(map(str, recorded))}: no recordings of {', '.join(scenarios)}. Raw episodes are folders with "
            "an episode.json, made by `diffcloud data capture` or `diffcloud data import`; clouds lie in <scenario>/*.npz, "
            "made by `diffcloud data import`. Try one of these, or list the scenario in the parameters file (--params)."
        )
    return found


def _within(recorded: Path, scenarios: list[str]) -> list[tuple[str, Path]]:
    """As `_sources`, for one argument. Scenarios without recordings are skipped."""
    if (recorded / "episode.json").is_file():
        return [(_scenario(recorded), recorded)]
    if not recorded.is_dir():
        raise ConfigError(f"No such folder: {recorded}. Give a raw episode, or a folder with recordings.")
    found = []
    for folder in (recorded, recorded / "episodes"):
        for path in _raw_in(folder):
            try:
                found.append((_scenario(path), path))
            except ConfigError as error:  # for example, a recording of the calibration board
                warn(f"Left out: {error}")
        for inner in folders_in(folder):
            paths = [*_raw_in(inner), *files_in(inner, ".npz")]
            if inner.name in scenarios:
                found += [(inner.name, path) for path in paths]
            elif paths and inner.name != "episodes":
                warn(f"Left out: {inner}. Its name is none of the scenarios {', '.join(scenarios)}.")
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
    """Return the mask of the robot in the settings, or None if they have no robot."""
    robot = _robot(raw)
    return None if robot is None else RobotMask(robot, robot_margin_m=raw.robot_margin_m)


@cache
def _robot(raw: RawConfig) -> Robot | None:
    if raw.robot is None:
        return None
    return gen3() if raw.robot == "gen3" else Robot.from_urdf(Path(raw.robot))


def aligned(episode: Episode, config: PreprocessConfig, name: str, raw: RawEpisode | None) -> Episode:
    """Return the recording with one camera corrected against another, if the settings name two cameras.

    Args:
        name: name of the recording.
        raw: raw episode from which the clouds were made. None if they come from a file.

    Raises:
        EpisodeError: the cameras are unknown, their views cannot be compared, or clouds are not in metres.
    """
    if config.align_cameras is None:
        return episode
    if raw is not None:
        unit = (config.raw.fusion().placement or raw.placement).length_unit_m
        if unit != 1.0:
            raise EpisodeError(
                f"The scene's length unit is {unit:g} m. align_cameras takes clouds in metres. Set length_unit_m to 1, or "
                "leave align_cameras out."
            )
    return corrected(episode, agreement([episode], config.align_cameras), [name])


class _Pictures:
    """Two pictures of the middle frame of a raw episode: <episode>.mask.png and <episode>.cloud.png."""

    def __init__(self, raw: RawEpisode) -> None:
        self.raw = raw
        self._frame = len(next(iter(raw.cameras.values())).frames) // 2

    def __call__(self, frame: int, parts: Mapping[str, Seen]) -> None:
        if frame == self._frame:
            self._mask = mask_picture(self.raw.cameras, parts)

    def write(self, folder: Path, name: str, episode: Episode) -> None:
        for kind, picture in zip(PICTURES, (self._mask, cloud_picture(episode, self._frame)), strict=True):
            write_color(folder / f"{name}.{kind}.png", picture)


def _clean(episode: Episode, config: PreprocessConfig) -> Episode:
    if episode.meta.get("noise_free"):  # skip cleaning and thinning: all points are exact, and the loss uses them
        config = config.model_copy(update={"outlier_neighbours": 0, "points": None, "crop_m": None, "radius_m": None})
    rng = np.random.default_rng(config.seed)
    indices, reports = [], []
    for frame in range(episode.frame_count):  # loop, because frames differ in size
        try:
            keep, report = clean_frame(
                episode.frame(frame),
                crop=config.crop_m,
                neighbours=config.outlier_neighbours,
                deviations=config.outlier_std,
                radius_m=config.radius_m,
                radius_neighbours=config.radius_neighbours,
                limit=config.points,
                downsampling=config.downsampling,
                rng=rng,
            )
        except EpisodeError as error:
            raise EpisodeError(f"frame {frame}: {error}") from error
        indices.append(keep + episode.offsets[frame])
        reports.append(asdict(report))
    joined = np.concatenate(indices)
    quality = {key: [report[key] for report in reports] for key in reports[0]}
    return replace(
        episode.select(joined),
        meta={**episode.meta, "quality": {**episode.meta.get("quality", {}), **quality}},
    )
