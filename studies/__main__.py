"""`python -m studies`: what is measured of this project, for its pages of results. Nothing imports a study."""

from __future__ import annotations

import typer

from diffcloud.cli.app import run
from diffcloud.cli.group import command_group

COMMANDS = {
    "acceptance": "studies.acceptance:acceptance",
    "bench": "studies.bench:bench",
    "coverage": "studies.coverage:coverage",
    "discretisation": "studies.discretisation:discretisation",
    "foreign": "studies.foreign:main",
    "gradients": "studies.gradients:gradients",
    "hanging": "studies.hanging_cloth:main",
    "index": "studies.index:index",
    "published": "studies.published:published",
    "recorded": "studies.recorded:main",
    "recordings": "studies.recordings:recordings",
    "simulators": "studies.simulators:simulators",
    "towels": "studies.towels:towels",
}
"""Name -> where it lies; it is imported when it is run."""

app = typer.Typer(
    cls=command_group(COMMANDS),
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Measure how well and how fast fits, simulator and recordings are.",
)


@app.callback()
def studies() -> None:
    """Measure how well and how fast fits, simulator and recordings are."""


if __name__ == "__main__":
    run(app)
