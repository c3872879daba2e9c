"""`diffcloud fit`: find the parameters that make the simulator move as the recording does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from diffcloud.errors import ConfigError
from diffcloud.fit import AdamSettings, FitSpace, Objective, fit_adam, write_fit
from diffcloud.fit.optimise import FitOutcome, Progress
from diffcloud.fit.result import describe_fit
from diffcloud.io.episodes import Episode, read_episode
from diffcloud.scene.scenarios import Scenario
from pipeline.config import load_config, updated
from pipeline.console import JsonFlag, ParamsFile, assignments, episode_files, errors, finish, progress_bar, show
from pipeline.scenario_options import ScenarioName, SceneFile, choose_scenario

_INTERRUPTED = 130


def fit(
    episodes: Annotated[list[Path], typer.Argument(help="Episode files, or folders of them.")],
    out: Annotated[Path, typer.Option(help="Folder; one JSON and one NPZ per episode.")],
    scenario: ScenarioName = None,
    scene: SceneFile = None,
    params: ParamsFile = None,
    parameters: Annotated[str | None, typer.Option(help="Comma-separated, e.g. stretch,mass,bending.")] = None,
    fix: Annotated[list[str] | None, typer.Option(help="PARAMETER=VALUE that is known, e.g. mass=1.2.")] = None,
    bound: Annotated[list[str] | None, typer.Option(help="PARAMETER=LOW:HIGH, repeatable.")] = None,
    optimizer: Annotated[str | None, typer.Option(help="adam")] = None,
    iterations: Annotated[int | None, typer.Option(help="Updates at most.")] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Default: the scenario's.")] = None,
    starts: Annotated[int | None, typer.Option(help="Starts fitted together; the first is --init.")] = None,
    screen: Annotated[int | None, typer.Option(help="Simulate this many candidates and start from the best.")] = None,
    init: Annotated[
        str,
        typer.Option(
            help="First start: middle, PARAMETER=VALUE,..., or a regressor's prediction: mlp, ... or its checkpoint."
        ),
    ] = "middle",
    smoothing: Annotated[float | None, typer.Option(help="Perturbation whose gradients are averaged; 0: none.")] = None,
    threshold: Annotated[float | None, typer.Option(help="Stop below this loss; default: the scenario's.")] = None,
    points: Annotated[int | None, typer.Option(help="Sampled per frame.")] = None,
    frame: Annotated[list[int] | None, typer.Option(help="Loss frame, repeatable; default: the scenario's.")] = None,
    seed: Annotated[int | None, typer.Option(help="Of all random numbers.")] = None,
    resample: Annotated[bool | None, typer.Option(help="New points in each iteration.")] = None,
    offset: Annotated[bool | None, typer.Option(help="Fit a rigid offset of the target along.")] = None,
    joint: Annotated[bool | None, typer.Option("--joint", help="One parameter set for all episodes.")] = None,
    json: JsonFlag = False,
) -> None:
    """Fit episodes. Ctrl-C writes the best so far and stops."""
    settings = updated(
        load_config(params).fit,
        parameters=None if parameters is None else [name.strip() for name in parameters.split(",")],
        fixed=assignments(fix, "--fix") or None,
        bounds=_bounds(bound) or None,
        optimizer=optimizer,
        iterations=iterations,
        learning_rate=learning_rate,
        starts=starts,
        screen=screen,
        smoothing=smoothing,
        threshold=threshold,
        points=points,
        frames=frame,
        seed=seed,
        resample=resample,
        offset=offset,
        joint=joint,
    )
    chosen = choose_scenario(scenario, scene)
    files = episode_files(episodes)
    # everything is read before anything is fitted: a damaged last file must not cost the first ones' time
    recorded = {path.stem: read_episode(path) for path in files}
    jobs = [("joint", list(recorded))] if settings.joint else [(name, [name]) for name in recorded]
    firsts = {name: _first_start(init, chosen, [recorded[m] for m in members]) for name, members in jobs}
    objectives = {
        name: Objective(
            chosen, [recorded[m] for m in members], frames=settings.frames, points=settings.points, seed=settings.seed
        )
        for name, members in jobs
    }
    space = FitSpace.build(
        settings.parameters,
        bounds={**chosen.bounds, **settings.bounds},
        fixed=settings.fixed,
        offset=settings.offset,
        offset_range=(0.02 / chosen.length_unit_m, 0.1),
    )
    adam = settings.adam(chosen)
    table = Table("episode", "start", "final", "rms mm", *space.names, "iterations", "seconds", "stopped by")
    results: dict[str, Any] = {}
    for name, members in jobs:
        started = replace(adam, init=firsts[name])
        outcome = _run(name, objectives[name], space, started)
        result = describe_fit(objectives[name], space, started, outcome, episodes=members)
        write_fit(out, name, result)
        results[name] = {key: result.summary[key] for key in _SHOWN}
        table.add_row(name, *_row(outcome, chosen, space))
        for failure in outcome.failures:
            errors.print(f"[yellow]{name}:[/] {failure}", soft_wrap=True)
        if outcome.stop_reason == "interrupted":
            show(table, json)
            errors.print(f"Interrupted: the best so far is in {out / name}.json.")
            raise typer.Exit(_INTERRUPTED)
    show(table, json)
    finish({"out": str(out), "fits": results}, json)


_SHOWN = ("loss", "loss_start", "loss_resampled", "iterations", "seconds", "stop_reason", "parameters")


def _run(name: str, objective: Objective, space: FitSpace, adam: AdamSettings) -> FitOutcome:
    errors.print(f"Fitting {name} ...")
    with progress_bar(name, adam.iterations) as update:

        def show_progress(progress: Progress) -> None:
            values = "  ".join(f"{key} {value:.3g}" for key, value in progress.values.items())
            update(progress.iteration, f"loss {progress.loss:.3e}  best {progress.best:.3e}  {values}")

        return fit_adam(objective, space, adam, progress=show_progress)


def _first_start(init: str, scenario: Scenario, episodes: list[Episode]) -> dict[str, float]:
    """Values of the first start by name; episodes of a joint fit give the mean of their predictions."""
    if init == "middle":
        return {}
    if "=" in init:
        return assignments(init.split(","), "--init")
    # imported here: the fits of the pipeline start elsewhere, and must not be stale when a regressor changes
    from pipeline.predict import predicted_start

    found = [predicted_start(init, scenario.name, episode) for episode in episodes]
    return {name: sum(values[name] for values in found) / len(found) for name in found[0]}


def _row(outcome: FitOutcome, scenario: Scenario, space: FitSpace) -> list[str]:
    return [
        f"{outcome.loss_start:.3e}",
        f"{outcome.loss:.3e}",
        f"{1e3 * scenario.length_unit_m * outcome.loss**0.5:.1f}",
        *(f"{outcome.values[name]:.3f}" for name in space.names),
        str(outcome.iterations),
        f"{outcome.seconds:.1f}",
        outcome.stop_reason,
    ]


def _bounds(items: list[str] | None) -> dict[str, tuple[float, float]]:
    bounds: dict[str, tuple[float, float]] = {}
    for item in items or []:
        name, _, text = item.partition("=")
        low, _, high = text.partition(":")
        try:
            bounds[name.strip()] = (float(low), float(high))
        except ValueError as error:
            raise ConfigError(f"--bound takes NAME=LOW:HIGH, got {item!r}.") from error
    return bounds
