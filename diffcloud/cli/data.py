"""Recordings: import, clean, check and capture them, and calibrate cameras."""

from __future__ import annotations

import typer

from diffcloud.cli.group import command_group

COMMANDS = {
    "import": "diffcloud.cli.importing:import_",
    "preprocess": "diffcloud.cli.preprocess:preprocess",
    "check": "diffcloud.cli.check:check",
    "capture": "diffcloud.cli.capture:record",
    "calibrate": "diffcloud.cli.calibrate:calibrate",
}

app = typer.Typer(cls=command_group(COMMANDS), no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


@app.callback()
def data() -> None:
    """Recordings: import, clean, check and capture them, and calibrate cameras."""
