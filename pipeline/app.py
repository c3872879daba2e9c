"""The `diffcloud` command."""

from __future__ import annotations

import os
import sys

import typer

from diffcloud.errors import DiffCloudError
from pipeline.console import errors
from pipeline.lazy import lazy_group
from pipeline.memory import keep_freed_memory

COMMANDS = {
    "import": "pipeline.importing:app",
    "evaluate": "pipeline.evaluate_release:app",
    "episode": "pipeline.raw_episode:app",
    "episodes": "pipeline.episodes:episodes",
    "preprocess": "pipeline.preprocess:preprocess",
    "simulate": "pipeline.simulate:simulate",
    "fit": "pipeline.fit:fit",
    "train": "pipeline.train:train",
    "predict": "pipeline.predict:predict",
    "report": "pipeline.report:report",
    "identify": "pipeline.identify:identify",
    "rollout": "pipeline.rollout:rollout",
    "visibility": "pipeline.visibility:visibility",
    "gradients": "pipeline.gradients:gradients",
    "materials": "pipeline.materials:materials",
    "discretisation": "pipeline.discretisation:discretisation",
    "simulators": "pipeline.simulators:simulators",
    "bench": "pipeline.bench:bench",
    "capture": "pipeline.capture:record",
    "calibrate": "pipeline.calibrate:calibrate",
    "doctor": "pipeline.doctor:doctor",
    "acceptance": "pipeline.acceptance:acceptance",
    "recordings": "pipeline.recordings:recordings",
    "coverage": "pipeline.coverage:coverage",
}
"""Name -> where it lies; it is imported when it is run."""

app = typer.Typer(
    cls=lazy_group(COMMANDS),
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Find the simulator parameters of a real cloth from the point clouds of its motion.",
)


@app.callback()
def diffcloud() -> None:
    """Find the simulator parameters of a real cloth from the point clouds of its motion."""


def main() -> None:
    """Run, and turn the project's own errors into a message and exit status 1."""
    # A step is a chain of small operations: a second thread gains nothing (measured), and beside another busy process its
    # spinning costs tenfold. Said to OpenMP, which reads it when torch is imported, by those commands that need torch.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
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
