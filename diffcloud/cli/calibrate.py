"""`diffcloud calibrate`: where the cameras stand in the robot's base frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer
from rich.table import Table

from diffcloud.cli.console import JsonFlag, errors, finish, named_serials, show, warn, whole_numbers, writes
from diffcloud.errors import CalibrationError, ConfigError, EpisodeError, unknown_name
from diffcloud.hardware.rig import RigSettings, read_rig
from diffcloud.io.calibrations import Calibration, CameraCalibration, write_calibration
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.images import write_color
from diffcloud.io.pickles import load_npy
from diffcloud.io.raw_episodes import RawEpisode, read_raw_episode
from diffcloud.sensing.calibration.charuco import CharucoBoard
from diffcloud.sensing.calibration.checkerboard import checkerboard_evidence, register_checkerboard
from diffcloud.sensing.calibration.checks import CheckerboardEvidence, judge_checkerboard
from diffcloud.sensing.calibration.hand_eye import calibrate_hand_eye, find_views
from diffcloud.sensing.pictures import reprojection_picture

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
    serial: Annotated[
        list[str] | None,
        typer.Option(help="checkerboard: NAME=SERIAL, in place of the serial number in --rig. Without both, the name."),
    ] = None,
    size: Annotated[
        str | None, typer.Option(help="checkerboard: size of the images, WIDTHxHEIGHT, in place of that in --rig.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Write the file despite objections; it will list them.")] = False,
    json: JsonFlag = False,
) -> None:
    """Calibrate all cameras of a set-up into one file."""
    setup = RigSettings() if rig is None else read_rig(rig)
    _refuse_others(method, {"--picture": picture, "--serial": serial, "--size": size})
    if method == "checkerboard":
        image_size = setup.image_size if size is None else whole_numbers(size, "--size")
        found = _checkerboard(source, setup.cameras, serial or [], image_size)
    else:
        if len(source) != 1:
            raise CalibrationError(f"--method charuco takes one raw episode, got {len(source)} sources.")
        found = _charuco(read_raw_episode(source[0]), setup.board.charuco(), picture)
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


def _refuse_others(method: str, given: Mapping[str, object]) -> None:
    """
    Raises:
        ConfigError: an option of the other method is given.
    """
    own = {"charuco": ("--picture",), "checkerboard": ("--serial", "--size")}
    for option, value in given.items():
        if value and option not in own[method]:
            other = next(name for name, options in own.items() if option in options)
            raise ConfigError(f"{option} belongs to --method {other}, and this is --method {method}. Leave {option} out.")


@dataclass(frozen=True)
class _Found:
    """A calibration and what is said about it."""

    calibration: Calibration
    summary: dict[str, dict[str, Any]]
    """By camera: figures and T_world_camera."""
    warnings: list[str]
    more: dict[str, Any] = field(default_factory=dict)
    """Figures of the whole."""


def _charuco(episode: RawEpisode, board: CharucoBoard, picture: Path | None) -> _Found:
    if episode.robot is None:
        raise CalibrationError(f"{episode.folder} has no robot.csv: the board's place comes from the gripper's pose.")
    views, poses = find_views(episode.cameras, episode.robot, board)
    found = calibrate_hand_eye(views, poses, board)
    if picture is not None:
        shown = reprojection_picture(episode.cameras, views, poses, board, found)
        write_color(picture, shown)
    cameras, summary = {}, {}
    for name, matrix in found.T_world_camera.items():
        info = episode.cameras[name].info
        residuals = dict(found.residuals[name])
        covariance = found.covariance[name]
        cameras[info.serial] = CameraCalibration(info.serial, info.intrinsics, matrix, covariance, name, residuals)
        deviation = np.sqrt(np.diag(covariance))
        summary[name] = {
            **residuals,
            "position_deviation_mm": float(1000 * np.linalg.norm(deviation[:3])),
            "angle_deviation_deg": float(np.rad2deg(np.linalg.norm(deviation[3:]))),
            "T_world_camera": matrix.tolist(),
        }
    described = {
        "columns": board.columns,
        "rows": board.rows,
        "square_m": board.square_m,
        "marker_m": board.marker_m,
        "dictionary": board.dictionary,
        "T_gripper_board": found.T_gripper_board.tolist(),
    }
    by_arm = {"square_by_arm_m": board.square_m * found.board_size.value}
    calibration = Calibration(cameras, "charuco", {**described, **by_arm}, objections=found.objections)
    return _Found(calibration, summary, list(found.warnings), by_arm)


def _checkerboard(folders: list[Path], of_rig: Mapping[str, str], serials: list[str], size: tuple[int, int]) -> _Found:
    given = named_serials(serials, "--serial")
    names = [folder.name.removeprefix("calib_") for folder in folders]
    if others := sorted(given.keys() - set(names)):
        raise CalibrationError(unknown_name("camera in --serial", others[0], names))
    known = {**of_rig, **given}
    cameras: dict[str, CameraCalibration] = {}
    summary: dict[str, dict[str, Any]] = {}
    evidence: dict[str, CheckerboardEvidence] = {}
    for folder in folders:
        name = folder.name.removeprefix("calib_")
        if name in summary:
            raise CalibrationError(f"Two folders are of camera {name!r}; a folder's name names its camera.")
        try:
            points = [
                np.asarray(load_npy(folder / file), np.float64) for file in ("cam_chessboard.npy", "robot_chessboard.npy")
            ]
            fx, fy, cx, cy = np.asarray(load_npy(folder / "intrinsics.npy"), np.float64).ravel()
            intrinsics = Intrinsics(*size, float(fx), float(fy), float(cx), float(cy))
            found = register_checkerboard(*points)
            evidence[name] = checkerboard_evidence(found, *points)
        except (EpisodeError, CalibrationError) as error:
            raise CalibrationError(f"{folder}: {error}") from error
        except (TypeError, ValueError) as error:
            raise CalibrationError(f"{folder}: not the arrays of a calibration: {error}.") from error
        residuals = {
            "rms_mm": 1000 * found.rms_m,
            "largest_mm": 1000 * float(found.residual_m.max()),
            "depth_scale": evidence[name].size_ratio,
            "held_out_corners": float(evidence[name].held_out_corners),
        }
        held_out_mm = evidence[name].held_out_mm
        if held_out_mm is not None:
            residuals["held_out_mm"] = held_out_mm
        label = known.get(name, name)
        cameras[label] = CameraCalibration(label, intrinsics, found.T_world_camera, None, name, residuals)
        summary[name] = {**residuals, "T_world_camera": found.T_world_camera.tolist()}
    warnings, objections = judge_checkerboard(evidence)
    board = {"corners": len(points[0])}
    return _Found(Calibration(cameras, "checkerboard", board, objections=tuple(objections)), summary, warnings)
