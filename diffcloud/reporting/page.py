"""Build the report page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from diffcloud.estimation.record import FitRecord, RecordingFit
from diffcloud.estimation.result import FittedMotion
from diffcloud.evaluation.intervals import Intervals
from diffcloud.evaluation.summary import percent
from diffcloud.io.episodes import Episode
from diffcloud.reporting.comparison import (
    ComparisonEntry,
    comparison_failures,
    comparison_overview,
    comparison_pictures,
    comparison_sections,
)
from diffcloud.reporting.overlay import Overlay, fitted_layers, recorded_layers
from diffcloud.reporting.poses import poses_table
from diffcloud.reporting.recordings import recordings_pictures, recordings_table
from diffcloud.reporting.regressors import TrainingEntry, errors_table, predictions_table, training_data
from diffcloud.reporting.rendering import render
from diffcloud.reporting.tables import Cell, Table, number, table
from diffcloud.reporting.uncertainty import NamedFit, parameters_table, sources_table

_CLEARLY = 1.05
"""Smallest factor between a nuisance parameter and the centre of its prior that the table shows."""


@dataclass(frozen=True)
class EpisodeEntry:
    """One recording of a fit as the page shows it."""

    scenario: str
    name: str
    row: Mapping[str, Any]
    """Of `evaluation.summary.fit_table`."""
    fit: FitRecord
    recording: RecordingFit
    """The recording that is shown: of a joint fit, the first of this scenario."""
    episode: Episode
    """Of that recording."""
    motion: FittedMotion
    pictures: Mapping[str, bytes] = field(default_factory=dict)
    """Caption -> PNG, of episodes made from raw recordings."""
    intervals: Intervals | None = None

    @property
    def label(self) -> str:
        return f"{self.scenario} / {self.name}"

    @property
    def frames(self) -> list[int]:
        """The frames of the recording that were simulated."""
        end = self.motion.times[-1] + 1e-6
        return [frame for frame, time in enumerate(self.episode.times) if time <= end]

    @property
    def shown_frame(self) -> int:
        """The compared frame with the largest residual."""
        return self.recording.frames[int(np.argmax(self.recording.frame_rms_mm))]


@dataclass(frozen=True)
class Summary:
    """What a person reads first, on the page and in the terminal."""

    status: str
    good: bool | None
    """False: the result should not be used as it is. None: with care."""
    residual: str
    parameters: Table
    findings: Sequence[str]
    """Sentences on the fit to the recordings."""
    held_out: str
    """Whether the parameters predict recordings that the fit did not use."""
    next_steps: Sequence[str]


def build_page(
    entries: Sequence[EpisodeEntry],
    *,
    title: str,
    cloud_points: int,
    environment: Mapping[str, str],
    summary: Summary | None = None,
    predictions: Sequence[Mapping[str, Any]] = (),
    trainings: Sequence[TrainingEntry] = (),
    comparison: ComparisonEntry | None = None,
    seed: int = 0,
) -> str:
    """Return the page as HTML text.

    Args:
        cloud_points: points of the recorded cloud shown per frame.
        environment: name -> value lines for the last section.
        summary: first screen of the page. Default: a table of all fits, for the pipeline.
        predictions: rows of the table of predictions.
        comparison: of all methods; left out if not given.
        seed: of the choice of shown points.
    """
    rng = np.random.default_rng(seed)
    fitted_mm = {(entry.scenario, entry.name): entry.row["rms_mm"] for entry in entries}
    missing = comparison_failures(comparison) if comparison else []
    failures = [*missing, *(f"{entry.name}: {text}" for entry in entries for text in entry.fit.failures)]
    one_fit = summary is not None
    named = [_named(index, entry) for index, entry in enumerate(entries)]
    worst = max(range(len(entries)), key=lambda index: max(entries[index].recording.frame_rms_mm), default=0)
    return render(
        "page.html",
        title=title,
        summary=summary or _summary(entries, named, len(failures)),
        one_fit=one_fit,
        sources=sources_table(named[:1] if one_fit else named),
        overview=comparison_overview(comparison) if comparison else None,
        sections=comparison_sections(comparison) if comparison else [],
        pictures=comparison_pictures(comparison) if comparison else [],
        command=comparison.command if comparison else "",
        fits=_fits_table(entries),
        poses=poses_table([(entry.label, entry.fit) for entry in entries]),
        predictions=predictions_table(predictions, fitted_mm),
        errors=errors_table(trainings),
        failures=failures,
        recordings=recordings_table(entries),
        photographs=recordings_pictures(entries),
        environment=environment,
        overlays=[_overlay(entry, cloud_points, rng).data() for entry in entries],
        opens=worst,
        episodes=[_curves(entry) for entry in entries],
        trainings=training_data(trainings),
    )


def _named(index: int, entry: EpisodeEntry) -> NamedFit:
    true = {name: entry.row[f"true_{name}"] for name in entry.fit.parameters if f"true_{name}" in entry.row}
    return NamedFit(entry.name, entry.fit, entry.intervals, true, index)


def _summary(entries: Sequence[EpisodeEntry], named: Sequence[NamedFit], failed: int) -> Summary:
    """The first screen for several fits."""
    followed = [entry.intervals.fits_to_noise for entry in entries if entry.intervals is not None]
    parts = [f"{sum(followed)} of {len(followed)} fit to the noise"] if followed else []
    status = ", ".join([f"{len(entries)} {'fit' if len(entries) == 1 else 'fits'}", *parts])
    findings = []
    starts = [entry.row["rms_start_mm"] for entry in entries if math.isfinite(entry.row["rms_start_mm"])]
    if starts:
        findings.append(f"Before the fits, the mean residual was {np.mean(starts):.1f} mm.")
    errors = [
        abs(np.log(entry.row["fitted_ratio"] / entry.row["true_ratio"])) for entry in entries if "true_ratio" in entry.row
    ]
    if errors:
        findings.append(
            f"The true ratio of stretching to density is known for {len(errors)} of them. The median error of the fitted "
            f"ratio is {percent(float(np.expm1(np.median(errors))))}."
        )
    others = [entry.row["rms_other_frames_mm"] for entry in entries if math.isfinite(entry.row["rms_other_frames_mm"])]
    return Summary(
        status=status,
        good=None if not followed else all(followed),
        residual=f"mean residual {np.mean([entry.row['rms_mm'] for entry in entries]):.1f} mm RMS" if entries else "",
        parameters=parameters_table(named),
        findings=findings,
        held_out=f"On frames that the fits did not use, the mean residual is {np.mean(others):.1f} mm." if others else "",
        next_steps=[f"Failures ({failed}) are listed under “What failed”."] if failed else [],
    )


def _overlay(entry: EpisodeEntry, points: int, rng: np.random.Generator) -> Overlay:
    """The frames that were simulated."""
    frames = entry.frames
    times = entry.episode.times[frames]
    layers = recorded_layers(entry.episode, frames, points=points, rng=rng, gripper=False)
    layers += fitted_layers(entry.motion, times)
    found = dict(zip(entry.recording.frames, entry.recording.frame_rms_mm, strict=True))
    opens = min(entry.shown_frame, len(frames) - 1)
    return Overlay(entry.label, frames, times, layers, opens, residuals_mm=[found.get(frame) for frame in frames])


def _curves(entry: EpisodeEntry) -> dict[str, Any]:
    best = np.minimum.accumulate([min(v for v in row if v is not None) for row in entry.fit.history.loss])
    times = entry.episode.times[entry.recording.frames]
    return {
        "name": entry.label,
        "loss": [float(f"{value:.4g}") for value in best],
        "times": [round(float(time), 3) for time in times],
        "residuals_mm": [round(value, 2) for value in entry.recording.frame_rms_mm],
    }


def _fits_table(entries: Sequence[EpisodeEntry]) -> Table:
    heads = ["recording", "scenario", "fabric", "start mm", "fitted mm", "other frames mm", "stretching / density"]
    heads += ["nuisance material", "iterations", "simulations"]
    return table(heads, (_fit_row(index, entry) for index, entry in enumerate(entries)))


def _fit_row(index: int, entry: EpisodeEntry) -> list[Cell]:
    row, fit = entry.row, entry.fit
    true_ratio = row.get("true_ratio")
    return [
        Cell(entry.name, episode=index),
        Cell(entry.scenario, note=fit.grasps),
        Cell(str(entry.episode.meta.get("fabric", ""))),
        number(row["rms_start_mm"], 1),
        replace(number(row["rms_mm"], 1), strong=True),
        number(row["rms_other_frames_mm"], 1),
        number(row.get("fitted_ratio"), 2, note="" if true_ratio is None else f"true {true_ratio:.2f}"),
        _nuisance_cell(fit),
        number(fit.iterations, 0),
        number(fit.simulations, 0),
    ]


def _nuisance_cell(fit: FitRecord) -> Cell:
    """Nuisance material that is clearly off the centre of its prior, as a multiple of it."""
    parts = {name: one.value / one.centre for name, one in fit.parameters.items() if one.role != "requested" and one.centre}
    off = [f"{name.replace('_', ' ')} × {part:.2f}" for name, part in parts.items() if not 1 / _CLEARLY < part < _CLEARLY]
    return Cell(", ".join(off) or ("as expected" if parts else ""))
