"""`diffcloud doctor`: what is installed and connected, what is missing, and where compiled code is kept."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from diffcloud.cli.options import JsonFlag
from diffcloud.console import finish, progress_bar, show, show_checks


def doctor(
    arm: Annotated[str | None, typer.Option(help="Address of the arm, to see whether it answers.")] = None,
    folder: Annotated[Path, typer.Option(help="Where episodes would be written.")] = Path("."),
    compile_: Annotated[
        bool, typer.Option("--compile", help="Compile the kernels now rather than at first use (up to five minutes).")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Print what a capture needs and whether it is here. Nothing moves. Exit status 0 whatever is missing."""
    from diffcloud.hardware.installed import check_installation

    if compile_:
        _compile()
    checks = check_installation(arm=arm, folder=folder)
    show_checks(checks, json)
    compiled = _compiled()
    kept = Table("compiled code", "")
    kept.add_row("folder", compiled["folder"])
    kept.add_row("size", f"{compiled['bytes'] / 1e6:.1f} MB")
    kept.add_row("built", "yes" if compiled["built"] else "no: at first use, or now with diffcloud doctor --compile")
    show(kept, json)
    missing = [check.name for check in checks if check.state != "ok"]
    finish({"checks": [asdict(check) for check in checks], "missing": missing, "compiled": compiled}, json)


def _compiled() -> dict[str, Any]:
    from diffcloud.compiled import cache_folder, cache_size, is_built  # imports numba, which takes a moment

    return {"folder": str(cache_folder()), "bytes": cache_size(), "built": is_built()}


def _compile() -> None:
    from diffcloud.compiled import compile_all

    work = [  # two processes that take equally long
        [("implicit steps", "diffcloud.sim.warm:implicit")],
        [
            ("steps of ARCSim", "diffcloud.sim.warm:arcsim"),
            ("nearest neighbours", "diffcloud.clouds.neighbours:compile_neighbours"),
            ("nearest places", "diffcloud.clouds.surface:compile_surface"),
            ("poses", "diffcloud.estimation.curvature:compile_terms"),
        ],
    ]
    with progress_bar("compiling", sum(map(len, work))) as update:
        compile_all(update, work)
