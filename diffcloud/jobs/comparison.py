"""Compare methods on many episodes in parallel. Finished episodes are kept, and tables are written."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from diffcloud.errors import CheckpointError, DiffCloudError, EpisodeError
from diffcloud.estimation.record import FitRecord, read_fit
from diffcloud.evaluation.episode import EpisodeRecord, compare_episode
from diffcloud.evaluation.methods import Estimate, Gap, predicted
from diffcloud.evaluation.repeats import other_repeats
from diffcloud.evaluation.settings import ComparisonSettings
from diffcloud.evaluation.summary import PREDICTORS
from diffcloud.io.episodes import Episode, read_episode
from diffcloud.io.files import files_in, write_json, write_text
from diffcloud.io.fingerprints import fingerprint, kept_record
from diffcloud.io.timings import read_seconds, read_timings
from diffcloud.jobs.fits import joint_fit
from diffcloud.jobs.pool import Tell, run_all
from diffcloud.jobs.settings import Config
from diffcloud.regressors import Regressor, predict_episode
from diffcloud.scene.scenarios import Scenario

_CODE = ("mesh", "io", "sim", "scene", "clouds", "estimation", "evaluation")
"""Packages whose source code affects the result of an episode."""

_MOST_REASONS = 5


@dataclass(frozen=True)
class Job:
    """Comparison of all methods on one episode. It is picklable, so it can run in another process."""

    scenario: Scenario
    group: str
    """Name of the folder with the scenario's episodes and fits."""
    name: str
    fit: str
    """Name of the episode's fit."""
    recording: int
    """Index of the episode among the recordings of the fit."""
    episode: Episode
    fitted: FitRecord
    predictions: Sequence[Estimate | Gap]
    transfers: Mapping[str, Mapping[str, float]]
    settings: ComparisonSettings
    kept: Path
    """File for the finished record."""

    @property
    def label(self) -> str:
        return f"{self.group}/{self.name}"

    def run(self, tell: Tell) -> EpisodeRecord:
        """Return the record. It is read from `kept` if that file has the same inputs and code.

        Raises:
            DiffCloudError: the fitted parameters cannot be simulated.
        """
        # The times of predictions are not part of the inputs: they vary between runs and do not affect the record.
        told = [(entry.method, entry.values if isinstance(entry, Estimate) else entry.reason) for entry in self.predictions]
        inputs = [self.name, self.fit, self.episode, self.fitted.plain(), told, self.transfers, self.settings]
        mark = fingerprint([self.scenario, self.group, *inputs], packages=_CODE)
        if (known := kept_record(self.kept, mark)) is not None:
            return EpisodeRecord(known["record"], known["seconds"])
        found = compare_episode(
            self.scenario,
            self.episode,
            self.fitted,
            name=self.name,
            fit_name=self.fit,
            recording=self.recording,
            predictions=self.predictions,
            transfers=self.transfers,
            settings=self.settings,
        )
        write_json(self.kept, {"fingerprint": mark, "record": found.record, "seconds": found.seconds})
        return found


@dataclass
class Comparison:
    """Results of all comparison jobs."""

    records: list[dict[str, Any]] = field(default_factory=list)
    seconds: dict[tuple[str, str], dict[str, dict[str, float]]] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)
    """Messages about episodes without any result."""

    @property
    def missing(self) -> list[str]:
        """Messages about failed episodes and missing expected methods."""
        gaps = [
            f"{record['scenario']}/{record['episode']}: {gap['method']}: {gap['reason']}"
            for record in self.records
            for gap in record["gaps"]
            if gap["expected"]
        ]
        return self.failures + gaps


def compare(jobs: Sequence[Job], workers: int | None, scheduler: str | None = None) -> Comparison:
    """Run all comparison jobs.

    Raises:
        DiffCloudError: all of them failed.
    """
    comparison = Comparison()
    for job, found, error in run_all("evaluate", jobs, workers, scheduler=scheduler):
        if error is not None:
            comparison.failures.append(f"{job.label}: {error}")
        else:
            comparison.records.append(found.record)
            comparison.seconds[job.group, job.name] = {method: dict(told) for method, told in found.seconds.items()}
    if not comparison.records:
        reasons = "; ".join(comparison.failures[:_MOST_REASONS])
        raise DiffCloudError(f"Nothing was compared in {len(jobs)} episodes, and nothing is written. {reasons}")
    return comparison


