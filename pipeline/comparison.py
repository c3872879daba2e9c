"""Running the comparison over many episodes: several processes, finished episodes kept, tables written."""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from diffcloud.errors import CheckpointError, ConfigError, DiffCloudError, EpisodeError
from diffcloud.evaluation import ComparisonSettings, EpisodeRecord, Estimate, Gap, compare_episode
from diffcloud.evaluation.methods import predicted
from diffcloud.evaluation.repeats import other_repeats
from diffcloud.evaluation.summary import PREDICTORS
from diffcloud.fit import FitSpace, Objective, fit_adam, read_fit, write_fit
from diffcloud.fit.result import describe_fit
from diffcloud.io.episodes import Episode, read_episode
from diffcloud.io.files import read_json, write_json, write_text
from diffcloud.io.fingerprints import fingerprint
from diffcloud.regressors import Regressor, predict_episode
from pipeline.config import Config, FitConfig
from pipeline.console import progress_bar
from pipeline.scenario_options import choose_scenario

_CODE = ("mesh", "io", "sim", "scene", "clouds", "fit", "evaluation")
"""Packages whose source decides the numbers of a finished episode."""


@dataclass(frozen=True)
class Job:
    """One episode to compare; what it needs travels to another process."""

    scenario: str
    scene: Path | None
    name: str
    episode: Episode
    summary: Mapping[str, Any]
    predictions: Sequence[Estimate | Gap]
    transfers: Mapping[str, Mapping[str, float]]
    settings: ComparisonSettings
    kept: Path
    """Where the finished record is kept."""

    def run(self) -> EpisodeRecord:
        """The record, from the file if that belongs to the same inputs and code.

        Raises:
            DiffCloudError: the fitted parameters cannot be simulated.
        """
        # seconds of predictions differ from run to run, and change nothing in the record
        told = [(entry.method, entry.values if isinstance(entry, Estimate) else entry.reason) for entry in self.predictions]
        inputs = [self.name, self.episode, self.summary, told, self.transfers, self.settings]
        mark = fingerprint([self.scenario, *inputs], packages=_CODE)
        if self.kept.is_file():
            known = read_json(self.kept)
            if isinstance(known, dict) and known.get("fingerprint") == mark:
                return EpisodeRecord(known["record"], known["seconds"])
        found = compare_episode(
            choose_scenario(self.scenario, self.scene),
            self.episode,
            self.summary,
            name=self.name,
            predictions=self.predictions,
            transfers=self.transfers,
            settings=self.settings,
        )
        write_json(self.kept, {"fingerprint": mark, "record": found.record, "seconds": found.seconds})
        return found


@dataclass(frozen=True)
class FitJob:
    """One episode to fit, kept as `diffcloud fit` keeps it."""

    scenario: str
    scene: Path | None
    name: str
    episode: Episode
    settings: FitConfig
    folder: Path

    def run(self) -> Path:
        """Fit, unless the same fit is there.

        Raises:
            DiffCloudError: every start diverged.
        """
        mark = fingerprint([self.scenario, self.name, self.episode, self.settings.model_dump()], packages=_CODE[:-1])
        path = self.folder / f"{self.name}.json"
        if path.is_file() and read_fit(path).get("fingerprint") == mark:
            return path
        scenario, config = choose_scenario(self.scenario, self.scene), self.settings
        objective = Objective(scenario, [self.episode], frames=config.frames, points=config.points, seed=config.seed)
        space = FitSpace.build(config.parameters, bounds={**scenario.bounds, **config.bounds}, fixed=config.fixed)
        adam = config.adam(scenario)
        outcome = fit_adam(objective, space, adam)
        if outcome.stop_reason == "interrupted":
            raise KeyboardInterrupt  # begun again next time
        result = describe_fit(objective, space, adam, outcome, episodes=[self.name])
        result.summary["fingerprint"] = mark
        return write_fit(self.folder, self.name, result)


@dataclass
class Comparison:
    """What came of all jobs."""

    records: list[dict[str, Any]] = field(default_factory=list)
    seconds: dict[tuple[str, str], dict[str, dict[str, float]]] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)
    """Episodes of which nothing could be said."""

    @property
    def missing(self) -> list[str]:
        """Everything that should be there and is not."""
        gaps = [
            f"{record['scenario']}/{record['episode']}: {gap['method']}: {gap['reason']}"
            for record in self.records
            for gap in record["gaps"]
            if gap["expected"]
        ]
        return self.failures + gaps


def run_all(label: str, jobs: Sequence[Job | FitJob], workers: int) -> Iterable[tuple[Job | FitJob, Any, str | None]]:
    """(job, what it gave, message of its error) in the order of the jobs. Ctrl-C ends the processes; what is finished is
    kept."""
    with progress_bar(label, len(jobs)) as update:
        if workers == 1 or len(jobs) < 2:
            for index, job in enumerate(jobs):
                update(index, f"{job.scenario} {job.name}")
                yield (job, *_attempt(job))
            return
        # spawned, not forked: a fork of a process with torch's threads may hang
        with multiprocessing.get_context("spawn").Pool(min(workers, len(jobs)), _quiet) as pool:
            for index, (job, found) in enumerate(zip(jobs, pool.imap(_attempt, jobs), strict=True)):
                update(index + 1, f"{job.scenario} {job.name}")
                yield (job, *found)


