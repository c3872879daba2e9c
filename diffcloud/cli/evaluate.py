"""`diffcloud evaluate`: the loss of given parameters, and the comparison of all methods."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import torch
import typer
from rich.table import Table

from diffcloud.cli.comparison import Comparison, compare, comparison_jobs, write_tables
from diffcloud.cli.config import Config, load_config
from diffcloud.cli.console import (
    JsonFlag,
    ParamsFile,
    Threads,
    Workers,
    assignments,
    errors,
    finish,
    output,
    say,
    show,
    with_suffix,
)
from diffcloud.cli.fit_jobs import joint_fit
from diffcloud.cli.scenario_options import ScenarioName, SceneFile, choose_scenario, fitted_scenario
from diffcloud.errors import ConfigError
from diffcloud.estimation import Objective, read_fit
from diffcloud.estimation.pose import parse_priors
from diffcloud.estimation.result import describe_recording
from diffcloud.evaluation.intervals import LEVEL, WITHIN, Intervals, intervals_of, significant
from diffcloud.evaluation.markdown import comparison_page
from diffcloud.evaluation.methods import space_of
from diffcloud.evaluation.summary import PREDICTORS, headline, label, largest_sources, sentences, tables
from diffcloud.evaluation.summary import metrics as summary_metrics
from diffcloud.io.episodes import read_episode
from diffcloud.io.files import claimed, files_in, together, write_json, write_text
from diffcloud.sim.properties import check_values, one_set
from diffcloud.sim.threads import use_threads

app = typer.Typer(help="Measure parameters, and compare methods.")
AllowMissing = Annotated[
    bool, typer.Option("--allow-missing", help="Exit with status 0 although a method or an episode is missing.")
]
MarkdownFile = Annotated[Path | None, typer.Option("--markdown", help="Write the tables to this Markdown file too.")]


@app.command()
def loss(
    episode: Annotated[Path, typer.Argument(help="Episode file.")],
    scenario: ScenarioName = None,
    scene: SceneFile = None,
    fit: Annotated[Path | None, typer.Option(help="JSON of a fit: its parameters and measure, other options win.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="PARAMETER=VALUE, repeatable.")] = None,
    points: Annotated[int | None, typer.Option(help="Sampled per frame.")] = None,
    frame: Annotated[list[int] | None, typer.Option(help="Loss frame, repeatable.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of the sampled points; 0 if no fit says.")] = None,
    paper: Annotated[
        bool,
        typer.Option("--paper", help="The published measure: from cloth to recording only, at the loss frames, no pose."),
    ] = False,
    nuisance: Annotated[str | None, typer.Option(help="As for `diffcloud fit`.")] = None,
    threads: Threads = None,
    json: JsonFlag = False,
) -> None:
    """Loss of one parameter set on one episode, by the measure and with the points of a fit, and the pose found."""
    use_threads(threads)
    measure: dict[str, Any] = {}
    values: dict[str, float] = {}
    laid: dict[str, float] = {}
    if fit is not None:
        record = read_fit(fit)
        values = dict(record.values)
        place = record.known_place(episode.stem, scenario)
        laid = record.laid_in(None if place is None else record.episodes[place])
        measure = record.measure.model_dump() if place is None else record.measured_by(place)
        if scenario is None and scene is None:
            scenario = fitted_scenario(fit, record.scenario if place is None else record.episodes[place].scenario)
    chosen = choose_scenario(scenario, scene)
    if paper:
        measure |= {"nuisance": None, "frames": None}  # the published measure has its own
    given = {"points": points, "frames": frame, "seed": seed, "paper": paper or None}
    measure |= {name: value for name, value in given.items() if value is not None}
    if nuisance is not None:
        measure["nuisance"] = parse_priors(nuisance)
    recorded = read_episode(episode)
    objective = Objective(chosen, recorded, **measure)
    values |= assignments(set_, "--set")
    check_values(values, "--set")
    chosen.check_parameters(values)
    tensors = one_set({**values, **laid})
    with torch.no_grad():
        found = describe_recording(objective, objective.simulate_to_loss(tensors), episode.stem)
    if not json:
        shifts = ", ".join(f"{name} {entry.value:.4g} {entry.unit}" for name, entry in found.nuisance.items())
        output.print(f"{found.loss:.6e}  RMS {found.rms_mm:.2f} mm" + (f"  at {shifts}" if shifts else ""))
    finish({**found.model_dump(), "parameters": values, "length_unit_m": chosen.length_unit_m}, json)


@app.command()
def intervals(
    fit: Annotated[Path, typer.Argument(help="JSON of a fit.")],
    scenario: ScenarioName = None,
    scene: SceneFile = None,
    level: Annotated[float, typer.Option(min=0.01, max=0.999, help="Share of intervals meant to hold the truth.")] = LEVEL,
    within: Annotated[float, typer.Option(help="Factor within which a parameter counts as identified.")] = WITHIN,
    out: Annotated[Path | None, typer.Option(help="JSON for the result, which `export --samples` draws from.")] = None,
    threads: Threads = None,
    json: JsonFlag = False,
) -> None:
    """Intervals of a fit's parameters, a verdict for each, and where the uncertainty comes from."""
    use_threads(threads)
    record = read_fit(fit)
    if within <= 1:
        raise ConfigError(f"--within takes a factor above 1, got {within:g}.")
    chosen = choose_scenario(scenario or fitted_scenario(fit, record.scenario), scene)
    found = intervals_of(record, space_of(record), chosen, level=level, within=within)
    if out is not None:
        write_json(with_suffix(out, ".json"), found.model_dump(mode="json"))
    if not json:
        _show_intervals(found)
    finish(found.model_dump(mode="json"), json)


