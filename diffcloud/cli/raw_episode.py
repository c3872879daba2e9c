"""`diffcloud episode`: raw episodes."""

from __future__ import annotations

import time
import webbrowser
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from diffcloud.cli.console import JsonFlag, errors, finish, output, say
from diffcloud.io.calibrations import read_calibration
from diffcloud.sensing.validation.episode import validate_raw_episode

_POLL_S = 0.1
"""Between looks at the folder."""

app = typer.Typer(no_args_is_help=True, help="Raw episodes: what cameras and arm recorded.")


@app.callback()
def episode() -> None:
    """Raw episodes: what cameras and arm recorded."""


@app.command()
def validate(
    folder: Annotated[Path, typer.Argument(help="Raw episode: holds episode.json, cameras/, robot.csv.")],
    calibration: Annotated[Path | None, typer.Option(help="Calibration file its cameras should be in.")] = None,
    urdf: Annotated[Path | None, typer.Option(help="Description of the arm whose joints were logged.")] = None,
    json: JsonFlag = False,
) -> None:
    """Explain each fault of a raw episode; exit status 1 if there is one."""
    robot = None
    if urdf is not None:
        from diffcloud.sensing.robot import Robot  # not above: it brings torch, which nothing else here needs

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


@app.command()
def watch(
    folder: Annotated[Path, typer.Argument(help="Raw episode; it need not exist yet, or may be finished.")],
    calibration: Annotated[Path | None, typer.Option(help="Calibration file. Default: what camera.json says.")] = None,
    points: Annotated[int, typer.Option(min=100, max=500_000, help="Maximum number of points shown per camera.")] = 20_000,
    port: Annotated[
        int, typer.Option(min=1024, max=65535, help="Local port; if it is taken, the next free one is used.")
    ] = 8080,
    open_: Annotated[bool, typer.Option("--open", help="Open the page in a browser.")] = False,
) -> None:
    """Show clouds, cameras and tool in a browser while an episode is recorded. Ctrl-C stops watching, not the recording."""
    from diffcloud.live.follower import Follower
    from diffcloud.live.page import LivePage

    known = None if calibration is None else read_calibration(calibration)
    follower = Follower(folder, known, points=points)
    with LivePage(port=port, title=folder.name) as page, suppress(KeyboardInterrupt):  # which is how this ends
        errors.print(f"Watching {folder} at {page.url} (Ctrl-C stops watching).", soft_wrap=True)
        if not folder.exists():
            errors.print(f"{folder} does not exist yet; waiting for it.", soft_wrap=True)
        if open_:
            webbrowser.open(page.url)
        while True:
            if (frame := follower.newest()) is not None:
                page.show(frame)
                if frame.status != "recording":
                    errors.print(f"Recording {frame.status}. The page keeps its last frame until Ctrl-C.")
            time.sleep(_POLL_S)
