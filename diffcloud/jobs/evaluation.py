"""Write the results of the comparison of all methods: metrics, tables, wall times."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from rich.table import Table

from diffcloud.console import errors, show
from diffcloud.errors import ConfigError
from diffcloud.estimation.record import read_fit
from diffcloud.evaluation.page import comparison_page
from diffcloud.evaluation.summary import PREDICTORS, headline, label, sentences, tables
from diffcloud.evaluation.summary import metrics as summary_metrics
from diffcloud.io.files import claimed, files_in, together, write_json, write_text
from diffcloud.jobs.comparison import Comparison, compare, comparison_jobs, write_tables
from diffcloud.jobs.fits import joint_fit
from diffcloud.jobs.scenarios import choose_scenario
from diffcloud.jobs.settings import Config


def evaluate(
    config: Config,
    *,
    fits: Path,
    episodes: Path,
    regressors: Path,
    simulated: Path,
    out: Path,
    markdown: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    as_json: bool = False,
) -> tuple[dict[str, Any], Comparison]:
    """Compare all methods on all episodes. Ctrl-C keeps finished episodes.

    Args:
        fits: folder with <scenario>/<episode>.json.
        episodes: folder with <scenario>/<episode>.npz.
        regressors: folder with <scenario>/<model>.safetensors, which may be missing.
        simulated: folder with the simulated sets <scenario>/, which may be missing.
        out: folder for metrics.json, seconds.csv and tables/.
        markdown: path of a page with the tables, if wanted.

    Raises:
        ConfigError: there are no fits.
        DiffCloudError: all comparisons failed.
    """
    if not joint_fit(fits) and not any(files_in(fits / name, ".json") for name in config.scenes):
        raise ConfigError(f"{fits} holds no fits of {', '.join(config.scenes)}; run `python -m pipeline.fit` first.")
    jobs = [
        job
        for name in config.scenes
        for job in comparison_jobs(
            config,
            name,
            choose_scenario(name),
            fits=fits,
            episodes=episodes,
            regressors=regressors,
            simulated=simulated,
            kept=out / "episodes",
        )
    ]
    with claimed(out):
        comparison = compare(jobs, workers, scheduler)
        metrics = write_evaluation(
            config,
            comparison,
            fits=fits,
            out=out,
            markdown=markdown,
            command="python -m pipeline.evaluate",
            as_json=as_json,
        )
    return metrics, comparison


def write_evaluation(
    config: Config,
    comparison: Comparison,
    *,
    fits: Path,
    out: Path,
    markdown: Path | None,
    command: str,
    as_json: bool,
    references: Mapping[tuple[str, str], float] | None = None,
) -> dict[str, Any]:
    """Write metrics, wall times and tables, print the main ones, and return all metrics.

    Args:
        fits: folder with <scenario>/<episode>.json.
        markdown: path of a page with the tables, if wanted.
        command: what the page names as its source.
        references: see `summary.method_table`.
    """
    curves, residuals = _curves(config, fits)
    predictions = _predictions(comparison.records)
    told = tables(comparison.records, comparison.seconds, references)
    metrics = _metrics(told["fits"], predictions) | {"comparison": summary_metrics(told)}
    frames = {
        "losses": pd.DataFrame(curves),
        "residuals": pd.DataFrame(residuals),
        "predictions": pd.DataFrame(predictions, columns=_columns(predictions)),
        **{name: table for name, table in told.items() if name != "seconds"},
    }
    known = [[*key, loss] for key, loss in (references or {}).items()]
    whole = {"records": comparison.records, "failures": comparison.failures, "references": known}
    with together():
        write_tables(out / "tables", frames)
        write_json(out / "tables" / "comparison.json", whole)
        write_tables(out, {"seconds": told["seconds"]})  # not in tables/, because wall times differ between runs
        if markdown is not None:
            write_text(markdown, comparison_page(told, comparison.missing, config.report.title, command))
        write_json(out / "metrics.json", headline(told))
    for table in printed(told):
        show(table, as_json)
    for sentence in (line for lines in sentences(told).values() for line in lines):
        errors.print(sentence, soft_wrap=True)
    errors.print(f"Wrote {out / 'metrics.json'} and {out / 'tables'}.")
    return metrics


def printed(told: Mapping[str, pd.DataFrame]) -> list[Table]:
    """Tables for a terminal: losses per episode, and means per scenario and method."""
    means = Table("scenario", "method", "episodes", "loss", "rms mm", "other frames mm", "two-sided", "best", "runs")
    for row in told["means"].to_dict("records"):
        cells = (row[key] for key in ("rms_mm", "rms_other_frames_mm", "two_sided", "best", "simulations"))
        means.add_row(
            str(row["scenario"]), label(row["method"]), str(row["episodes"]), f"{row['loss']:.3e}", *map(_cell, cells)
        )
    methods = told["methods"][told["methods"]["status"] == "ok"]
    names = list(dict.fromkeys(methods["method"]))
    losses = Table("scenario", "episode", *(label(name) for name in names))
    for (scenario, episode), group in methods.groupby(["scenario", "episode"], sort=False):
        known = dict(zip(group["method"], group["loss"], strict=True))
        losses.add_row(str(scenario), str(episode), *(f"{known[name]:.3e}" if name in known else "–" for name in names))
    return [losses, means]


def _curves(config: Config, fits: Path) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the loss of each iteration and the RMS of each frame, for all fits."""
    curves: list[dict[str, Any]] = []
    residuals: list[dict[str, Any]] = []
    named = [path for name in config.scenes for path in files_in(fits / name, ".json")]
    for path in [*named, *joint_fit(fits)]:
        fit = read_fit(path)
        curves += [
            {"scenario": fit.scenario, "episode": path.stem, "iteration": i, "loss": min(filter(None, row))}
            for i, row in enumerate(fit.history.loss)
            if any(value is not None for value in row)
        ]
        residuals += [
            {"scenario": one.scenario, "episode": one.name, "frame": frame, "rms_mm": rms}
            for one in fit.episodes
            for frame, rms in zip(one.frames, one.frame_rms_mm, strict=True)
        ]
    return curves, residuals


