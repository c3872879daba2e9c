"""`diffcloud network train`: train networks to predict the parameters from clouds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from diffcloud.cli.options import JsonFlag, ParamsFile, Workers, merged, settings_options
from diffcloud.console import errors, finish, known, show, writes
from diffcloud.jobs.network_settings import TrainSettings

_INTERRUPTED = 130


@writes()
@settings_options(TrainSettings, everyday=("models", "profile", "epochs", "seed", "device"), advanced=())
def train(
    data: Annotated[
        Path,
        typer.Option(
            help="Folder written by `diffcloud network generate`. Without --scene: folder of such folders, one per scene."
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for <model>.safetensors, and <model>/ with curves and errors. Without --scene: in <scenario>/."
        ),
    ],
    settings: Mapping[str, Any],
    scene: Annotated[str | None, typer.Option(help="Scene of the simulated set. Default: all of train.scenes.")] = None,
    like: Annotated[
        Path | None,
        typer.Option(help="A preprocessed episode: clouds show the faces that its cameras see, instead of random ones."),
    ] = None,
    loaders: Annotated[
        int,
        typer.Option(
            min=0,
            help="Number of CPU processes that sample clouds. 0: the training process samples them, on the GPU if it "
            "trains there.",
        ),
    ] = 0,
    workers: Workers = None,
    params: ParamsFile = None,
    json: JsonFlag = False,
) -> None:
    """Train networks. After Ctrl-C or a kill, the same command keeps finished networks and resumes at the last saved epoch.

    The section `train` of the file for --params has the other hyper-parameters.
    """
    from rich.table import Table

    from diffcloud.errors import DiffCloudError
    from diffcloud.jobs.settings import load_config
    from diffcloud.jobs.train import train as trained
    from diffcloud.jobs.train import viewpoints
    from diffcloud.settings import updated

    config = merged(load_config(params).train, settings)
    if like is not None:
        config = updated(config, viewpoints=viewpoints(like, config.scenes if scene is None else [scene]))
    table = Table(
        "network",
        "parameter",
        "held-out draws",
        "median relative error",
        "of the mean",
        "mean error of range",
        "of the median",
        "best epoch",
        "seconds",
    )
    results: dict[str, Any] = {}
    failures: list[str] = []
    try:
        for job, told, error in trained(data, out, config, scenario=scene, workers=workers, loaders=loaders):
            if told is None:
                failures.append(f"{job.label}: {error}")
                continue
            name = job.label if scene is None else job.model
            results[name] = told
            for row in _rows(name, told):
                table.add_row(*row)
            if told["resumed_from"]:
                errors.print(f"{job.label}: went on after epoch {told['resumed_from']} of an interrupted run.")
    except KeyboardInterrupt:
        errors.print("Interrupted; the same command keeps finished networks and goes on from the last saved epoch.")
        raise typer.Exit(_INTERRUPTED) from None
    show(table, json)
    if results:
        errors.print(f"Wrote {', '.join(results)} to {out}.")
    finish({"out": str(out), "models": results}, json)
    if failures:
        raise DiffCloudError("\n".join(failures))


def _rows(network: str, told: dict[str, Any]) -> list[list[str]]:
    rows = []
    for name, row in told["held_out"]["parameters"].items():
        keys = (
            "median_relative_error",
            "median_relative_error_of_mean",
            "mean_error_of_range",
            "mean_error_of_range_of_median",
        )
        cells = (f"{100 * row[key]:.1f} %" for key in keys)
        draws, best = str(told["held_out"]["draws"]), str(told["best_epoch"])
        rows.append([network, name, draws, *cells, best, known(told["seconds"], ".0f")])
    return rows
