"""`diffcloud fit`: find the parameters that make the simulator move as the recording does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from diffcloud.errors import ConfigError, DiffCloudError
from diffcloud.fit import FitSpace, Objective, Progress, read_fit, solve, write_fit
from diffcloud.fit.result import describe_fit
from diffcloud.fit.solvers import SearchSettings
from diffcloud.io.episodes import Episode, read_episode
from diffcloud.io.fingerprints import fingerprint
from diffcloud.io.manifests import read_manifest, remove_files, write_manifest
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.threads import use_threads
from pipeline.config import FitConfig, load_config, updated
from pipeline.console import JsonFlag, ParamsFile, Threads, assignments, episode_files, errors, finish, show, writes
from pipeline.scenario_options import ScenarioName, SceneFile, choose_scenario
from pipeline.workers import Tell, check_interrupt, run_all

_INTERRUPTED = 130
_JOINT = "joint"
"""Name of the fit of one parameter set to all episodes."""
_SHOWN = ("loss", "loss_start", "loss_resampled", "iterations", "seconds", "stop_reason", "parameters")
_CODE = ("mesh", "io", "sim", "scene", "clouds", "fit")
"""Packages whose source decides the numbers of a fit."""


@writes()
def fit(
    episodes: Annotated[
        list[Path],
        typer.Argument(
            help="Episode files, or folders of them; without a scenario, a folder with <scenario>/<episode>.npz."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder; one JSON and one NPZ per episode, without a scenario in <scenario>/.")],
    scenario: ScenarioName = None,
    scene: SceneFile = None,
    params: ParamsFile = None,
    parameters: Annotated[str | None, typer.Option(help="Comma-separated, e.g. stretch,mass,bending.")] = None,
    fix: Annotated[list[str] | None, typer.Option(help="PARAMETER=VALUE that is known, e.g. mass=1.2.")] = None,
    bound: Annotated[list[str] | None, typer.Option(help="PARAMETER=LOW:HIGH, repeatable.")] = None,
    solver: Annotated[
        str | None,
        typer.Option(help="gauss_newton (default); adam, the paper's; cma_es or random_search, without derivatives."),
    ] = None,
    iterations: Annotated[int | None, typer.Option(help="Steps at most. Default: 20 of gauss_newton, 50 of adam.")] = None,
    simulations: Annotated[
        int | None, typer.Option(help="Of cma_es and random_search: as many at most. Default: 200.")
    ] = None,
    starts: Annotated[
        int | None, typer.Option(help="Descents from as many places. Default: 3 of gauss_newton, 1 of adam.")
    ] = None,
    screen: Annotated[
        int | None,
        typer.Option(help="Simulate this many candidates and start from the best. Default: 24 of gauss_newton."),
    ] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Of adam. Default: the scenario's.")] = None,
    patience: Annotated[
        int | None,
        typer.Option(help="Of adam: move a further start beside the best after so many iterations in vain; 0: never."),
    ] = None,
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
    seed: Annotated[int | None, typer.Option(help="Of all random numbers.")] = None,
    resample: Annotated[bool | None, typer.Option(help="Of adam: new points in each iteration.")] = None,
    paper: Annotated[
        bool | None,
        typer.Option("--paper", help="The published measure: from cloth to recording only, at the loss frames, no pose."),
    ] = None,
    nuisance: Annotated[
        str | None,
        typer.Option(
            help="What of the recording's pose is found too, each with how far it may be off (a weak prior, no bound), "
            "such as x=2cm,yaw=5deg,lag=50ms. Of x, y, z, tilt_x, tilt_y, yaw, lag; none keeps the scene's pose. "
            "Default: x=0.1m,y=0.1m,yaw=30deg."
        ),
    ] = None,
    joint: Annotated[bool | None, typer.Option("--joint", help="One parameter set for all episodes.")] = None,
    workers: Annotated[int | None, typer.Option(help="Fits at once, each in a process with one thread.")] = None,
    threads: Threads = None,
    json: JsonFlag = False,
) -> None:
    """Fit episodes. Ctrl-C writes the best so far and stops; the same command keeps what is finished and goes on."""
    use_threads(threads)
    config = load_config(params)
    settings = updated(
        config.fit,
        parameters=None if parameters is None else [name.strip() for name in parameters.split(",")],
        fixed=assignments(fix, "--fix") or None,
        bounds=_bounds(bound) or None,
        solver=solver,
        iterations=iterations,
        simulations=simulations,
        learning_rate=learning_rate,
        starts=starts,
        screen=screen,
        patience=patience,
        smoothing=smoothing,
        threshold=threshold,
        points=points,
        frames=frame,
        seed=seed,
        resample=resample,
        paper=paper,
        nuisance=nuisance,
        joint=joint,
        workers=workers,
    )
    every = scenario is None and scene is None and _by_scenario(episodes, config.scenarios)
    if every:
        folders = {name: (choose_scenario(name), episode_files([episodes[0] / name])) for name in config.scenarios}
    else:
        folders = {"": (choose_scenario(scenario, scene), episode_files(episodes))}
    jobs: list[FitJob] = []
    # everything is read before anything is fitted: a damaged last file must not cost the first ones' time
    for folder, (chosen, files) in folders.items():
        recorded = {path.stem: read_episode(path) for path in files}
        groups = {_JOINT: recorded} if settings.joint else {name: {name: episode} for name, episode in recorded.items()}
        for name, members in groups.items():
            job = FitJob(chosen, name, members, settings, out / folder)
            jobs.append(replace(job, init=_first_start(init, job)))
    for job in jobs:
        job.objective()
    space = jobs[0].space
    table = Table("episode", "start", "final", "rms mm", *space.names, "iterations", "seconds", "stopped by")
    results: dict[str, Any] = {}
    failures: list[str] = []

    def told_as(job: FitJob) -> str:
        return job.label if every else job.name

    def add(job: FitJob, summary: Mapping[str, Any]) -> None:
        name = told_as(job)
        results[name] = {key: summary[key] for key in _SHOWN}
        table.add_row(name, *_row(summary, space))
        for failure in summary["failures"]:
            errors.print(f"[yellow]{name}:[/] {escape(failure)}", soft_wrap=True)

    if every:  # stated before, so that what an interrupted call leaves is known too
        write_manifest(out, read_manifest(out) | {path.relative_to(out).as_posix() for job in jobs for path in job.files})
    try:
        for job, summary, error in run_all("fit", jobs, settings.workers, patient=True):
            if error is None:
                errors.print(f"{job.label}: loss {summary['loss_start']:.3e} -> {summary['loss']:.3e}")
                add(job, summary)
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
        _remove_stale(out, jobs)


def _by_scenario(episodes: list[Path], scenarios: list[str]) -> bool:
    """Whether there is one folder, and in it one for each scenario."""
    return len(episodes) == 1 and all((episodes[0] / name).is_dir() for name in scenarios)


def _remove_stale(out: Path, jobs: Sequence[FitJob]) -> None:
    """Remove fits that an earlier call left there and that this one's inputs no longer give: of episodes that are gone, or
    with other settings. Finished single fits stay beside a joint one, and the reverse."""
    kept = {name for job in jobs for name in job.files}
    others = [
        replace(job, name=name, episodes={name: episode})
        for job in jobs
        for name, episode in (job.episodes.items() if job.name == _JOINT else ())
    ]
    folders = {job.folder: [each for each in jobs if each.folder == job.folder] for job in jobs}
    others += [
        replace(members[0], name=_JOINT, episodes={job.name: job.episodes[job.name] for job in members})
        for members in folders.values()
        if members[0].name != _JOINT
    ]
    kept |= {name for job in others if job.known() is not None for name in job.files}
    inside = {path.relative_to(out).as_posix() for path in kept}
    removed = remove_files(out, sorted(read_manifest(out) - inside))
    write_manifest(out, inside)
    if removed:
        told = "Removed fits whose episode is gone or whose settings have changed"
        errors.print(f"{told}: {', '.join(removed)}.", markup=False, soft_wrap=True)


def _readable(path: Path) -> dict[str, Any] | None:
    try:
        return read_fit(path)
    except ConfigError:  # none, or a damaged one
        return None


@dataclass(frozen=True)
class FitJob:
    """One parameter set for one or several episodes. A finished fit of the same inputs by the same code is kept."""

    scenario: Scenario
    name: str
    episodes: Mapping[str, Episode]
    settings: FitConfig
    folder: Path
    init: Mapping[str, float] = field(default_factory=dict)
    """Values of the first start; the middle of the range where not given."""

    @property
    def label(self) -> str:
        return f"{self.scenario.name}/{self.name}"

    @property
    def files(self) -> tuple[Path, Path]:
        """What `run` writes."""
        return self.folder / f"{self.name}.json", self.folder / f"{self.name}.npz"

    @property
    def space(self) -> FitSpace:
        """
        Raises:
            ConfigError: bounds or fixed values that do not fit the parameters.
        """
        settings, scenario = self.settings, self.scenario
        scenario.check_parameters([*settings.parameters, *settings.fixed])
        return FitSpace.build(
            settings.parameters,
            bounds={**scenario.bounds, **settings.bounds},
            fixed=settings.fixed,
        )

    def objective(self) -> Objective:
        """
        Raises:
            ConfigError, EpisodeError: the episodes lack the frames of the loss, or an unknown frame.
        """
        return Objective(self.scenario, list(self.episodes.values()), **self.settings.measure())

    def known(self) -> dict[str, Any] | None:
        """The summary that this job, or an earlier one of the same inputs and code, has left; maybe interrupted."""
        summary = _readable(self.files[0])
        same = summary is not None and summary.get("fingerprint") == self._fingerprint and self.files[1].is_file()
        return summary if same else None

    def run(self, tell: Tell) -> dict[str, Any]:
        """Fit, write, and return the summary.

        Raises:
            DivergedError: every start diverged.
            KeyboardInterrupt: Ctrl-C; the best so far is written.
        """
        known = self.known()
        if known is not None and known["stop_reason"] != "interrupted":
            return known

        def show_progress(progress: Progress) -> None:
            check_interrupt()
            values = "  ".join(f"{key} {value:.3g}" for key, value in progress.values.items())
            if isinstance(settings, SearchSettings):
                done, most = progress.simulations or 0, settings.simulations
            else:
                done, most = progress.iteration, settings.iterations
            tell(done / max(most, 1), f"{done} of at most {most}  best {progress.best:.3e}  {values}")

        objective, space = self.objective(), self.space
        settings = replace(self.settings.solver_settings(self.scenario), init=self.init)
        outcome = solve(objective, space, settings, progress=show_progress)
        result = describe_fit(objective, space, settings, outcome, episodes=list(self.episodes))
        result.summary["fingerprint"] = self._fingerprint
        write_fit(self.folder, self.name, result)
        if outcome.stop_reason == "interrupted":
            raise KeyboardInterrupt
        return result.summary

    @cached_property
    def _fingerprint(self) -> str:
        settings = self.settings.model_dump(exclude={"workers", "joint"})  # which the name and the episodes tell
        return fingerprint([self.scenario, self.name, self.episodes, settings, self.init], packages=_CODE)


def _first_start(init: str, job: FitJob) -> dict[str, float]:
    """Values of the first start by name; episodes of a joint fit give the mean of their predictions.

    Raises:
        ConfigError: a value of what is not fitted, or outside of its bounds.
    """
    if init == "middle":
        return {}
    if "=" in init:
        stated = assignments(init.split(","), "--init")
        job.space.check_start(stated)
        return stated
    # imported here: the fits of the pipeline start elsewhere, and must not be stale when a regressor changes
    from pipeline.predict import predicted_start

    found = [predicted_start(init, job.scenario.name, episode) for episode in job.episodes.values()]
    return job.space.nearest({name: sum(values[name] for values in found) / len(found) for name in found[0]})


def _row(summary: Mapping[str, Any], space: FitSpace) -> list[str]:
    return [
        f"{summary['loss_start']:.3e}",
        f"{summary['loss']:.3e}",
        f"{summary['rms_mm']:.1f}",
        *(f"{summary['parameters'][name]['value']:.3f}" for name in space.names),
        str(summary["iterations"]),
        f"{summary['seconds']:.1f}",
        summary["stop_reason"],
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
