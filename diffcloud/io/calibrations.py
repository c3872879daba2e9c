"""Read and write calibration files: pose of each camera in the robot's base frame, covariance and residuals.

`raw/calibration/<name>.json` lists cameras by serial number. Each has intrinsics, `T_world_camera` (4 x 4, maps camera
points to world points [m]) and a 6 x 6 covariance of (translation [m], rotation vector [rad]). Perturbations are on the
world side: T = (exp(rotation) R, translation + t).
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, ValidationError

from diffcloud.errors import CalibrationError
from diffcloud.io.camera_models import Intrinsics, IntrinsicsFile, RigidTransform, square
from diffcloud.io.files import read_json, write_json
from diffcloud.io.schema import Checked, Component, NonNegative, Positive, explain

_VERSION = 1
Text = Annotated[str, Field(max_length=10_000)]


@dataclass(frozen=True)
class CameraCalibration:
    """Calibration of one camera."""

    serial: str
    intrinsics: Intrinsics
    T_world_camera: NDArray[np.float64]
    """[4, 4] maps camera points to world points [m]."""
    covariance: NDArray[np.float64] | None = None
    """[6, 6] covariance of translation [m] and rotation vector [rad], on the world side. None if unknown."""
    name: str = ""
    """User's name of the camera, such as overhead or side."""
    residuals: Mapping[str, float] = field(default_factory=dict)
    """Errors of the method. charuco: rms_px, rms_mm (held-out poses), rms_fit_px, rms_fit_mm. checkerboard: rms_mm (of
    the fit), held_out_mm (held-out corners)."""


@dataclass(frozen=True)
class Calibration:
    """Calibration of all cameras of a setup."""

    cameras: Mapping[str, CameraCalibration]
    """Serial number -> calibration."""
    method: str
    board: Mapping[str, Any] = field(default_factory=dict)
    date: str = ""
    """ISO 8601."""
    objections: tuple[str, ...] = ()
    """Failed quality checks. A calibration with failed checks is written only if the user forces it."""

    def camera(self, serial: str, *, name: str = "") -> CameraCalibration:
        """Return the calibration of one camera.

        Raises:
            CalibrationError: the file does not have this camera.
        """
        if serial not in self.cameras:
            label = f"{name} (serial {serial})" if name else f"serial {serial}"
            held = ", ".join(f"{key} ({entry.name})" if entry.name else key for key, entry in self.cameras.items())
            raise CalibrationError(
                f"The calibration has no camera {label}; it holds {held}. It is of another camera: calibrate this one, or "
                "name the right file."
            )
        return self.cameras[serial]


def _covariance(rows: list[list[float]]) -> list[list[float]]:
    """Return a valid covariance.

    Raises:
        ValueError: the matrix is not 6 x 6, not symmetric, or has negative variances.
    """
    matrix = square(rows, 6)
    scale = float(np.abs(matrix).max())
    if np.abs(matrix - matrix.T).max() > 1e-6 * scale or np.linalg.eigvalsh(matrix)[0] < -1e-6 * scale:
        raise ValueError("it is no covariance: not symmetric, or with a negative variance")
    return rows


class CameraFile(Checked):
    """Schema of one camera in a calibration file."""

    name: Text = ""
    intrinsics: IntrinsicsFile
    T_world_camera: RigidTransform
    covariance: Annotated[list[list[Component]], AfterValidator(_covariance)] | None = None
    residuals: dict[str, NonNegative] = Field({})


class CalibrationFile(Checked):
    """Schema of a calibration file."""

    schema_version: Literal[1]
    method: Text
    date: Text = ""
    units: dict[str, Text] = Field({"length": "m", "angle": "rad"})
    board: dict[str, Positive | Text | list[list[Component]]] = Field({})
    forced: bool = False
    objections: list[Text] = Field([])
    cameras: Annotated[dict[str, CameraFile], Field(min_length=1, max_length=64)]


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration file (JSON) atomically."""
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
    """Read and check a calibration file.

    Raises:
        CalibrationError: the file is missing or damaged, has another version, or a matrix is not a rigid transform.
    """
    try:
        told = CalibrationFile.model_validate(read_json(Path(path), error=CalibrationError))
    except ValidationError as error:
        raise explain(path, error, CalibrationError) from error
    cameras = {
        serial: CameraCalibration(
            serial,
            camera.intrinsics.intrinsics(),
            np.array(camera.T_world_camera),
            None if camera.covariance is None else np.array(camera.covariance),
            camera.name,
            camera.residuals,
        )
        for serial, camera in told.cameras.items()
    }
    return Calibration(cameras, told.method, told.board, told.date, tuple(told.objections))
