"""The stage `report`: one self-contained page about all fits."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffcloud.cli.app import stage
from diffcloud.cli.options import JsonFlag, StageParams
from diffcloud.console import errors, finish, writes


@writes(".html")
def report(
    out: Annotated[Path, typer.Option(help="HTML file.")] = Path("reports/index.html"),
    fits: Annotated[Path, typer.Option(help="Folder with <scenario>/<episode>.json and .npz.")] = Path("data/fits"),
    episodes: Annotated[Path, typer.Option(help="Folder with <scenario>/<episode>.npz.")] = Path("data/episodes"),
    regressors: Annotated[Path, typer.Option(help="Folder with <scenario>/<model>/training.json; may lack any.")] = Path(
        "data/regressors"
    ),
    tables: Annotated[Path, typer.Option(help="Folder written by the stage `evaluate`.")] = Path("reports/tables"),
    params: StageParams = None,
    json: JsonFlag = False,
) -> None:
    """Write the report page."""
    from diffcloud.jobs.report import write_report
    from diffcloud.jobs.settings import load_config

    told = write_report(
        out, load_config(params), params, fits=fits, episodes=episodes, regressors=regressors, tables=tables
    )
    errors.print(f"Wrote {out} ({told[1] / 1e6:.1f} MB).")
    finish({"out": str(out), "episodes": told[0], "bytes": told[1]}, json)


if __name__ == "__main__":
    stage(report)
