"""Calibrate all cameras of a setup from images of a ChArUco board, or from points touched by the robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from diffcloud.errors import CalibrationError, EpisodeError
from diffcloud.io.calibrations import Calibration, CameraCalibration
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.images import write_color
from diffcloud.io.pickles import load_npy
from diffcloud.io.raw_episodes import RawEpisode
from diffcloud.sensing.calibration.charuco import CharucoBoard
from diffcloud.sensing.calibration.checkerboard import checkerboard_evidence, register_checkerboard
from diffcloud.sensing.calibration.checks import CheckerboardEvidence, judge_checkerboard
from diffcloud.sensing.calibration.hand_eye import calibrate_hand_eye, find_views
from diffcloud.sensing.pictures import reprojection_picture


@dataclass(frozen=True)
class Calibrated:
    """A calibration with its summary and warnings."""

    calibration: Calibration
    summary: dict[str, dict[str, Any]]
    """Camera name -> residuals and T_world_camera."""
    warnings: list[str]
    more: dict[str, Any] = field(default_factory=dict)
    """Results that do not belong to one camera."""


def by_charuco(episode: RawEpisode, board: CharucoBoard, picture: Path | None) -> Calibrated:
    """Calibrate cameras from images of a ChArUco board in the gripper.

    Args:
        picture: path of a PNG with detected and reprojected corners, if wanted.

    Raises:
        CalibrationError: there is no joint log, too few views, or views contradict each other.
    """
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
    return Calibrated(calibration, summary, list(found.warnings), by_arm)


def by_checkerboard(folders: Sequence[Path], serials: Mapping[str, str], size: tuple[int, int]) -> Calibrated:
    """Calibrate cameras from checkerboard corners that each camera saw and the robot touched (the paper's method).

    Args:
        folders: one for each camera. The folder's name, without a leading `calib_`, is the camera's name.
        serials: camera name -> serial number. A camera without a serial number is listed under its name.
        size: columns and rows of the images [px].

    Raises:
        CalibrationError: arrays are missing or damaged, or two folders belong to one camera.
    """
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
        label = serials.get(name, name)
        cameras[label] = CameraCalibration(label, intrinsics, found.T_world_camera, None, name, residuals)
        summary[name] = {**residuals, "T_world_camera": found.T_world_camera.tolist()}
    warnings, objections = judge_checkerboard(evidence)
    board = {"corners": len(points[0])}
    return Calibrated(Calibration(cameras, "checkerboard", board, objections=tuple(objections)), summary, warnings)