def _show_intervals(found: Intervals) -> None:
    table = Table("parameter", "value", "from", "to", "SI", "verdict", "improve first")
    for name, entry in found.parameters.items():
        digits = significant(entry.low, entry.high)
        ends = digits(entry.low), digits(entry.high)
        physical = f"{digits(entry.physical_low)} to {digits(entry.physical_high)} "
        sources = largest_sources(found.sources, name)
        table.add_row(name, digits(entry.value), *ends, f"{physical}{entry.physical_unit}", entry.verdict, sources)
    output.print(table)
    if found.ratio is not None:
        output.print(f"stretch / mass {found.ratio.value:.3g}, within a factor of {found.ratio.factor:.3g}")
    for sentence in found.sentences:
        output.print(sentence, soft_wrap=True)


@app.callback(invoke_without_command=True)
def evaluate(
    context: typer.Context,
    fits: Annotated[Path, typer.Option(help="Folder with <scenario>/<episode>.json.")] = Path("data/fits"),
    episodes: Annotated[Path, typer.Option(help="Folder with <scenario>/<episode>.npz.")] = Path("data/episodes"),
    regressors: Annotated[Path, typer.Option(help="Folder with <scenario>/<model>.safetensors; may lack any.")] = Path(
        "data/regressors"
    ),
    simulated: Annotated[Path, typer.Option(help="Folder with <scenario>/ of the data sets, for wall times.")] = Path(
        "data/simulated"
    ),
    out: Annotated[Path, typer.Option(help="Folder for metrics.json, seconds.csv and tables/.")] = Path("reports"),
    markdown: MarkdownFile = None,
    allow_missing: AllowMissing = False,
    params: ParamsFile = None,
    workers: Workers = None,
    threads: Threads = None,
    json: JsonFlag = False,
) -> None:
    """Compare all methods on all episodes: metrics.json, tables, and wall times. Ctrl-C keeps finished episodes."""
    use_threads(threads)
    if context.invoked_subcommand is not None:
        return
    config = load_config(params)
    if not joint_fit(fits) and not any(files_in(fits / name, ".json") for name in config.scenarios):
        raise ConfigError(f"{fits} holds no fits of {', '.join(config.scenarios)}; run `diffcloud fit` first.")
    jobs = [
        job
        for name in config.scenarios
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
        comparison = compare(jobs, workers)
        metrics = write_evaluation(config, comparison, fits=fits, out=out, markdown=markdown, as_json=json)
    finish({"metrics": metrics, "missing": comparison.missing}, json)
    stop_if_missing(comparison, allow_missing)


def write_evaluation(
    config: Config,
    comparison: Comparison,
    *,
    fits: Path,
    out: Path,
    markdown: Path | None,
    as_json: bool,
    references: Mapping[tuple[str, str], float] | None = None,
) -> dict[str, Any]:
    """Write metrics, wall times and tables, print the main ones, and return all metrics; metrics.json has the main ones.

    Args:
        fits: folder with <scenario>/<episode>.json.
        markdown: a page of the tables, if wanted.
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
        write_tables(out, {"seconds": told["seconds"]})  # not among the tables: it differs from run to run
        if markdown is not None:
            write_text(markdown, comparison_page(told, comparison.missing, config.report.title))
        write_json(out / "metrics.json", headline(told))
    for table in printed(told):
        show(table, as_json)
    for sentence in (line for lines in sentences(told).values() for line in lines):
        errors.print(sentence, soft_wrap=True)
    errors.print(f"Wrote {out / 'metrics.json'} and {out / 'tables'}.")
    return metrics


def stop_if_missing(comparison: Comparison, allow_missing: bool) -> None:
    """Name what is missing; then exit status 1, unless that is allowed."""
    for line in comparison.missing:
        say("Missing:", line, style="yellow")
    if comparison.missing and not allow_missing:
        errors.print("The tables have labelled gaps; --allow-missing accepts them.")
        raise typer.Exit(1)


def printed(told: Mapping[str, pd.DataFrame]) -> list[Table]:
    """Means per scenario and method, and fits per episode, for a terminal."""
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
    """Of all fits: losses of each iteration, RMS of each frame."""
    curves: list[dict[str, Any]] = []
    residuals: list[dict[str, Any]] = []
    named = [path for name in config.scenarios for path in files_in(fits / name, ".json")]
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
    """A row for each network and episode: what is predicted, and the loss of the simulation with it."""
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
    """Of the table of predictions, which has its first ones also when it is empty."""
    return list(dict.fromkeys(["scenario", "episode", "model", *(key for row in predictions for key in row)]))


def _metrics(fits: pd.DataFrame, predictions: list[dict[str, Any]]) -> dict[str, Any]:
    by_scenario: dict[str, Any] = {}
    for name, group in fits.groupby("scenario", sort=False) if len(fits) else ():
        columns = ("loss_start", "loss", "rms_mm", "rms_other_frames_mm")  # starts may diverge, other frames be missing
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
    return {"scenarios": by_scenario, "episodes": episodes, "regressors": by_model}


def _cell(value: float | int | None) -> str:
    return "–" if value is None or value != value else f"{value:.3g}"
