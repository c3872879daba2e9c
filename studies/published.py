"""The whole comparison on the published data by one command."""

from __future__ import annotations

import fnmatch
from pathlib import Path
from typing import Annotated, Any

import typer

from diffcloud.cli.options import JsonFlag, Threads, Workers
from diffcloud.console import errors, finish, writes
from diffcloud.errors import ConfigError
from diffcloud.estimation.task import Recording
from diffcloud.io.episodes import Episode, write_episode
from diffcloud.io.files import read_json
from diffcloud.io.imports import release_episodes
from diffcloud.jobs.comparison import compare, comparison_jobs
from diffcloud.jobs.evaluation import write_evaluation
from diffcloud.jobs.fits import FitJob
from diffcloud.jobs.pool import run_all
from diffcloud.jobs.report import write_report
from diffcloud.jobs.scenarios import choose_scenario
from diffcloud.jobs.settings import Config, load_config
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.threads import use_threads
from pipeline.evaluate import AllowMissing, MarkdownFile, stop_if_missing
from studies.acceptance import SCENES

_PROFILE = Path("pipeline/profiles/release.yaml")


@writes()
def published(
    folder: Annotated[Path, typer.Argument(help="The published data: holds lift_real_pcls/, conf/ and so on.")],
    params: Annotated[Path, typer.Option("--params", help="Profile; a file of parameters.")] = _PROFILE,
    data: Annotated[Path, typer.Option(help="Folder for imported episodes and fits.")] = Path("data/release"),
    out: Annotated[Path, typer.Option(help="Folder for metrics, tables, figures and the page.")] = Path("reports/release"),
    markdown: MarkdownFile = None,
    reference: Annotated[
        Path | None, typer.Option(help="JSON with the reference simulator's own fits, scenario -> episode -> loss.")
    ] = None,
    only: Annotated[str, typer.Option(help="Pattern of <scenario>/<episode>, such as 'release_lift/*'.")] = "*",
    workers: Workers = None,
    allow_missing: AllowMissing = False,
    threads: Threads = None,
    json: JsonFlag = False,
) -> None:
    """Import, fit, compare and report every published episode. Ctrl-C keeps what is finished; the same command goes on."""
    use_threads(threads)
    if not (folder / "conf").is_dir():
        raise ConfigError(f"{folder} has no conf/; give the folder with lift_real_pcls/ and conf/.")
    config = load_config(params)
    chosen = [item for item in release_episodes(folder) if fnmatch.fnmatch(f"{item[0]}/{item[1]}", only)]
    config = config.model_copy(update={"scenes": [name for name in SCENES if any(item[0] == name for item in chosen)]})
    if not chosen:
        raise ConfigError(f"No published episode matches {only!r}; patterns are such as 'release_lift/*' or '*/lift_tan'.")
    scenes = {name: folder / "conf" / "rigidcloth" / SCENES[name] for name in config.scenes}
    scenarios = {name: choose_scenario(name, scene) for name, scene in scenes.items()}
    _import(chosen, data / "episodes")
    fitted, failures = _fit(config, chosen, scenarios, data / "fits", workers)
    jobs = [
        job
        for name, scenario in scenarios.items()
        for job in comparison_jobs(
            config,
            name,
            scenario,
            fits=data / "fits",
            episodes=data / "episodes",
            regressors=data / "regressors",
            simulated=data / "simulated",
            kept=out / "episodes",
        )
        if f"{name}/{job.name}" in fitted  # not what is left of an earlier profile
    ]
    comparison = compare(jobs, workers)
    comparison.failures[:0] = failures
    references = {} if reference is None else _references(reference)
    metrics = write_evaluation(
        config,
        comparison,
        fits=data / "fits",
        out=out,
        markdown=markdown,
        command="make comparison RELEASE=DIR",
        as_json=json,
        references=references,
    )
    if comparison.records:
        write_report(
            out / "index.html",
            config,
            params,
            fits=data / "fits",
            episodes=data / "episodes",
            regressors=data / "regressors",
            tables=out / "tables",
        )
    finish({"metrics": metrics, "missing": comparison.missing}, json)
    stop_if_missing(comparison, allow_missing)


def _import(chosen: list[tuple[str, str, Episode]], folder: Path) -> None:
    for name, label, episode in chosen:
        write_episode(folder / name / f"{label}.npz", episode)


def _fit(
    config: Config,
    chosen: list[tuple[str, str, Episode]],
    scenarios: dict[str, Scenario],
    folder: Path,
    workers: int | None,
) -> tuple[set[str], list[str]]:
    """Fit what is not fitted yet: <scenario>/<episode> of the fits, and messages of those that failed."""
    jobs = [
        FitJob(label, [Recording(scenarios[name], label, episode)], config.fit, folder / name)
        for name, label, episode in chosen
    ]
    fitted, failures = set[str](), list[str]()
    for job, _, error in run_all("fit", jobs, workers, patient=True):
        errors.print(f"fitted {job.label}" if error is None else f"{job.label}: {error}")
        if error is None:
            fitted.add(job.label)
        else:
            failures.append(f"{job.label}: {error}")
    return fitted, failures


def _references(path: Path) -> dict[tuple[str, str], float]:
    """(scenario, episode) -> loss of the reference simulator's own fit, averaged over fresh points.

    Raises:
        ConfigError: not such a file.
    """
    told: Any = read_json(path, error=ConfigError)
    try:
        return {
            (f"release_{scenario}", str(episode)): float(entry["loss_best_resampled_mean"])
            for scenario, episodes in told.items()
            for episode, entry in episodes.items()
        }
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            f"{path} must hold scenario -> episode -> loss_best_resampled_mean, a number ({error!r})."
        ) from error
