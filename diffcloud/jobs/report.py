"""Write the pipeline's report page of all fits as a single HTML file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import diffcloud
from diffcloud.errors import ConfigError
from diffcloud.estimation.record import read_fit
from diffcloud.estimation.result import read_motion
from diffcloud.evaluation.intervals import Intervals
from diffcloud.evaluation.record import ComparisonFile, FitRow, PredictionRow, check_file
from diffcloud.evaluation.summary import tables as comparison_tables
from diffcloud.io.episodes import read_episode
from diffcloud.io.files import read_json, together, write_bytes, write_text
from diffcloud.io.tables import read_csv
from diffcloud.jobs.fits import fit_file
from diffcloud.jobs.settings import Config
from diffcloud.reporting.comparison import ComparisonEntry
from diffcloud.reporting.figures import comparison_figures, overlay_figure
from diffcloud.reporting.page import EpisodeEntry, build_page
from diffcloud.reporting.regressors import TrainingEntry


def write_report(
    out: Path, config: Config, params: Path | None, *, fits: Path, episodes: Path, regressors: Path, tables: Path
) -> tuple[int, int]:
    """Write the page, and its figures in a folder beside it.

    Args:
        params: settings file, whose name is shown on the page.
        fits: folder with <scenario>/<episode>.json and .npz.
        episodes: folder with <scenario>/<episode>.npz.
        regressors: folder with <scenario>/<model>/training.json, which may be missing.
        tables: folder that the stage `evaluate` has written.

    Returns:
        Number of episodes, and size of the page [bytes].

    Raises:
        ConfigError, EpisodeError: a table, fit or episode is missing or damaged.
    """
    table = tables / "fits.csv"
    if not table.is_file():
        raise ConfigError(f"No such table: {table}; run `python -m pipeline.evaluate` first.")
    entries: list[EpisodeEntry] = []
    compared = _compared(tables)
    intervals = {
        (record["scenario"], record["fit"]): Intervals.model_validate(record["intervals"])
        for record in compared["records"]
        if record["intervals"] is not None
    }
    rows = table_rows(table)
    check_file(list[FitRow], table, rows)
    for known in rows:
        scenario, name = str(known["scenario"]), str(known["episode"])
        path = fit_file(fits, scenario, name)
        fit = read_fit(path)
        known = {"rms_start_mm": float("nan"), "rms_other_frames_mm": float("nan"), **known}
        index = next((i for i, one in enumerate(fit.episodes) if one.scenario == scenario), 0)
        source = fit.episodes[index].name
        entries.append(
            EpisodeEntry(
                scenario=scenario,
                name=name,
                row=known,
                fit=fit,
                recording=fit.episodes[index],
                episode=read_episode(episodes / scenario / f"{source}.npz"),
                motion=read_motion(path.with_suffix(".npz"), index),
                pictures=_pictures(episodes / scenario, source),
                intervals=intervals.get((scenario, name)),
            )
        )
    trainings = [
        TrainingEntry.read(path) for name in config.scenes for path in sorted((regressors / name).glob("*/training.json"))
    ]
    environment = {
        "commands": "dvc repro: episodes, preprocess, simulate, fit, train, evaluate, report (dvc.yaml)",
        "parameters": "params.yaml" if params is None else str(params),
        "seed of the fits": str(config.fit.seed),
        "seed of the comparison": str(config.evaluate.seed),
        "diffcloud": diffcloud.__version__,  # versions and times of a single run are beside each fit (`io.timings`)
    }
    comparison = _comparison(compared, entries)
    predictions = table_rows(tables / "predictions.csv")
    check_file(list[PredictionRow], tables / "predictions.csv", predictions)
    page = build_page(
        entries,
        title=config.report.title,
        cloud_points=config.report.cloud_points,
        environment=environment,
        predictions=predictions,
        trainings=trainings,
        comparison=comparison,
    )
    with together():
        for figure in comparison.figures:
            write_text(out.parent / "figures" / f"{figure.name}.svg", figure.svg)
            write_bytes(out.parent / "figures" / f"{figure.name}.png", figure.png)
        write_text(out, page)
    return len(entries), len(page.encode())


def _compared(folder: Path) -> dict[str, Any]:
    """Read what the stage `evaluate` has written.

    Raises:
        ConfigError: the results are missing or invalid.
    """
    whole: dict[str, Any] = read_json(folder / "comparison.json", error=ConfigError)
    check_file(ComparisonFile, folder / "comparison.json", whole)
    return whole


def _comparison(whole: dict[str, Any], entries: list[EpisodeEntry]) -> ComparisonEntry:
    """What the stage `evaluate` has written, with figures."""
    records, failures = whole["records"], whole["failures"]
    references = {(scenario, name): float(loss) for scenario, name, loss in whole["references"]}
    told = comparison_tables(records, {}, references)
    histories = {(entry.scenario, entry.name): entry.fit.history for entry in entries}
    figures = comparison_figures(told, records, histories)
    overlays = overlay_figure(entries)
    return ComparisonEntry(told, records, failures, [*figures, *([overlays] if overlays else [])])


def _pictures(folder: Path, name: str) -> dict[str, bytes]:
    """Pictures of a raw episode that the stage `preprocess` wrote (caption -> PNG). Empty for other episodes."""
    kinds = {"mask": "masked (red) and kept as cloth (green)", "cloud": "merged cloud from above, along y and along x"}
    files = {caption: folder / f"{name}.{kind}.png" for kind, caption in kinds.items()}
    return {caption: path.read_bytes() for caption, path in files.items() if path.is_file()}


_NAMES = ("scenario", "episode", "model")
"""Columns that are read as text, even if a name looks like a number."""


def table_rows(table: Path) -> list[dict[str, Any]]:
    """Return the rows of a table as column -> value, without NaN. Empty if the table does not exist."""
    if not table.is_file():
        return []
    return [
        {str(key): value for key, value in row.items() if not (isinstance(value, float) and np.isnan(value))}
        for row in read_csv(table, kind="table", error=ConfigError, text=_NAMES).to_dict("records")
    ]