def comparison_jobs(
    config: Config,
    group: str,
    scenario: Scenario,
    *,
    fits: Path,
    episodes: Path,
    regressors: Path,
    simulated: Path,
    kept: Path,
) -> list[Job]:
    """Create the comparison jobs of one scenario, in the order of its fits.

    Args:
        group: name of the folder with its episodes, fits and networks.
        kept: folder for the records of finished episodes.

    Raises:
        ConfigError, EpisodeError: a fit or episode is damaged.
    """
    found = [(path.stem, read_fit(path)) for path in [*files_in(fits / group, ".json"), *joint_fit(fits)]]
    fitted = [
        (name, recording.name, number, fit)
        for name, fit in found
        for number, recording in enumerate(fit.episodes)
        if recording.scenario == scenario.name
    ]
    recorded = {name: read_episode(episodes / group / f"{name}.npz") for _, name, _, _ in fitted}
    alone = {name: fit for _, name, _, fit in fitted if len(fit.episodes) == 1}  # a joint fit used the target episodes
    values = {name: fit.values for name, fit in alone.items()}
    others = other_repeats({name: episode.meta for name, episode in recorded.items()}, values)
    networks = _networks(config, group, regressors, simulated)
    jobs = []
    for fit_name, name, number, fit in fitted:
        label = name if fit_name == name else f"{fit_name}-{name}"  # unique, since a joint fit has several episodes
        real = not recorded[name].meta.get("truth")
        jobs.append(
            Job(
                scenario=scenario,
                group=group,
                name=label,
                fit=fit_name,
                recording=number,
                episode=recorded[name],
                fitted=fit,
                predictions=[network.of(recorded[name]) for network in networks],
                # No transfers between simulated targets: they share labels, but not parameters.
                transfers=others[name] if real and len(fit.episodes) == 1 else {},
                settings=config.evaluate.comparison(f"{group}/{label}", config.fit),
                kept=kept / group / f"{label}.json",
            )
        )
    return jobs


@dataclass(frozen=True)
class _Network:
    """A trained network, or the reason why there is none."""

    model: str
    regressor: Regressor | None
    reason: str
    expected: bool
    seconds: Mapping[str, float]
    """Wall times of data set and training [s]."""
    level: float | None
    """Probability of the intervals of a posterior network. None: no intervals."""

    def of(self, episode: Episode) -> Estimate | Gap:
        if self.regressor is None:
            return Gap(self.model, self.reason, self.expected)
        began = time.perf_counter()
        try:
            prediction = predict_episode(self.regressor, episode)
        except EpisodeError as error:
            return Gap(self.model, str(error))
        values = dict(zip(prediction.names, prediction.values[0].tolist(), strict=True))
        seconds, intervals = {**self.seconds, "inference": time.perf_counter() - began}, None
        if prediction.samples is not None and self.level is not None:
            intervals = prediction.first_intervals(self.level)
        return predicted(self.model, values, seconds, intervals)


def _networks(config: Config, scenario: str, regressors: Path, simulated: Path) -> list[_Network]:
    folder, level = regressors / scenario, config.fit.level
    asked = set(config.train.models) if scenario in config.train.scenes else set()
    found = []
    for model in (name for name in PREDICTORS if not name.startswith("published_")):
        path = folder / f"{model}.safetensors"
        seconds = {
            phase: value
            for phase, result in (
                ("dataset", simulated / scenario),
                ("training", path),
            )
            if not read_timings(result).get("resumed") and (value := read_seconds(result)) is not None
        }
        if path.is_file():
            try:
                found.append(_Network(model, Regressor.read(path), "", True, seconds, level))
            except CheckpointError as error:
                found.append(_Network(model, None, str(error), True, {}, level))
        elif model in asked:
            found.append(_Network(model, None, f"no checkpoint {path}; run `diffcloud network train`", True, {}, level))
        elif model != "posterior":  # the posterior network is optional, so it is not reported as missing
            reason = "not trained for this scenario (train.scenes, train.models)"
            found.append(_Network(model, None, reason, False, {}, level))
    return found


def write_tables(folder: Path, tables: Mapping[str, pd.DataFrame]) -> None:
    """Write each table as a CSV file."""
    for name, table in tables.items():
        write_text(folder / f"{name}.csv", table.to_csv(index=False))
