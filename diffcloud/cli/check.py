"""`diffcloud data check`: the faults of a raw episode."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from diffcloud.cli.options import JsonFlag
from diffcloud.console import errors, finish, output, say


def check(
    folder: Annotated[Path, typer.Argument(help="Raw episode: holds episode.json, cameras/, robot.csv.")],
    calibration: Annotated[Path | None, typer.Option(help="Calibration file its cameras should be in.")] = None,
    urdf: Annotated[Path | None, typer.Option(help="Description of the arm whose joints were logged.")] = None,
    json: JsonFlag = False,
) -> None:
    """Explain each fault of a raw episode; exit status 1 if there is one."""
    from diffcloud.sensing.validation.episode import validate_raw_episode

    robot = None
    if urdf is not None:
        from diffcloud.sensing.robot import Robot  # which brings torch, and nothing else here needs it

        robot = Robot.from_urdf(urdf)
    findings = validate_raw_episode(folder, calibration=calibration, robot=robot)
    faults = [finding for finding in findings if finding.severity == "fault"]
    screen = errors if json else output
    for finding in findings:
        color = "red" if finding.severity == "fault" else "yellow"
        told = f"{finding.code} in {finding.place}: {finding.message}"
        say(finding.severity, told, style=f"bold {color}", console=screen)
    if not findings:
        screen.print(f"{folder!s}: nothing wrong.")
    finish({"episode": str(folder), "valid": not faults, "findings": [asdict(finding) for finding in findings]}, json)
    if faults:
        raise typer.Exit(1)
