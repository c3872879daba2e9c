"""`diffcloud train`: teach networks to tell the parameters from clouds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, cast

import torch
import typer
from rich.table import Table

from diffcloud.cli.config import TrainConfig, load_config
from diffcloud.cli.console import JsonFlag, ParamsFile, Workers, errors, finish, known, show, writes
from diffcloud.cli.ctrl_c import none_lost
from diffcloud.cli.workers import Tell, run_all
from diffcloud.errors import CheckpointError, ConfigError, DatasetError, DiffCloudError, EpisodeError
from diffcloud.io.episodes import read_episode
from diffcloud.io.files import read_json
from diffcloud.io.fingerprints import fingerprint
from diffcloud.io.manifests import read_manifest, remove_files, write_manifest
from diffcloud.io.timings import read_timings, timings_path
from diffcloud.regressors import (
    ModelName,
    Regressor,
    SimulatedSet,
    TrainingSettings,
    profile_settings,
)
from diffcloud.settings import updated

_INTERRUPTED = 130
_CODE = ("mesh", "io", "clouds", "regressors")
"""Packages whose source decides a training."""


@writes()
def train(
    data: Annotated[Path, typer.Option(help="Folder written by `diffcloud simulate`; without a scenario, of <scenario>/.")],
    out: Annotated[
        Path,
        typer.Option(
            help="Folder; <model>.safetensors, and <model>/ of curves and errors, without a scenario in <scenario>/."
        ),
    ],
    scenario: Annotated[
        str | None, typer.Option(help="Scenario of the simulated set. Default: all of train.scenarios.")
    ] = None,
    model: Annotated[
        list[str] | None,
        typer.Option(help="mlp, pointnet2, meteornet, or posterior (an extra); repeatable. Default: the first three."),
    ] = None,
    params: ParamsFile = None,
    profile: Annotated[str | None, typer.Option(help="quick, reduced or paper.")] = None,
    epochs: Annotated[int | None, typer.Option(help="Passes over the training draws.")] = None,
    draws: Annotated[int | None, typer.Option(help="Training draws used; default: all.")] = None,
    points: Annotated[int | None, typer.Option(help="Sampled per frame.")] = None,
    batch_size: Annotated[int | None, typer.Option(help="Draws per update.")] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Of Adam.")] = None,
    loss: Annotated[str | None, typer.Option(help="normalised: L1 of fractions of the bounds; raw: in own units.")] = None,
    target: Annotated[str | None, typer.Option(help="linear, or logarithmic: errors count by their ratio.")] = None,
    augment: Annotated[bool | None, typer.Option(help="Hide parts of the clouds and add noise.")] = None,
    like: Annotated[
        Path | None,
        typer.Option(help="A preprocessed episode: clouds show the faces that its cameras see, instead of random ones."),
    ] = None,
    subtract_background: Annotated[bool | None, typer.Option(help="Leave the known obstacle out of the clouds.")] = None,
    heteroscedastic: Annotated[
        bool | None, typer.Option("--heteroscedastic", help="Also learn a width for each prediction.")
    ] = None,
    patience: Annotated[int | None, typer.Option(help="Stop after so many epochs without a better validation.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of all random numbers.")] = None,
    device: Annotated[str | None, typer.Option(help="auto, cpu or gpu (mixed precision).")] = None,
    loaders: Annotated[
        int,
        typer.Option(
            min=0,
            help="Processes that sample clouds, on the CPU. 0: the training process does, on the GPU if it trains there.",
        ),
    ] = 0,
    workers: Workers = None,
    json: JsonFlag = False,
) -> None:
    """Train networks. After Ctrl-C or a kill the same command keeps finished ones and goes on from the last saved epoch."""
    section = load_config(params).train
    scenarios = section.scenarios if scenario is None else [scenario]
    config = updated(
        section,
        models=None if not model else list(dict.fromkeys(model)),
        profile=profile,
        epochs=epochs,
        draws=draws,
        points=points,
        batch_size=batch_size,
        learning_rate=learning_rate,
        loss=loss,
        target=target,
        augment=augment,
        viewpoints=None if like is None else _viewpoints(like, scenarios),
        subtract_background=subtract_background,
        heteroscedastic=heteroscedastic,
        patience=patience,
        seed=seed,
        device=device,
    )
    settings = {name: profile_settings(config.profile, name, **config.changes()) for name in config.models}
    every = scenario is None
    jobs: list[TrainJob] = []
    for name in scenarios:
        source, folder = (data / name, out / name) if every else (data, out)
        train_set, test_set = SimulatedSet.read(source, "train"), SimulatedSet.read(source, "test")
        if train_set.scenario != name:
            raise ConfigError(f"{source} holds draws of {train_set.scenario}, not of {name}.")
        jobs += [TrainJob(kind, train_set, test_set, settings[kind], config, folder, loaders) for kind in config.models]
    for job in jobs:
        errors.print(f"Training {job.label}: {_described(job.settings, job.train)} ...")
    table = Table(
        "network",
        "parameter",
        "held-out draws",
        "median relative error",
        "of the mean",
        "mean error of range",
        "of the median",
        "best epoch",
        "seconds",
    )
    results: dict[str, Any] = {}
    failures: list[str] = []
    if workers is None and config.device != "cpu" and torch.cuda.is_available():
        workers = 1  # trainings at once would share the GPU
    try:
        with none_lost():
            for job, told, error in run_all("train", jobs, workers):
                if error is None:
                    name = job.label if every else job.model
                    results[name] = told
                    _add_rows(table, name, told)
                    if told["resumed_from"]:
                        errors.print(f"{job.label}: went on after epoch {told['resumed_from']} of an interrupted run.")
                else:
                    failures.append(f"{job.label}: {error}")
    except KeyboardInterrupt:
        errors.print("Interrupted; the same command keeps finished networks and goes on from the last saved epoch.")
        raise typer.Exit(_INTERRUPTED) from None
    show(table, json)
    if results:
        errors.print(f"Wrote {', '.join(results)} to {out}.")
    finish({"out": str(out), "models": results}, json)
    if failures:
        raise DiffCloudError("\n".join(failures))
    if every:
        inside = {path.relative_to(out).as_posix() for job in jobs for path in job.files}
        if removed := remove_files(out, sorted(read_manifest(out) - inside)):
            errors.print(f"Removed networks that are not asked for any more: {', '.join(removed)}.", soft_wrap=True)
        write_manifest(out, inside)


def _viewpoints(path: Path, scenarios: Sequence[str]) -> list[list[float]]:
    """Of an episode's cameras.

    Raises:
        ConfigError: it is of another scenario than these.
        EpisodeError: damaged, or its cameras are not known.
    """
    episode = read_episode(path)
    own = episode.meta.get("scenario")
    if own is not None and any(name != own for name in scenarios):
        raise ConfigError(f"--like {path} is a recording of {own}, not of {', '.join(scenarios)}; add --scenario {own}.")
    if not episode.viewpoints:
        raise EpisodeError(f"{path} does not say where its cameras stood; take one that `diffcloud preprocess` wrote.")
    return [place.tolist() for place in episode.viewpoints.values()]


@dataclass(frozen=True)
class TrainJob:
    """One network. A finished one of the same settings and data by the same code is kept."""

    model: str
    train: SimulatedSet
    test: SimulatedSet
    settings: TrainingSettings
    config: TrainConfig
    folder: Path
    loaders: int
    """Processes that sample clouds."""

    @property
    def label(self) -> str:
        return f"{self.train.scenario}/{self.model}"

    @property
    def files(self) -> list[Path]:
        """What `run` has left."""
        live = self._checkpoint.with_suffix("")
        return [self._checkpoint, timings_path(self._checkpoint), *(path for path in live.rglob("*") if path.is_file())]

    def run(self, tell: Tell) -> dict[str, Any]:
        """Train, write, and return what there is to tell.

        Raises:
            ConfigError, TrainingError: sets that are too small, or a loss that is no number any more.
            KeyboardInterrupt: Ctrl-C; the last saved epoch is kept.
        """
        known = self._known()
        if known is not None:
            return known
        # Lightning takes seconds to import, and nothing else needs it
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
        """What an earlier run of the same settings, data and code has left."""
        try:
            told = read_json(self._checkpoint.with_suffix("") / "training.json", error=DatasetError)
            if not isinstance(told, dict) or told.get("fingerprint") != self._fingerprint:
                return None
            Regressor.read(self._checkpoint)
            return self._told(told, read_timings(self._checkpoint))
        except (DatasetError, CheckpointError):  # none, or a damaged one: trained again
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


def _add_rows(table: Table, network: str, told: Mapping[str, Any]) -> None:
    for name, row in told["held_out"]["parameters"].items():
        keys = (
            "median_relative_error",
            "median_relative_error_of_mean",
            "mean_error_of_range",
            "mean_error_of_range_of_median",
        )
        cells = (f"{100 * row[key]:.1f} %" for key in keys)
        table.add_row(
            network, name, str(told["held_out"]["draws"]), *cells, str(told["best_epoch"]), known(told["seconds"], ".0f")
        )
