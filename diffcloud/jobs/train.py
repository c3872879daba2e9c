"""Train networks that predict parameters from clouds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import torch

from diffcloud.console import errors
from diffcloud.errors import CheckpointError, ConfigError, DatasetError, EpisodeError
from diffcloud.io.episodes import read_episode
from diffcloud.io.files import read_json
from diffcloud.io.fingerprints import fingerprint
from diffcloud.io.manifests import read_manifest, remove_files, write_manifest
from diffcloud.io.timings import read_timings, timings_path
from diffcloud.jobs.ctrl_c import none_lost
from diffcloud.jobs.network_settings import TrainSettings
from diffcloud.jobs.pool import Tell, run_all
from diffcloud.regressors import (
    ModelName,
    Regressor,
    SimulatedSet,
    TrainingSettings,
    profile_settings,
)

_CODE = ("mesh", "io", "clouds", "regressors")
"""Packages whose source code affects the training."""


def train(
    data: Path,
    out: Path,
    config: TrainSettings,
    *,
    scenario: str | None = None,
    workers: int | None = None,
    loaders: int = 0,
) -> Iterator[tuple[TrainJob, dict[str, Any] | None, str | None]]:
    """Train the networks. Finished ones with the same settings and data are reused.

    Args:
        data: folder of a simulated set. Without a scenario: folder of <scenario>/.
        out: folder for <model>.safetensors and <model>/. Without a scenario: folder for <scenario>/.
        scenario: name of the only scenario. None: all scenarios in the settings.
        loaders: number of processes that sample clouds.

    Yields:
        Each network with its summary, or with an error message.

    Raises:
        ConfigError, DatasetError: a set is missing, or belongs to another scenario.
        KeyboardInterrupt: Ctrl-C. The last saved epoch is kept.
    """
    every = scenario is None
    scenarios = config.scenes if scenario is None else [scenario]
    settings = {name: profile_settings(config.profile, name, **config.changes()) for name in config.models}
    jobs: list[TrainJob] = []
    for name in scenarios:
        source, folder = (data / name, out / name) if every else (data, out)
        train_set, test_set = SimulatedSet.read(source, "train"), SimulatedSet.read(source, "test")
        if train_set.scenario != name:
            raise ConfigError(f"{source} holds draws of {train_set.scenario}, not of {name}.")
        jobs += [TrainJob(kind, train_set, test_set, own, config, folder, loaders) for kind, own in settings.items()]
    for job in jobs:
        errors.print(f"Training {job.label}: {_described(job.settings, job.train)} ...")
    if workers is None and config.device != "cpu" and torch.cuda.is_available():
        workers = 1  # parallel trainings would share the GPU
    failed = False
    with none_lost():
        for job, told, error in run_all("train", jobs, workers):
            failed = failed or error is not None
            yield job, told, error
    if every and not failed:
        inside = {path.relative_to(out).as_posix() for job in jobs for path in job.files}
        if removed := remove_files(out, sorted(read_manifest(out) - inside)):
            errors.print(f"Removed networks that are not asked for any more: {', '.join(removed)}.", soft_wrap=True)
        write_manifest(out, inside)


def viewpoints(path: Path, scenarios: Sequence[str]) -> list[list[float]]:
    """Return the camera positions of an episode [x, y, z].

    Raises:
        ConfigError: the episode belongs to another scenario.
        EpisodeError: the episode is damaged, or its camera positions are unknown.
    """
    episode = read_episode(path)
    own = episode.meta.get("scenario")
    if own is not None and any(name != own for name in scenarios):
        raise ConfigError(f"--like {path} is a recording of {own}, not of {', '.join(scenarios)}; add --scene {own}.")
    if not episode.viewpoints:
        raise EpisodeError(
            f"{path} has no camera positions (`viewpoints`). Use an episode that `diffcloud data preprocess` wrote."
        )
    return [place.tolist() for place in episode.viewpoints.values()]


@dataclass(frozen=True)
class TrainJob:
    """Training of one network. A finished network with the same settings, data and code is reused."""

    model: str
    train: SimulatedSet
    test: SimulatedSet
    settings: TrainingSettings
    config: TrainSettings
    folder: Path
    loaders: int
    """Number of processes that sample clouds."""

    @property
    def label(self) -> str:
        return f"{self.train.scenario}/{self.model}"

    @property
    def files(self) -> list[Path]:
        """Files that `run` has written."""
        live = self._checkpoint.with_suffix("")
        return [self._checkpoint, timings_path(self._checkpoint), *(path for path in live.rglob("*") if path.is_file())]

    def run(self, tell: Tell) -> dict[str, Any]:
        """Train the network, write it, and return its summary.

        Raises:
            ConfigError, TrainingError: a set is too small, or the loss is not finite any more.
            KeyboardInterrupt: Ctrl-C. The last saved epoch is kept.
        """
        known = self._known()
        if known is not None:
            return known
        # Imported here because Lightning takes seconds to import.
        from diffcloud.regressors.training import TrainingProgress, train_regressor

        def show_progress(progress: TrainingProgress) -> None:
            losses = f"train {progress.train_loss:.4f}  validation {progress.validation_loss:.4f}  best {progress.best:.4f}"
            tell(progress.epoch / self.settings.epochs, f"{progress.epoch}/{self.settings.epochs}  {losses}")

        result = train_regressor(
            cast(ModelName, self.model),
            self.train,
            self.test,
            self.settings,
            self._checkpoint,
            device=self.config.device,
            workers=self.loaders,
            mark=self._fingerprint,
            progress=show_progress,
        )
        return self._told(result.summary, {"seconds": result.seconds, "resumed": result.resumed_from})

    def _known(self) -> dict[str, Any] | None:
        """Return the summary of an earlier run with the same settings, data and code, or None."""
        try:
            told = read_json(self._checkpoint.with_suffix("") / "training.json", error=DatasetError)
            if not isinstance(told, dict) or told.get("fingerprint") != self._fingerprint:
                return None
            Regressor.read(self._checkpoint)
            return self._told(told, read_timings(self._checkpoint))
        except (DatasetError, CheckpointError):  # missing or damaged: train again
            return None

    def _told(self, summary: Mapping[str, Any], timings: Mapping[str, Any]) -> dict[str, Any]:
        return {
            "epochs": len(summary["history"]),
            "best_epoch": summary["best_epoch"],
            "history": summary["history"],
            "held_out": summary["held_out"],
            "resumed_from": timings.get("resumed", 0),
            "seconds": timings.get("seconds"),
        }

    @property
    def _checkpoint(self) -> Path:
        return self.folder / f"{self.model}.safetensors"

    @cached_property
    def _fingerprint(self) -> str:
        return fingerprint([self.model, self.train, self.test, self.settings, self.config.device], packages=_CODE)


def _described(settings: TrainingSettings, simulated: SimulatedSet) -> str:
    draws = min(settings.draws or len(simulated), len(simulated))
    return f"{draws} draws, {settings.epochs} epochs, {settings.points} points a frame"
