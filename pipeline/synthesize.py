"""The stage `synthesize`: make synthetic recordings of every scenario. A person's own recordings lie in raw/."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffcloud.cli.app import stage
from diffcloud.cli.options import JsonFlag, Scheduler, StageParams, Workers
from diffcloud.console import finish, writes


@writes()
def synthesize(
    out: Annotated[Path, typer.Option(help="Folder; episodes go to OUT/<scenario>/<episode>, raw or .npz.")],
    params: StageParams = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    json: JsonFlag = False,
) -> None:
    """Make synthetic recordings of every scenario."""
    from diffcloud.jobs.settings import load_config
    from diffcloud.jobs.synthesize import make_episodes

    finish({"out": str(out), "episodes": make_episodes(load_config(params), out, workers, scheduler)}, json)


if __name__ == "__main__":
    stage(synthesize, "diffcloud.jobs.synthesize")
