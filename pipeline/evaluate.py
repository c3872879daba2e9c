"""The stage `evaluate`: compare all methods on all episodes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from diffcloud.cli.app import stage
from diffcloud.cli.options import JsonFlag, Scheduler, StageParams, Workers
from diffcloud.console import errors, finish, say

if TYPE_CHECKING:
    from diffcloud.jobs.comparison import Comparison

AllowMissing = Annotated[
    bool, typer.Option("--allow-missing", help="Exit with status 0 although a method or an episode is missing.")
]
MarkdownFile = Annotated[Path | None, typer.Option("--markdown", help="Write the tables to this Markdown file too.")]


def evaluate(
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
    params: StageParams = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    json: JsonFlag = False,
) -> None:
    """Compare all methods on all episodes: metrics.json, tables, and wall times. Ctrl-C keeps finished episodes."""
    from diffcloud.jobs.evaluation import evaluate as compared
    from diffcloud.jobs.settings import load_config

    metrics, comparison = compared(
        load_config(params),
        fits=fits,
        episodes=episodes,
        regressors=regressors,
        simulated=simulated,
        out=out,
        markdown=markdown,
        workers=workers,
        scheduler=scheduler,
        as_json=json,
    )
    finish({"metrics": metrics, "missing": comparison.missing}, json)
    stop_if_missing(comparison, allow_missing)


def stop_if_missing(comparison: Comparison, allow_missing: bool) -> None:
    """Name what is missing; then exit status 1, unless that is allowed."""
    for line in comparison.missing:
        say("Missing:", line, style="yellow")
    if comparison.missing and not allow_missing:
        errors.print("The tables have labelled gaps; --allow-missing accepts them.")
        raise typer.Exit(1)


if __name__ == "__main__":
    stage(evaluate, "diffcloud.jobs.evaluation")
