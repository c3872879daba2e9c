"""Networks that estimate parameters from point clouds: simulate training sets, train, and predict."""

from __future__ import annotations

import typer

from diffcloud.cli.group import command_group

COMMANDS = {
    "generate": "diffcloud.cli.generate:generate",
    "train": "diffcloud.cli.train:train",
    "predict": "diffcloud.cli.predict:predict",
}

app = typer.Typer(cls=command_group(COMMANDS), no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


@app.callback()
def network() -> None:
    """Networks that estimate parameters from point clouds: simulate training sets, train, and predict."""
