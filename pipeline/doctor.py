"""`diffcloud doctor`: what is installed and connected, and what is missing."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from diffcloud.hardware.installed import check_installation
from pipeline.console import JsonFlag, finish, show

_COLORS = {"ok": "green", "missing": "red"}


def doctor(
    arm: Annotated[str | None, typer.Option(help="Address of the arm, to see whether it answers.")] = None,
    folder: Annotated[Path, typer.Option(help="Where episodes would be written.")] = Path("."),
    json: JsonFlag = False,
) -> None:
    """Print what a capture needs and whether it is here. Nothing moves. Exit status 0 whatever is missing."""
    checks = check_installation(arm=arm, folder=folder)
    table = Table("", "state", "detail")
    for check in checks:
        color = _COLORS[check.state]
        table.add_row(check.name, f"[{color}]{check.state}[/]", escape(check.detail))
    show(table, json)
    missing = [check.name for check in checks if check.state != "ok"]
    finish({"checks": [asdict(check) for check in checks], "missing": missing}, json)
