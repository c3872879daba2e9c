"""`diffcloud fit`: find the parameters that make the simulator move as the recording does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from diffcloud.cli.config import Config, load_config
from diffcloud.cli.console import (
    JsonFlag,
    ParamsFile,
    Threads,
    Workers,
    assignments,
    episode_files,
    errors,
    finish,
    known,
    refuse_many,
    say,
    show,
    told_progress,
    warn,
    writes,
)
from diffcloud.cli.ctrl_c import none_lost
from diffcloud.cli.fit_jobs import JOINT, FitJob, first_start, read_recordings, remove_stale, stated_recordings
from diffcloud.cli.scenario_options import ScenarioName, SceneFile, choose_scenario
from diffcloud.cli.workers import run_all
from diffcloud.errors import ConfigError, DiffCloudError
from diffcloud.estimation import FitRecord, FitSpace
from diffcloud.estimation.task import Recording
from diffcloud.io.episodes import read_episode
from diffcloud.io.files import files_in, folders_in
from diffcloud.io.manifests import read_manifest, write_manifest
from diffcloud.settings import updated
from diffcloud.sim.threads import use_threads

_MOST_JOINT = 100
"""Recordings of a joint fit, each of whose steps simulates all of them."""
_INTERRUPTED = 130
_SHOWN = {
    "loss",
    "loss_start",
    "loss_resampled",
    "rms_mm",
    "iterations",
    "simulations",
    "seconds",
    "stop_reason",
    "parameters",
    "nuisance",
    "solver",
}


@writes()
def fit(
    episodes: Annotated[
        list[Path],
        typer.Argument(
            help="Episode files, or folders of them; without --scenario, a folder with <scenario>/<episode>.npz, "
            "SCENARIO=EPISODE for each (or SCENARIO=FOLDER), or a YAML file that lists episodes or folders by scenario."
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            help="Folder; one JSON and one NPZ per fit: <episode>, joint, or without --scenario <scenario>/<episode>."
        ),
    ],
    scenario: ScenarioName = None,
    scene: SceneFile = None,
    params: ParamsFile = None,
    parameters: Annotated[str | None, typer.Option(help="Comma-separated, e.g. stretch,mass,bending.")] = None,
    fix: Annotated[list[str] | None, typer.Option(help="PARAMETER=VALUE that is known, e.g. mass=1.2.")] = None,
    bound: Annotated[list[str] | None, typer.Option(help="PARAMETER=LOW:HIGH, repeatable.")] = None,
    solver: Annotated[
        str | None,
        typer.Option(
            help="likelihood (default), with intervals; adam, the paper's; cma_es or random_search, without derivatives."
        ),
    ] = None,
    iterations: Annotated[int | None, typer.Option(help="Steps at most. Default: 12 of likelihood, 50 of adam.")] = None,
    simulations: Annotated[
        int | None, typer.Option(help="Of cma_es and random_search: as many at most. Default: 200.")
    ] = None,
    starts: Annotated[int | None, typer.Option(help="Places to descend from. Default: 3 of likelihood, 1 of adam.")] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Of adam. Default: the scenario's.")] = None,
    init: Annotated[
        str,
        typer.Option(
            help="First start: middle, PARAMETER=VALUE,..., or a regressor's prediction: mlp, ... or its checkpoint."
        ),
    ] = "middle",
    smoothing: Annotated[
        float | None, typer.Option(help="Of adam: perturbation whose gradients are averaged; 0: none.")
    ] = None,
    threshold: Annotated[
        float | None, typer.Option(help="Stop below this loss; default: never, with --paper the scenario's.")
    ] = None,
    points: Annotated[int | None, typer.Option(help="Sampled per frame.")] = None,
    frame: Annotated[list[int] | None, typer.Option(help="Frame to compare, repeatable; default: all usable ones.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of all random numbers.")] = None,
    resample: Annotated[bool | None, typer.Option(help="Of adam: new points in each iteration.")] = None,
    paper: Annotated[
        bool | None,
        typer.Option(
            "--paper",
            help="The published measure: from cloth to recording only, at the loss frames, no pose; by adam unless "
            "--solver names another.",
        ),
    ] = None,
    nuisance: Annotated[
        str | None,
        typer.Option(
            help="What of the recording's pose is found too, each with how far it may be off (a weak prior, no bound), "
            "such as x=2cm,yaw=5deg,lag=50ms. Of x, y, z, tilt_x, tilt_y, yaw, lag, scale; none keeps the scene's pose. "
            "Default: x and y 0.1m, yaw 30deg, z 2mm, tilt_x and tilt_y 0.29deg, lag 2ms or what preprocess says; "
            "scale (of the cameras' depths, such as 2%) where the episode says how far it may be off."
        ),
    ] = None,
    laid: Annotated[
        str | None,
        typer.Option(
            help="Also find how the cloth lay before the motion, and how far off that may be: turn=5deg (askew under the "
            "gripper), shape=5mm (not flat; of each of nine waves), size=2% (larger or smaller than stated), track=2% (the "
            "gripper's path longer or shorter than recorded). Only if the cloth starts level. Replaces the default, which "
            "is what the scenario says (turn=10deg for a cloth on a table, and shape=1cm too in the recorded_ ones; none "
            "for bands and vests, other solvers and --paper)."
        ),
    ] = None,
    doubts: Annotated[
        str | None,
        typer.Option(
            help="Fit roughly known material too, unreported: bending=1.5x,drag=1.3x (the rest is exact), or none. Default "
            "of likelihood with the implicit integrator: 1.5x of bending and damping, 1.3x of drag and frictions, 3x of "
            "compression, unless the scenario's doubts say otherwise."
        ),
    ] = None,
    prior: Annotated[
        str | None,
        typer.Option(
            help="The factor of the basis material within which each multiplier probably lies, such as "
            "bending=3x,mass=2x; none for no prior. Default: 10x, which decides only what the recording does not show."
        ),
    ] = None,
    joint: Annotated[
        bool | None, typer.Option("--joint", help="One parameter set for all episodes, of any scenario: one cloth.")
    ] = None,
    workers: Workers = None,
    threads: Threads = None,
    json: JsonFlag = False,
) -> None:
    """Fit episodes. Ctrl-C writes the best so far and stops; the same command keeps what is finished and goes on."""
    use_threads(threads)
    config = load_config(params)
    if paper and solver is None and config.fit.solver == "likelihood":  # which that measure has not
        solver = "adam"
    settings = updated(
        config.fit,
        parameters=None if parameters is None else [name.strip() for name in parameters.split(",")],
        fixed=config.fit.fixed | assignments(fix, "--fix"),
        bounds=config.fit.bounds | _bounds(bound),
        solver=solver,
        iterations=iterations,
        simulations=simulations,
        learning_rate=learning_rate,
        starts=starts,
        smoothing=smoothing,
        threshold=threshold,
        points=points,
        frames=frame,
        seed=seed,
        resample=resample,
        paper=paper,
        nuisance=nuisance,
        laid=laid,
        prior=prior,
        doubts=doubts,
        joint=joint,
    )
    every, recordings = _recordings(episodes, scenario, scene, config)
    if settings.joint:
        refuse_many(recordings, _MOST_JOINT, "A joint fit takes", "Choose a part of them, or leave out --joint")
    groups: dict[tuple[Path, str], list[Recording]] = {}
    for folder, recording in recordings:
        key = (out, JOINT) if settings.joint else (out / folder, recording.name)
        groups.setdefault(key, []).append(recording)
    jobs = [FitJob(name, members, settings, folder) for (folder, name), members in groups.items()]
    jobs = [replace(job, init=first_start(init, job)) for job in jobs]
    # everything is read before anything is fitted: a damaged last file must not cost the first ones' time
    for job in told_progress("checking", jobs):
        job.task.objective()
    space = jobs[0].task.space.asked
    table = Table("episode", "start", "final", "rms mm", *space.names, "iterations", "seconds", "stopped by")
    results: dict[str, Any] = {}
    failures: list[str] = []

    def told_as(job: FitJob) -> str:
        return job.label if every and job.name != JOINT else job.name

    def add(job: FitJob, record: FitRecord) -> None:
        name = told_as(job)
        plain = record.plain() | {"seconds": record.seconds}
        results[name] = {key: value for key, value in plain.items() if key in _SHOWN}
        table.add_row(name, *_row(record, space))
        for recording in record.episodes if job.name == JOINT else ():
            left = recording.left_out
            told = "" if left is None else f", {left.rms_mm:.1f} with the parameters of the others"
            errors.print(f"{recording.scenario}/{recording.name}: RMS {recording.rms_mm:.1f} mm{told}")
        for failure in record.failures:
            say(f"{name}:", failure, style="yellow")

    if every:  # stated before, so that what an interrupted call leaves is known too
        write_manifest(out, read_manifest(out) | {path.relative_to(out).as_posix() for job in jobs for path in job.files})
    try:
        with none_lost():
            for job, record, error in run_all("fit", jobs, workers, patient=True):
                if error is None:
                    errors.print(f"{job.label}: loss {record.loss_start:.3e} -> {record.loss:.3e}")
                    add(job, record)
                else:
                    failures.append(f"{told_as(job)}: {error}")
    except KeyboardInterrupt:
        for job in jobs:
            if told_as(job) not in results and (best := job.known()) is not None:
                add(job, best)
        show(table, json)
        errors.print(f"Interrupted: {out} has the best so far of each. The same command keeps finished fits and goes on.")
        raise typer.Exit(_INTERRUPTED) from None
    show(table, json)
    finish({"out": str(out), "fits": results}, json)
    if failures:
        raise DiffCloudError("\n".join(failures))
    if every:
        remove_stale(out, jobs)


def _by_scenario(episodes: list[Path], scenarios: list[str]) -> list[str]:
    """Those scenarios that have episodes in the only folder that is given; none if there is another argument."""
    if len(episodes) != 1:
        return []
    there = [name for name in scenarios if files_in(episodes[0] / name, ".npz")]
    if there and (missing := [name for name in scenarios if name not in there]):
        errors.print(f"{episodes[0]} has no episodes of {', '.join(missing)}.", soft_wrap=True)
    more = [folder.name for folder in folders_in(episodes[0]) if folder.name not in scenarios and files_in(folder, ".npz")]
    if there and more:
        warn(f"{episodes[0]} also has episodes of {', '.join(more)}. They are not fitted: list them under `scenarios`.")
    return there


def _recordings(
    arguments: list[Path], scenario: str | None, scene: Path | None, config: Config
) -> tuple[bool, list[tuple[str, Recording]]]:
    """Whether the arguments stand for a folder of all scenarios, and each recording with the folder of its fit.

    Raises:
        ConfigError, EpisodeError: what is stated cannot be read.
    """
    stated = stated_recordings(arguments)
    if stated is not None:
        if scenario is not None or scene is not None:
            raise ConfigError("Each episode names its scenario; leave out --scenario and --scene.")
        return False, [(one.scenario.name, one) for one in read_recordings(stated)]
    if scenario is None and scene is None and (there := _by_scenario(arguments, config.scenarios)):
        tree = [(name, path) for name in there for path in episode_files([arguments[0] / name])]
        found = read_recordings(tree)
        return True, [(name, one) for (name, _), one in zip(tree, found, strict=True)]
    chosen = choose_scenario(scenario, scene)
    files = told_progress("reading", episode_files(arguments))
    return False, [("", Recording(chosen, path.stem, read_episode(path))) for path in files]


def _row(record: FitRecord, space: FitSpace) -> list[str]:
    return [
        f"{record.loss_start:.3e}",
        f"{record.loss:.3e}",
        f"{record.rms_mm:.1f}",
        *(f"{record.parameters[name].value:.3f}" for name in space.names),
        str(record.iterations),
        known(record.seconds, ".1f"),
        record.stop_reason,
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
