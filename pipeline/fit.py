"""The stage `fit`: fit every episode of every scenario."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from diffcloud.cli.app import stage
from diffcloud.cli.options import JsonFlag, Scheduler, StageParams, Workers
from diffcloud.console import errors, finish, known, say, show, writes

if TYPE_CHECKING:
    from diffcloud.estimation.record import FitRecord

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
    episodes: Annotated[Path, typer.Argument(help="Folder of <scenario>/<episode>.npz.")],
    out: Annotated[Path, typer.Option(help="Folder; <scenario>/<episode>.json and .npz, or joint.json and joint.npz.")],
    params: StageParams = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    json: JsonFlag = False,
) -> None:
    """Fit every episode. Ctrl-C writes the best so far; the same command keeps what is finished and goes on."""
    from rich.table import Table

    from diffcloud.errors import DiffCloudError
    from diffcloud.jobs.fits import fit_all
    from diffcloud.jobs.settings import load_config

    config = load_config(params)
    names = config.fit.parameters
    table = Table("episode", "start", "final", "rms mm", *names, "steps", "seconds", "stopped by")
    results: dict[str, Any] = {}
    failures: list[str] = []
    try:
        for job, record, error in fit_all(episodes, out, config.scenes, config.fit, workers, scheduler):
            if record is None:
                failures.append(f"{job.label}: {error}")
                continue
            plain = record.plain() | {"seconds": record.seconds}
            results[job.label] = {key: value for key, value in plain.items() if key in _SHOWN}
            table.add_row(job.label, *_row(record, names))
            errors.print(f"{job.label}: loss {record.loss_start:.3e} -> {record.loss:.3e}")
            for line in record.failures:
                say(f"{job.label}:", line, style="yellow")
    except KeyboardInterrupt:
        show(table, json)
        errors.print(f"Interrupted: {out} has the best so far of each. The same command keeps finished fits and goes on.")
        raise typer.Exit(_INTERRUPTED) from None
    show(table, json)
    finish({"out": str(out), "fits": results}, json)
    if failures:
        raise DiffCloudError("\n".join(failures))


def _row(record: FitRecord, names: list[str]) -> list[str]:
    return [
        f"{record.loss_start:.3e}",
        f"{record.loss:.3e}",
        f"{record.rms_mm:.1f}",
        *(f"{record.parameters[name].value:.3f}" for name in names),
        str(record.iterations),
        known(record.seconds, ".1f"),
        record.stop_reason,
    ]


if __name__ == "__main__":
    stage(fit, "diffcloud.jobs.fits")
