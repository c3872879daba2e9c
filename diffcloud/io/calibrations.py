"""Calibration files: where each camera stands in the robot's base frame, how surely, and how that was found.

`raw/calibration/<name>.json` (DESIGN: data contracts): cameras by serial, each with intrinsics, `T_world_camera` (4 x 4,
maps camera points to world points, metres) and a 6 x 6 covariance of (translation [m], rotation [rad]), perturbations on
the world's side: T = (exp(rotation) R, translation + t).
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import CalibrationError
from diffcloud.io.camera_models import Intrinsics, read_transform
from diffcloud.io.files import read_json, write_json

_VERSION = 1


@dataclass(frozen=True)
class CameraCalibration:
    """One camera's place."""

    serial: str
    intrinsics: Intrinsics
    T_world_camera: NDArray[np.float64]
    """[4, 4] maps camera points to world points [m]."""
    covariance: NDArray[np.float64] | None = None
    """[6, 6] of translation [m] and rotation vector [rad], on the world's side; None where the method gives none."""
    name: str = ""
    """What the person calls it: overhead, side."""
    residuals: Mapping[str, float] = field(default_factory=dict)
    """What the method measures. charuco: rms_px and rms_mm on held-out poses, rms_fit_px, rms_fit_mm. checkerboard: rms_mm
    of the fit, held_out_mm on corners left out."""


@dataclass(frozen=True)
class Calibration:
    """All cameras of one set-up."""

    cameras: Mapping[str, CameraCalibration]
    """By serial."""
    method: str
    board: Mapping[str, Any] = field(default_factory=dict)
    date: str = ""
    """ISO 8601."""
    objections: tuple[str, ...] = ()
    """Why it should not be used; it was written all the same, by force."""

    def camera(self, serial: str, *, name: str = "") -> CameraCalibration:
        """The calibration of one camera.

        Raises:
            CalibrationError: this file is of other cameras.
        """
        if serial not in self.cameras:
            label = f"{name} (serial {serial})" if name else f"serial {serial}"
            held = ", ".join(f"{key} ({entry.name})" if entry.name else key for key, entry in self.cameras.items())
            raise CalibrationError(
                f"The calibration has no camera {label}; it holds {held}. It is of another camera: calibrate this one, or "
                "name the right file."
            )
        return self.cameras[serial]


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write atomically, as JSON."""
    cameras = {
        serial: {
            "name": camera.name,
            "intrinsics": camera.intrinsics.to_json(),
            "T_world_camera": camera.T_world_camera.tolist(),
            "covariance": None if camera.covariance is None else camera.covariance.tolist(),
            "residuals": dict(camera.residuals),
        }
        for serial, camera in calibration.cameras.items()
    }
    date = calibration.date or datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    write_json(
        Path(path),
        {
            "schema_version": _VERSION,
            "method": calibration.method,
            "date": date,
            "units": {"length": "m", "angle": "rad"},
            "board": dict(calibration.board),
            "forced": bool(calibration.objections),
            "objections": list(calibration.objections),
            "cameras": cameras,
        },
    )


def read_calibration(path: Path) -> Calibration:
    """Read and check.

    Raises:
        CalibrationError: missing, damaged, of another version, or with a matrix that is no rigid transform.
    """
    data = read_json(Path(path), error=CalibrationError)
    if not isinstance(data, dict) or data.get("schema_version") != _VERSION:
        raise CalibrationError(f"{path} is not a calibration of schema_version {_VERSION}.")
    try:
        cameras = {str(serial): _camera(str(serial), entry, path) for serial, entry in data["cameras"].items()}
        objections = tuple(str(text) for text in data.get("objections", ()))
        return Calibration(cameras, str(data["method"]), data.get("board", {}), str(data.get("date", "")), objections)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CalibrationError(f"{path}: a field is missing or wrong: {error!r}.") from error


def _camera(serial: str, entry: Mapping[str, Any], path: Path) -> CameraCalibration:
    where = f"{path}: camera {serial}"
    covariance = entry.get("covariance")
    if covariance is not None:
        covariance = np.asarray(covariance, dtype=np.float64)
        if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
            raise CalibrationError(f"{where}: covariance must be 6 x 6 finite numbers.")
    return CameraCalibration(
        serial,
        Intrinsics.from_json(entry["intrinsics"], where, CalibrationError),
        read_transform(entry["T_world_camera"], f"{where}: T_world_camera", CalibrationError),
        covariance,
        str(entry.get("name", "")),
        {str(key): float(value) for key, value in entry.get("residuals", {}).items()},
    )
