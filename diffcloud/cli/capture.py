"""`diffcloud data capture`: record a raw episode with depth cameras and an arm."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from diffcloud.cli.options import JsonFlag


def record(
    out: Annotated[
        Path | None, typer.Option(help="Folder of the episode, such as raw/episodes/lift/tan1; must not exist.")
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(help="YAML file of the set-up: cameras, arm, limits (docs/capture.md), such as rig.yaml."),
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(help="CSV (t_s, x, y, z[, gripper]) or NPY [T, 3]: path of the tool in the base frame, metres."),
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="How long to record cameras without the arm, s.")] = None,
    check: Annotated[
        Literal["arm", "cameras", "all"] | None,
        typer.Option(help="Record nothing; check what a capture relies on. The arm moves a little, if it is checked."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check the plan; open nothing. With --check arm: move nothing.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before the arm moves, nor for a pulled cable.")] = False,
    label: Annotated[
        list[str] | None,
        typer.Option(help="KEY=VALUE, kept in episode.json, such as scenario=lift or fabric=tan; repeated."),
    ] = None,
    home: Annotated[bool, typer.Option("--home", help="Move to the arm's home position first.")] = False,
    clear_faults: Annotated[bool, typer.Option("--clear-faults", help="Clear the arm's faults first.")] = False,
    keep_recording: Annotated[
        bool, typer.Option("--keep-recording", help="Also keep the SDK's own .db3 beside the episode.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Drive the arm along a trajectory and record cameras and arm, writing to disk while it runs.

    The arm is stopped whatever ends the capture: the trajectory's end, a limit, a fault, a lost camera, Ctrl-C or Ctrl-Z,
    even if this process is killed. What was recorded so far stays.
    """
    from diffcloud.cli.capturing import run_capture

    run_capture(
        out,
        rig=rig,
        trajectory=trajectory,
        seconds=seconds,
        check=check,
        dry_run=dry_run,
        yes=yes,
        label=label,
        home=home,
        clear_faults=clear_faults,
        keep_recording=keep_recording,
        json=json,
    )
