"""`diffcloud data preprocess`: raw episodes to clouds, and clouds to clean ones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffcloud.cli.options import JsonFlag, ParamsFile, Workers
from diffcloud.console import finish, writes


@writes()
def preprocess(
    recorded: Annotated[
        list[Path],
        typer.Argument(
            help="Raw episodes, or folders of recordings: raw <episode>/, and raw or .npz episodes in <scenario>/ or "
            "episodes/<scenario>/."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the cleaned episodes: <scenario>/<episode>.npz.")],
    calibration: Annotated[Path | None, typer.Option(help="Calibration file for the cameras of raw episodes.")] = None,
    mask: Annotated[bool, typer.Option(help="Take the robot out of raw episodes.")] = True,
    urdf: Annotated[Path | None, typer.Option(help="The robot of raw episodes; without it, as params say.")] = None,
    workers: Workers = None,
    params: ParamsFile = None,
    json: JsonFlag = False,
) -> None:
    """Clean recordings: depth to points, robot and table out, views merged and thinned.

    Finished episodes are kept until the recording, a setting or the code changes. Of a folder, clouds whose recording is
    gone are removed.
    """
    from diffcloud.errors import EpisodeError
    from diffcloud.jobs.preprocess import preprocess as clean
    from diffcloud.jobs.settings import load_config
    from diffcloud.settings import updated

    config = load_config(params)
    raw = updated(config.preprocess.raw, robot=None if urdf is None else str(urdf))
    if not mask:
        raw = raw.model_copy(update={"robot": None})
    settings = config.preprocess.model_copy(update={"raw": raw})
    points, warnings, failures = clean(recorded, out, config, settings, calibration=calibration, workers=workers)
    finish({"out": str(out), "points": points, "warnings": warnings}, json)
    if failures:
        raise EpisodeError("\n".join(failures))
