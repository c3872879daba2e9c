"""`diffcloud data calibrate`: where the cameras stand in the robot's base frame."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from diffcloud.cli.options import JsonFlag
from diffcloud.console import errors, finish, show, warn, writes
from diffcloud.errors import CalibrationError, ConfigError

_SHOWN = {
    "charuco": {
        "rms_mm": "held out [mm]",
        "rms_px": "held out [px]",
        "held_out_poses": "poses",
        "rms_fit_mm": "fit [mm]",
        "position_deviation_mm": "± [mm]",
        "angle_deviation_deg": "± [°]",
        "depth_scale": "depth",
        "focal_scale": "focal length",
    },
    "checkerboard": {
        "held_out_mm": "held out [mm]",
        "rms_mm": "fit [mm]",
        "largest_mm": "largest [mm]",
        "held_out_corners": "corners",
        "depth_scale": "size",
    },
}
"""Heading of each figure that is printed; depth, focal length and size are over what was entered."""


@writes(".json")
def calibrate(
    source: Annotated[
        list[Path],
        typer.Argument(
            help="charuco: a raw episode in which the gripper shows the board. checkerboard: a folder per camera with "
            "cam_chessboard.npy, robot_chessboard.npy and intrinsics.npy; the folder's name names the camera."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Calibration file, such as raw/calibration/lab.json.")],
    rig: Annotated[
        Path | None,
        typer.Option(
            help="YAML file of the set-up (docs/capture.md). charuco: its `board`. checkerboard: serial numbers of its "
            "`cameras`, and `image_size`. Default: the default board, and images of 640x480."
        ),
    ] = None,
    method: Annotated[
        Literal["charuco", "checkerboard"], typer.Option(help="Board in the gripper, or the paper's method.")
    ] = "charuco",
    picture: Annotated[Path | None, typer.Option(help="charuco: PNG of detected and reprojected corners.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Write the file despite objections; it will list them.")] = False,
    json: JsonFlag = False,
) -> None:
    """Calibrate all cameras of a set-up into one file."""
    import numpy as np
    from rich.table import Table

    from diffcloud.hardware.rig import RigSettings, read_rig
    from diffcloud.io.calibrations import write_calibration
    from diffcloud.io.raw_episodes import read_raw_episode
    from diffcloud.jobs.calibration import by_charuco, by_checkerboard

    setup = RigSettings() if rig is None else read_rig(rig)
    if method == "checkerboard":
        if picture is not None:
            raise ConfigError("--picture belongs to --method charuco, and this is --method checkerboard. Leave it out.")
        found = by_checkerboard(source, setup.cameras, setup.image_size)
    else:
        if len(source) != 1:
            raise CalibrationError(f"--method charuco takes one raw episode, got {len(source)} sources.")
        found = by_charuco(read_raw_episode(source[0]), setup.board.charuco(), picture)
    summary, objections = found.summary, list(found.calibration.objections)
    columns_shown = _SHOWN[method]
    table = Table("camera", *("position [m]", *columns_shown.values()))
    for name, entry in summary.items():
        position = " ".join(f"{value:.4f}" for value in np.array(entry["T_world_camera"])[:3, 3])
        table.add_row(name, position, *(f"{entry[key]:.4g}" if key in entry else "" for key in columns_shown))
    show(table, json)
    for message in found.warnings:
        warn(message)
    if objections and not force:
        raise CalibrationError(
            "The calibration is not written. " + " ".join(objections) + " To write it all the same: --force."
        )
    for message in objections:
        warn(message)
    write_calibration(out, found.calibration)
    errors.print(f"Wrote {out}.")
    finish(
        {
            "out": str(out),
            "method": method,
            "cameras": summary,
            "warnings": found.warnings,
            "forced": bool(objections),
            "objections": objections,
            **found.more,
        },
        json,
    )
