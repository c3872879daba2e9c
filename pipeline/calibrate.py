"""`diffcloud calibrate`: where the cameras stand in the robot's base frame."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer
from rich.markup import escape
from rich.table import Table

from diffcloud.errors import CalibrationError, EpisodeError
from diffcloud.io.calibrations import Calibration, CameraCalibration, write_calibration
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.images import write_color
from diffcloud.io.pickles import load_npy
from diffcloud.io.raw_episodes import RawEpisode, read_raw_episode
from diffcloud.sensing.calibration import CharucoBoard, calibrate_hand_eye, find_views
from diffcloud.sensing.pictures import reprojection_picture
from diffcloud.sensing.registration import register_checkerboard
from pipeline.console import JsonFlag, errors, finish, show, warn


def calibrate(
    source: Annotated[
        list[Path],
        typer.Argument(
            help="charuco: a raw episode in which the gripper shows the board. checkerboard: a folder per camera with "
            "cam_chessboard.npy, robot_chessboard.npy and intrinsics.npy; the folder's name names the camera."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Calibration file, such as raw/calibration/lab.json.")],
    method: Annotated[Literal["charuco", "checkerboard"], typer.Option()] = "charuco",
    squares: Annotated[str, typer.Option(help="Squares of the board, COLUMNSxROWS.")] = "5x7",
    square_mm: Annotated[float, typer.Option(help="Side of a square, measured.")] = 30.0,
    marker_mm: Annotated[float, typer.Option(help="Side of a marker, measured.")] = 22.0,
    dictionary: Annotated[str, typer.Option(help="Of the markers.")] = "DICT_5X5_100",
    picture: Annotated[Path | None, typer.Option(help="PNG of detected and reprojected corners.")] = None,
    serial: Annotated[list[str] | None, typer.Option(help="checkerboard: NAME=SERIAL; the name if not given.")] = None,
    size: Annotated[str, typer.Option(help="checkerboard: size of the images.")] = "640x480",
    json: JsonFlag = False,
) -> None:
    """Calibrate all cameras of a set-up into one file."""
    if method == "checkerboard":
        calibration, summary = _checkerboard(source, serial or [], _pair(size, "--size"))
    else:
        if len(source) != 1:
            raise CalibrationError(f"--method charuco takes one raw episode, got {len(source)} sources.")
        columns, rows = _pair(squares, "--squares")
        board = CharucoBoard(columns, rows, square_mm / 1000, marker_mm / 1000, dictionary)
        calibration, summary = _charuco(read_raw_episode(source[0]), board, picture)
    write_calibration(out, calibration)
    columns_shown = sorted({key for entry in summary.values() for key in entry if not isinstance(entry[key], list)})
    table = Table("camera", "position [m]", *columns_shown)
    for name, entry in summary.items():
        position = " ".join(f"{value:.4f}" for value in np.array(entry["T_world_camera"])[:3, 3])
        table.add_row(name, position, *(f"{entry[key]:.4g}" if key in entry else "" for key in columns_shown))
    show(table, json)
    errors.print(f"Wrote {escape(str(out))}.")
    finish({"out": str(out), "method": method, "cameras": summary}, json)


def _charuco(
    episode: RawEpisode, board: CharucoBoard, picture: Path | None
) -> tuple[Calibration, dict[str, dict[str, Any]]]:
    if episode.robot is None:
        raise CalibrationError(f"{episode.folder} has no robot.csv: the board's place comes from the gripper's pose.")
    views, poses = find_views(episode.cameras, episode.robot, board)
    found = calibrate_hand_eye(views, poses, board)
    for message in found.warnings:
        warn(message)
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
    return Calibration(cameras, "charuco", described), summary


def _checkerboard(
    folders: list[Path], serials: list[str], size: tuple[int, int]
) -> tuple[Calibration, dict[str, dict[str, Any]]]:
    known = dict(item.partition("=")[::2] for item in serials)
    cameras: dict[str, CameraCalibration] = {}
    summary: dict[str, dict[str, Any]] = {}
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
        except (EpisodeError, CalibrationError) as error:
            raise CalibrationError(f"{folder}: {error}") from error
        except (TypeError, ValueError) as error:
            raise CalibrationError(f"{folder}: not the arrays of a calibration: {error}.") from error
        residuals = {
            "rms_mm": 1000 * found.rms_m,
            "largest_mm": 1000 * float(found.residual_m.max()),
            "depth_scale": 1 / found.scale,
        }
        if abs(found.scale - 1) > 0.01:
            warn(
                f"Camera {name} sees the board {100 * (1 / found.scale - 1):+.1f} % too large: a depth scale error, which "
                "a rigid motion cannot absorb."
            )
        label = known.get(name, name)
        cameras[label] = CameraCalibration(label, intrinsics, found.T_world_camera, None, name, residuals)
        summary[name] = {**residuals, "T_world_camera": found.T_world_camera.tolist()}
    return Calibration(cameras, "checkerboard", {"corners": len(points[0])}), summary


def _pair(text: str, option: str) -> tuple[int, int]:
    first, _, second = text.partition("x")
    if not (first.isdigit() and second.isdigit()):
        raise CalibrationError(f"{option} takes two whole numbers such as 5x7, got {text!r}.")
    return int(first), int(second)
