"""`diffcloud report`: one self-contained page about all fits."""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import torch
import typer

import diffcloud
from diffcloud.errors import ConfigError
from diffcloud.fit import read_fit
from diffcloud.io.episodes import read_episode
from diffcloud.io.files import write_text
from diffcloud.mesh import SurfaceMesh
from diffcloud.report import EpisodeEntry, TrainingEntry, build_page
from pipeline.config import load_config
from pipeline.console import JsonFlag, ParamsFile, errors, finish


def report(
    out: Annotated[Path, typer.Option(help="HTML file.")] = Path("reports/index.html"),
    fits: Annotated[Path, typer.Option(help="Folder with <scenario>/<episode>.json and .npz.")] = Path("data/fits"),
    episodes: Annotated[Path, typer.Option(help="Folder with <scenario>/<episode>.npz.")] = Path("data/episodes"),
    regressors: Annotated[Path, typer.Option(help="Folder with <scenario>/<model>/training.json; may lack any.")] = Path(
        "data/regressors"
    ),
    tables: Annotated[Path, typer.Option(help="Folder written by `diffcloud evaluate`.")] = Path("reports/tables"),
    params: ParamsFile = None,
    json: JsonFlag = False,
) -> None:
    """Write the report page."""
    config = load_config(params)
    table = tables / "fits.csv"
    if not table.is_file():
        raise ConfigError(f"No such table: {table}; run `diffcloud evaluate` first.")
    entries = []
    for known in _rows(table):
        scenario, name = str(known["scenario"]), str(known["episode"])
        fit = read_fit(fits / scenario / f"{name}.json")
        known.setdefault("rms_other_frames_mm", float("nan"))
        source = fit["episodes"][0]
        with np.load(fits / scenario / f"{name}.npz", allow_pickle=False) as run:
            entries.append(
                EpisodeEntry(
                    scenario=scenario,
                    name=name,
                    row=known,
                    fit=fit,
                    episode=read_episode(episodes / scenario / f"{source}.npz"),
                    nodes=run["nodes"],
                    start_nodes=run["start_nodes"],
                    faces=run["faces"],
                    times=run["times"],
                    bodies=SurfaceMesh(run["obstacle_nodes"], run["obstacle_faces"]),
                    pictures=_pictures(episodes / scenario, source),
                )
            )
    trainings = [
        TrainingEntry.read(path)
        for name in config.scenarios
        for path in sorted((regressors / name).glob("*/training.json"))
    ]
    environment = {
        "commands": "diffcloud episodes, preprocess, simulate, fit, train, evaluate, report (dvc.yaml)",
        "parameters": "params.yaml" if params is None else str(params),
        "seed of the fits": str(config.fit.seed),
        "diffcloud": diffcloud.__version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
    }
    page = build_page(
        entries,
        title=config.report.title,
        overlay_points=config.report.overlay_points,
        environment=environment,
        predictions=_rows(tables / "predictions.csv"),
        trainings=trainings,
    )
    write_text(out, page)
    errors.print(f"Wrote {out} ({len(page) / 1e6:.1f} MB).")
    finish({"out": str(out), "episodes": len(entries), "bytes": len(page.encode())}, json)


def _pictures(folder: Path, name: str) -> dict[str, bytes]:
    """Of a raw episode, as `diffcloud preprocess` left them; none of other episodes."""
    kinds = {"mask": "masked (red) and kept as cloth (green)", "cloud": "merged cloud from above, along y and along x"}
    files = {caption: folder / f"{name}.{kind}.png" for kind, caption in kinds.items()}
    return {caption: path.read_bytes() for caption, path in files.items() if path.is_file()}


def _rows(table: Path) -> list[dict[str, Any]]:
    """Rows of a table as column -> value, without what is not known; none if there is no such table."""
    if not table.is_file():
        return []
    return [
        {str(key): value for key, value in row.items() if not (isinstance(value, float) and np.isnan(value))}
        for row in pd.read_csv(table).to_dict("records")
    ]