def _predictions(records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row per network and episode: predicted parameters, and the loss of the simulation with them."""
    return [
        {"scenario": record["scenario"], "episode": record["episode"], "model": row["method"]}
        | {f"predicted_{name}": value for name, value in row["values"].items()}
        | {f"true_{name}": record["truth"][name] for name in row["values"] if name in record["truth"]}
        | {key: row[key] for key in ("inside", "loss", "rms_mm")}
        for record in records
        for row in record["methods"]
        if row["method"] in PREDICTORS
    ]


def _columns(predictions: list[dict[str, Any]]) -> list[str]:
    """Column names of the table of predictions. An empty table has the first three columns."""
    return list(dict.fromkeys(["scenario", "episode", "model", *(key for row in predictions for key in row)]))


def _metrics(fits: pd.DataFrame, predictions: list[dict[str, Any]]) -> dict[str, Any]:
    by_scenario: dict[str, Any] = {}
    for name, group in fits.groupby("scenario", sort=False) if len(fits) else ():
        columns = ("loss_start", "loss", "rms_mm", "rms_other_frames_mm")  # all may be missing in some rows
        by_scenario[str(name)] = {column: float(group[column].mean()) for column in columns if group[column].notna().any()}
    episodes = {
        f"{row['scenario']}/{row['episode']}": {k: v for k, v in row.items() if isinstance(v, float) and not math.isnan(v)}
        for row in fits.to_dict("records")
    }
    by_model: dict[str, Any] = {}
    if predictions:
        means = pd.DataFrame(predictions).groupby(["scenario", "model"], sort=False)[["loss", "rms_mm"]].mean()
        for row in means.reset_index().to_dict("records"):
            by_model.setdefault(row["scenario"], {})[row["model"]] = {key: float(row[key]) for key in ("loss", "rms_mm")}
    return {"scenes": by_scenario, "episodes": episodes, "regressors": by_model}


def _cell(value: float | int | None) -> str:
    return "–" if value is None or value != value else f"{value:.3g}"
