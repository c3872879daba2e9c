"""Build the report page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from diffcloud.estimation.record import FitRecord, FittedParameter, RecordingFit
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
from diffcloud.reporting.uncertainty import intervals_table

_CLEARLY = 1.05
"""Factor by which uncertain material is off what was known of it."""


@dataclass(frozen=True)
class EpisodeEntry:
    """One fitted episode as the page shows it."""

    scenario: str
    name: str
    row: Mapping[str, Any]
    """Of `evaluation.summary.fit_table`."""
    fit: FitRecord
    recording: RecordingFit
    """That is shown: of a joint fit, the first of this scenario."""
    episode: Episode
    """Of that recording."""
    motion: FittedMotion
    pictures: Mapping[str, bytes] = field(default_factory=dict)
    """Caption -> PNG, of episodes made from raw recordings."""
    loss_frames: tuple[int, ...] = (-1,)
    """Of the scenario; negative ones count from the end."""

    @property
    def frames(self) -> list[int]:
        """The frames of the recording that were simulated."""
        end = self.motion.times[-1] + 1e-6
        return [frame for frame, time in enumerate(self.episode.times) if time <= end]

    @property
    def shown_frame(self) -> int:
        """The scenario's last loss frame that the fit compared, otherwise the last compared frame."""
        count = self.episode.frame_count
        named = {frame + count if frame < 0 else frame for frame in self.loss_frames}
        return max(named.intersection(self.recording.frames), default=self.recording.frames[-1])


def build_page(
    entries: Sequence[EpisodeEntry],
    *,
    title: str,
    cloud_points: int,
    environment: Mapping[str, str],
    predictions: Sequence[Mapping[str, Any]] = (),
    trainings: Sequence[TrainingEntry] = (),
    comparison: ComparisonEntry | None = None,
    findings: Sequence[str] = (),
    intervals: Intervals | None = None,
    seed: int = 0,
) -> str:
    """The page as HTML text.

    Args:
        cloud_points: points of the recorded cloud shown per frame.
        environment: name -> value lines for the last section.
        predictions: rows of the table of predictions.
        comparison: of all methods; left out if not given.
        findings: sentences for the top of the page, in the place of its own.
        intervals: of a fit to all entries together.
        seed: of the choice of shown points.
    """
    rng = np.random.default_rng(seed)
    fitted_mm = {(entry.scenario, entry.name): entry.row["rms_mm"] for entry in entries}
    missing = comparison_failures(comparison) if comparison else []
    return render(
        "page.html",
        title=title,
        summary=_summary(entries),
        findings=findings,
        intervals=None if intervals is None else intervals_table(intervals),
        overview=comparison_overview(comparison) if comparison else None,
        sections=comparison_sections(comparison) if comparison else [],
        pictures=comparison_pictures(comparison) if comparison else [],
        command=comparison.command if comparison else "",
        fits=_fits_table(entries),
        poses=poses_table([(f"{entry.scenario} / {entry.name}", entry.fit) for entry in entries]),
        predictions=predictions_table(predictions, fitted_mm),
        errors=errors_table(trainings),
        failures=[*missing, *(f"{entry.name}: {text}" for entry in entries for text in entry.fit.failures)],
        recordings=recordings_table(entries),
        photographs=recordings_pictures(entries),
        environment=environment,
        overlays=[_overlay(entry, cloud_points, rng).data() for entry in entries],
        episodes=[_losses(entry) for entry in entries],
        trainings=training_data(trainings),
    )


@dataclass(frozen=True)
class _Summary:
    """The first sentences of the page, in numbers."""

    episodes: int
    start_mm: float | None
    """None where no start could be simulated."""
    final_mm: float
    known: int
    """Episodes whose hidden ratio of stretching to density is known."""
    ratio_error: str
    """Median factor by which the fits miss it, less one, as a percentage."""


def _overlay(entry: EpisodeEntry, points: int, rng: np.random.Generator) -> Overlay:
    """The frames that were simulated."""
    frames = entry.frames
    times = entry.episode.times[frames]
    layers = recorded_layers(entry.episode, frames, points=points, rng=rng, gripper=False)
    layers += fitted_layers(entry.motion, times)
    return Overlay(f"{entry.scenario} / {entry.name}", frames, times, layers, min(entry.shown_frame, len(frames) - 1))


def _losses(entry: EpisodeEntry) -> dict[str, Any]:
    best = np.minimum.accumulate([min(v for v in row if v is not None) for row in entry.fit.history.loss])
    return {"name": f"{entry.scenario} / {entry.name}", "loss": [float(f"{value:.4g}") for value in best]}


def _summary(entries: Sequence[EpisodeEntry]) -> _Summary:
    errors = [
        abs(np.log(entry.row["fitted_ratio"] / entry.row["true_ratio"])) for entry in entries if "true_ratio" in entry.row
    ]
    starts = np.array([entry.row["rms_start_mm"] for entry in entries])
    return _Summary(
        len(entries),
        float(np.nanmean(starts)) if np.isfinite(starts).any() else None,
        float(np.mean([entry.row["rms_mm"] for entry in entries])),
        len(errors),
        percent(float(np.expm1(np.median(errors)))) if errors else "",
    )


def _fits_table(entries: Sequence[EpisodeEntry]) -> Table:
    names: dict[str, None] = {}
    for entry in entries:
        names |= dict.fromkeys(name for name, one in entry.fit.parameters.items() if one.role == "requested")
    heads = ("episode", "scenario", "fabric", "start mm", "fitted mm", "other frames mm", *names)
    heads = (*heads, "stretching / density", "also fitted", "iterations", "simulations")
    return table(heads, (_fit_row(index, entry, list(names)) for index, entry in enumerate(entries)))


def _fit_row(index: int, entry: EpisodeEntry, names: Sequence[str]) -> list[Cell]:
    row, fit = entry.row, entry.fit
    true_ratio = row.get("true_ratio")
    return [
        Cell(entry.name, episode=index),
        Cell(entry.scenario, note=fit.grasps),
        Cell(str(entry.episode.meta.get("fabric", ""))),
        number(row["rms_start_mm"], 1),
        replace(number(row["rms_mm"], 1), strong=True),
        number(row["rms_other_frames_mm"], 1),
        *(_parameter_cell(fit.parameters.get(name), row.get(f"true_{name}")) for name in names),
        number(row.get("fitted_ratio"), 2, note="" if true_ratio is None else f"true {true_ratio:.2f}"),
        _along_cell(fit),
        number(fit.iterations, 0),
        number(fit.simulations, 0),
    ]


def _along_cell(fit: FitRecord) -> Cell:
    """Nuisance material that is clearly off the centre of its prior, as a multiple of it."""
    parts = {name: one.value / one.centre for name, one in fit.parameters.items() if one.role != "requested" and one.centre}
    off = [f"{name.replace('_', ' ')} × {part:.2f}" for name, part in parts.items() if not 1 / _CLEARLY < part < _CLEARLY]
    return Cell(", ".join(off) or ("as known" if parts else ""))


def _parameter_cell(fitted: FittedParameter | None, true: float | None) -> Cell:
    if fitted is None:
        return Cell("")
    notes = [] if true is None else [f"true {true * fitted.nominal:.3g}"]
    notes += ["at its bound"] if fitted.at_bound else []
    notes += ["given"] if fitted.fixed else []
    return Cell(f"{fitted.value:.3g} {fitted.unit}", sort=fitted.value, note=" · ".join(notes))
