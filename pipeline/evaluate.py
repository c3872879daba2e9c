"""`diffcloud evaluate`: the loss of given parameters, and the tables over all fits."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import torch
import typer
from rich.table import Table

from diffcloud.errors import ConfigError
from diffcloud.fit import Objective, read_fit
from diffcloud.fit.measure import measure_fit, measure_parameters
from diffcloud.fit.parameters import NUISANCE
from diffcloud.io.episodes import read_episode
from diffcloud.io.files import write_json, write_text
from diffcloud.regressors import Regressor, predict_episode
from pipeline.config import EvaluateConfig, load_config
from pipeline.console import JsonFlag, ParamsFile, assignments, errors, finish, output, progress_bar
from pipeline.scenario_options import ScenarioName, SceneFile, choose_scenario

app = typer.Typer(help="Measure parameters and fits.")


@app.command()
def loss(
    episode: Annotated[Path, typer.Argument(help="Episode file.")],
    scenario: ScenarioName = None,
    scene: SceneFile = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="PARAMETER=VALUE, repeatable.")] = None,
    points: Annotated[int | None, typer.Option(help="Sampled per frame.")] = None,
    frame: Annotated[list[int] | None, typer.Option(help="Loss frame, repeatable.")] = None,
    seed: Annotated[int, typer.Option(help="Of the sampled points; fits use 0.")] = 0,
    json: JsonFlag = False,
) -> None:
    """One-sided Chamfer loss of one parameter set on one episode, with the metric and points that a fit uses."""
    chosen = choose_scenario(scenario, scene)
    objective = Objective(chosen, [read_episode(episode)], points=points, frames=frame, seed=seed)
    values = assignments(set_, "--set")
    tensors = {name: torch.tensor([value], dtype=objective.system.dtype) for name, value in values.items()}
    nuisance = {name: tensors.pop(name) for name in list(tensors) if name in NUISANCE}
    with torch.no_grad():
        found = float(objective(tensors, nuisance)[0])
    if not json:
        output.print(f"{found:.6e}")
    finish({"loss": found, "parameters": values, "length_unit_m": chosen.length_unit_m}, json)


@app.callback(invoke_without_command=True)
def evaluate(
    context: typer.Context,
    fits: Annotated[Path, typer.Option(help="Folder with <scenario>/<episode>.json.")] = Path("data/fits"),
    episodes: Annotated[Path, typer.Option(help="Folder with <scenario>/<episode>.npz.")] = Path("data/episodes"),
    regressors: Annotated[Path, typer.Option(help="Folder with <scenario>/<model>.safetensors; may lack any.")] = Path(
        "data/regressors"
    ),
    out: Annotated[Path, typer.Option(help="Folder for metrics.json, timings.json and tables/.")] = Path("reports"),
    params: ParamsFile = None,
    json: JsonFlag = False,
) -> None:
    """Measure every fit, and what regressors predict, on its episode: metrics.json, timings.json, and tables."""
    if context.invoked_subcommand is not None:
        return
    config = load_config(params)
    rows: list[dict[str, Any]] = []
    curves: list[dict[str, Any]] = []
    seconds: dict[str, float] = {}
    files = [path for name in config.scenarios for path in sorted((fits / name).glob("*.json"))]
    if not files:
        raise ConfigError(f"{fits} holds no fits of {', '.join(config.scenarios)}; run `diffcloud fit` first.")
    with progress_bar("evaluate", len(files)) as update:
        for index, path in enumerate(files):
            summary = read_fit(path)
            scenario = choose_scenario(path.parent.name)
            recorded = [read_episode(episodes / path.parent.name / f"{name}.npz") for name in summary["episodes"]]
            rows.append(
                {"scenario": path.parent.name, "episode": path.stem}
                | measure_fit(scenario, recorded, summary, draws=config.evaluate.draws, seed=config.evaluate.seed)
            )
            curves += [
                {"scenario": path.parent.name, "episode": path.stem, "iteration": i, "loss": min(filter(None, row))}
                for i, row in enumerate(summary["history"]["loss"])
                if any(value is not None for value in row)
            ]
            seconds[f"{path.parent.name}/{path.stem}"] = summary["seconds"]
            update(index + 1, path.stem)
    predictions = [
        row for name in config.scenarios for row in _predictions(regressors / name, episodes / name, config.evaluate)
    ]
    metrics = _metrics(rows, predictions)
    table = pd.DataFrame(rows)
    write_text(out / "tables" / "fits.csv", table.to_csv(index=False))
    write_text(out / "tables" / "losses.csv", pd.DataFrame(curves).to_csv(index=False))
    write_text(
        out / "tables" / "predictions.csv", pd.DataFrame(predictions, columns=_columns(predictions)).to_csv(index=False)
    )
    write_json(out / "metrics.json", metrics)
    write_json(out / "timings.json", {"fit_seconds": seconds})
    if not json:
        _print(rows, ("rms_start_mm", "rms_mm", "rms_other_frames_mm"), "fitted_")
        _print(predictions, ("model", "rms_mm"), "predicted_")
    errors.print(f"Wrote {out / 'metrics.json'} and {out / 'tables'}.")
    finish({"metrics": metrics}, json)


def _predictions(checkpoints: Path, episodes: Path, config: EvaluateConfig) -> list[dict[str, Any]]:
    """A row for each model and episode of a scenario: what is predicted, and the loss of the simulation with it."""
    found = {path.stem: Regressor.read(path) for path in sorted(checkpoints.glob("*.safetensors"))}
    if not found:
        return []
    scenario = choose_scenario(checkpoints.name)
    rows: list[dict[str, Any]] = []
    for path in sorted(episodes.glob("*.npz")):
        episode = read_episode(path)
        predicted = {model: predict_episode(regressor, episode) for model, regressor in found.items()}
        clipped = [dict(zip(p.names, p.clipped[0].tolist(), strict=True)) for p in predicted.values()]
        measured = measure_parameters(scenario, episode, clipped, draws=config.draws, seed=config.seed)
        truth = episode.meta.get("truth") or {}
        for (model, prediction), losses in zip(predicted.items(), measured, strict=True):
            values = dict(zip(prediction.names, prediction.values[0].tolist(), strict=True))
            rows.append(
                {"scenario": checkpoints.name, "episode": path.stem, "model": model}
                | {f"predicted_{name}": value for name, value in values.items()}
                | {f"true_{name}": float(truth[name]) for name in values if name in truth}
                | {"inside": bool(prediction.inside.all())}
                | losses
            )
    return rows


def _columns(predictions: list[dict[str, Any]]) -> list[str]:
    """Of the table of predictions, which has its first ones also when it is empty."""
    return list(dict.fromkeys(["scenario", "episode", "model", *(key for row in predictions for key in row)]))


def _metrics(rows: list[dict[str, Any]], predictions: list[dict[str, Any]]) -> dict[str, Any]:
    by_scenario: dict[str, Any] = {}
    for name, group in pd.DataFrame(rows).groupby("scenario", sort=False):
        by_scenario[str(name)] = {
            "loss_start": float(group["loss_start"].mean()),
            "loss": float(group["loss"].mean()),
            "rms_mm": float(group["rms_mm"].mean()),
            "rms_other_frames_mm": float(group["rms_other_frames_mm"].mean()),
        }
    episodes = {
        f"{row['scenario']}/{row['episode']}": {k: v for k, v in row.items() if isinstance(v, float)} for row in rows
    }
    by_model: dict[str, Any] = {}
    if predictions:
        means = pd.DataFrame(predictions).groupby(["scenario", "model"], sort=False)[["loss", "rms_mm"]].mean()
        for row in means.reset_index().to_dict("records"):
            by_model.setdefault(row["scenario"], {})[row["model"]] = {key: float(row[key]) for key in ("loss", "rms_mm")}
    return {"scenarios": by_scenario, "episodes": episodes, "regressors": by_model}


def _print(rows: list[dict[str, Any]], columns: tuple[str, ...], prefix: str) -> None:
    if rows:
        shown = ("episode", *columns, *(key for key in rows[0] if key.startswith(prefix)))
        table = Table(*shown)
        for row in rows:
            table.add_row(*(_cell(row.get(key)) for key in shown))
        output.print(table)


def _cell(value: object) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)
