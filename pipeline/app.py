"""The `diffcloud` command."""

from __future__ import annotations

import os
import sys

import torch
import typer

from diffcloud.errors import DiffCloudError
from pipeline import acceptance, bench, evaluate, fit, importing, raw_episode, report, rollout
from pipeline.calibrate import calibrate
from pipeline.capture import record
from pipeline.console import errors
from pipeline.doctor import doctor
from pipeline.episodes import episodes
from pipeline.evaluate_release import release
from pipeline.gradients import gradients
from pipeline.memory import keep_freed_memory
from pipeline.predict import predict
from pipeline.preprocess import preprocess
from pipeline.recordings import recordings
from pipeline.simulate import simulate
from pipeline.train import train
from pipeline.visibility import visibility

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Find the simulator parameters of a real cloth from the point clouds of its motion.",
)
app.add_typer(importing.app, name="import")
app.add_typer(evaluate.app, name="evaluate")
evaluate.app.command("release")(release)
app.add_typer(raw_episode.app, name="episode")
app.command()(episodes)
app.command()(preprocess)
app.command()(simulate)
app.command()(fit.fit)
app.command()(train)
app.command()(predict)
app.command()(report.report)
app.command()(rollout.rollout)
app.command()(visibility)
app.command()(gradients)
app.command()(bench.bench)
app.command("capture")(record)
app.command()(calibrate)
app.command()(doctor)
app.command()(acceptance.acceptance)
app.command()(recordings)


def main() -> None:
    """Run, and turn the project's own errors into a message and exit status 1."""
    # A step is a chain of small operations: a second thread gains nothing (measured), and beside another busy process its
    # spinning costs tenfold. OMP_NUM_THREADS overrides.
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(1)
    keep_freed_memory()
    try:
        app()
    except DiffCloudError as error:
        errors.print(f"[bold red]Error:[/] {str(error).replace('[', chr(92) + '[')}", soft_wrap=True)
        sys.exit(1)
    except KeyboardInterrupt:
        errors.print("Interrupted.")
        sys.exit(130)


if __name__ == "__main__":
    main()