def compare(jobs: Sequence[Job], workers: int) -> Comparison:
    """All episodes."""
    comparison = Comparison()
    for job, found, error in run_all("evaluate", jobs, workers):
        if error is not None:
            comparison.failures.append(f"{job.scenario}/{job.name}: {error}")
        else:
            comparison.records.append(found.record)
            comparison.seconds[job.scenario, job.name] = {method: dict(told) for method, told in found.seconds.items()}
    return comparison


def comparison_jobs(
    config: Config,
    scenario: str,
    *,
    fits: Path,
    episodes: Path,
    regressors: Path,
    simulated: Path,
    kept: Path,
    scene: Path | None = None,
) -> list[Job]:
    """The episodes of one scenario, in the order of their fits.

    Raises:
        ConfigError, EpisodeError: a damaged fit or episode.
    """
    summaries = {path: read_fit(path) for path in sorted((fits / scenario).glob("*.json"))}
    fitted = [(path.stem, name, summary) for path, summary in summaries.items() for name in summary["episodes"]]
    recorded = {name: read_episode(episodes / scenario / f"{name}.npz") for _, name, _ in fitted}
    values = {
        name: {key: float(entry["value"]) for key, entry in summary["parameters"].items()} for _, name, summary in fitted
    }
    others = other_repeats({name: episode.meta for name, episode in recorded.items()}, values)
    networks = _networks(config, scenario, regressors, simulated)
    jobs = []
    for fit, name, summary in fitted:
        label = name if fit == name else f"{fit}-{name}"  # a joint fit has several episodes
        real = not recorded[name].meta.get("truth")
        jobs.append(
            Job(
                scenario=scenario,
                scene=scene,
                name=label,
                episode=recorded[name],
                summary=summary,
                predictions=[network.of(recorded[name]) for network in networks],
                # simulated targets share labels, not parameters
                transfers=others[name] if real else {},
                settings=config.evaluate.comparison(f"{scenario}/{label}"),
                kept=kept / scenario / f"{label}.json",
            )
        )
    return jobs


@dataclass(frozen=True)
class _Network:
    """A trained network, or why there is none."""

    model: str
    regressor: Regressor | None
    reason: str
    expected: bool
    seconds: Mapping[str, float]
    """Of its data set and its training."""

    def of(self, episode: Episode) -> Estimate | Gap:
        if self.regressor is None:
            return Gap(self.model, self.reason, self.expected)
        began = time.perf_counter()
        try:
            prediction = predict_episode(self.regressor, episode)
        except EpisodeError as error:
            return Gap(self.model, str(error))
        values = dict(zip(prediction.names, prediction.values[0].tolist(), strict=True))
        return predicted(self.model, values, {**self.seconds, "inference": time.perf_counter() - began})


def _networks(config: Config, scenario: str, regressors: Path, simulated: Path) -> list[_Network]:
    folder = regressors / scenario
    asked = set(config.train.models) if scenario in config.train.scenarios else set()
    found = []
    for model in (name for name in PREDICTORS if not name.startswith("published_")):
        path = folder / f"{model}.safetensors"
        seconds = {
            phase: value
            for phase, file in (
                ("dataset", simulated / f"{scenario}.timings.json"),
                ("training", folder / f"{model}.timings.json"),
            )
            if (value := _seconds(file)) is not None
        }
        if path.is_file():
            try:
                found.append(_Network(model, Regressor.read(path), "", True, seconds))
            except CheckpointError as error:
                found.append(_Network(model, None, str(error), True, {}))
        elif model in asked:
            found.append(_Network(model, None, f"no checkpoint {path}; run `diffcloud train`", True, {}))
        else:
            found.append(_Network(model, None, "not trained for this scenario (train.scenarios, train.models)", False, {}))
    return found


def _seconds(path: Path) -> float | None:
    """Wall time of a whole run; of an interrupted one it is not known."""
    if not path.is_file():
        return None
    told = read_json(path, error=ConfigError)
    return None if told.get("resumed") else float(told["seconds"])


def write_tables(folder: Path, tables: Mapping[str, pd.DataFrame]) -> None:
    """One CSV each."""
    for name, table in tables.items():
        write_text(folder / f"{name}.csv", table.to_csv(index=False))


def _attempt(job: Job | FitJob) -> tuple[Any, str | None]:
    try:
        return job.run(), None
    except DiffCloudError as error:
        return None, str(error)


def _quiet() -> None:
    """Of a worker: Ctrl-C is the parent's, and one thread is its share of the cores."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
