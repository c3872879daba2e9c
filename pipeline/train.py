"""`diffcloud train`: teach a network to tell the parameters from clouds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from rich.table import Table

from diffcloud.errors import ConfigError
from diffcloud.io.files import write_json
from diffcloud.regressors import MODEL_NAMES, PROFILE_NAMES, ModelName, SimulatedSet, TrainingSettings, profile_settings
from pipeline.config import load_config, updated
from pipeline.console import JsonFlag, ParamsFile, errors, finish, progress_bar, show

if TYPE_CHECKING:
    from diffcloud.regressors.training import TrainingProgress

_INTERRUPTED = 130


def train(
    scenario: Annotated[str, typer.Option(help="Name of the scenario that was simulated.")],
    model: Annotated[str, typer.Option(help=", ".join(MODEL_NAMES))],
    data: Annotated[Path, typer.Option(help="Folder written by `diffcloud simulate`.")],
    out: Annotated[Path, typer.Option(help="Checkpoint; curves and errors go to a folder of its name without suffix.")],
    params: ParamsFile = None,
    profile: Annotated[str | None, typer.Option(help=", ".join(PROFILE_NAMES))] = None,
    epochs: Annotated[int | None, typer.Option(help="Passes over the training draws.")] = None,
    draws: Annotated[int | None, typer.Option(help="Training draws used; default: all.")] = None,
    points: Annotated[int | None, typer.Option(help="Sampled per frame.")] = None,
    batch_size: Annotated[int | None, typer.Option(help="Draws per update.")] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Of Adam.")] = None,
    loss: Annotated[str | None, typer.Option(help="normalised: L1 of fractions of the bounds; raw: in own units.")] = None,
    target: Annotated[str | None, typer.Option(help="linear, or logarithmic: errors count by their ratio.")] = None,
    augment: Annotated[bool | None, typer.Option(help="Hide parts of the clouds and add noise.")] = None,
    subtract_background: Annotated[bool | None, typer.Option(help="Leave the known obstacle out of the clouds.")] = None,
    heteroscedastic: Annotated[
        bool | None, typer.Option("--heteroscedastic", help="Learn a width of each prediction along.")
    ] = None,
    patience: Annotated[int | None, typer.Option(help="Stop after so many epochs without a better validation.")] = None,
    seed: Annotated[int | None, typer.Option(help="Of all random numbers.")] = None,
    device: Annotated[str | None, typer.Option(help="auto, cpu or gpu (mixed precision).")] = None,
    workers: Annotated[int | None, typer.Option(help="Processes that sample clouds.")] = None,
    json: JsonFlag = False,
) -> None:
    """Train one regressor. After Ctrl-C or a kill the same command goes on from the last saved epoch."""
    config = updated(
        load_config(params).train,
        profile=profile,
        epochs=epochs,
        draws=draws,
        points=points,
        batch_size=batch_size,
        learning_rate=learning_rate,
        loss=loss,
        target=target,
        augment=augment,
        subtract_background=subtract_background,
        heteroscedastic=heteroscedastic,
        patience=patience,
        seed=seed,
        device=device,
        workers=workers,
    )
    settings = profile_settings(config.profile, model, **config.changes())
    train_set, test_set = SimulatedSet.read(data, "train"), SimulatedSet.read(data, "test")
    if train_set.scenario != scenario:
        raise ConfigError(f"{data} holds draws of {train_set.scenario}, not of {scenario}.")
    # Lightning takes seconds to import, and nothing else needs it
    from diffcloud.regressors.training import train_regressor

    errors.print(f"Training {model} for {scenario}: {_described(settings, train_set)} ...")
    with progress_bar(model, settings.epochs) as update:

        def show_progress(progress: TrainingProgress) -> None:
            update(
                progress.epoch,
                f"train {progress.train_loss:.4f}  validation {progress.validation_loss:.4f}  best {progress.best:.4f}",
            )

        try:
            result = train_regressor(
                cast(ModelName, model),
                train_set,
                test_set,
                settings,
                out,
                device=config.device,
                workers=config.workers,
                progress=show_progress,
            )
        except KeyboardInterrupt:
            errors.print("Interrupted; the same command goes on from the last saved epoch.")
            raise typer.Exit(_INTERRUPTED) from None
    # beside the outputs, which have the same bytes for the same seed
    write_json(out.with_suffix(".timings.json"), {"seconds": result.seconds, "resumed": result.resumed_from})
    held_out = result.summary["held_out"]
    show(_table(held_out), json)
    if result.resumed_from:
        errors.print(f"Went on after epoch {result.resumed_from} of an interrupted run.")
    errors.print(f"Wrote {out} and {out.with_suffix('')} after {result.seconds:.1f} s.")
    finish(
        {
            "out": str(out),
            "epochs": len(result.summary["history"]),
            "best_epoch": result.summary["best_epoch"],
            "history": result.summary["history"],
            "held_out": held_out,
            "resumed_from": result.resumed_from,
            "seconds": result.seconds,
        },
        json,
    )


def _described(settings: TrainingSettings, simulated: SimulatedSet) -> str:
    draws = min(settings.draws or len(simulated), len(simulated))
    return f"{draws} draws, {settings.epochs} epochs, {settings.points} points a frame"


def _table(held_out: dict[str, Any]) -> Table:
    table = Table(
        f"{held_out['draws']} held-out draws",
        "median relative error",
        "of the mean",
        "mean error of range",
        "of the median",
    )
    for name, row in held_out["parameters"].items():
        keys = (
            "median_relative_error",
            "median_relative_error_of_mean",
            "mean_error_of_range",
            "mean_error_of_range_of_median",
        )
        table.add_row(name, *(f"{100 * row[key]:.1f} %" for key in keys))
    return table
