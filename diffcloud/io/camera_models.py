"""Camera intrinsics and poses in files, and their validation."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from diffcloud.errors import EpisodeError, unknown_name
from diffcloud.io.inputs import open_input
from diffcloud.io.numbers import number
from diffcloud.io.schema import Checked, Component

_LARGEST_TRANSFORM = 10_000
"""Size [bytes] of the largest text file of a transform."""

Pixels = Annotated[int, Field(ge=1, le=20_000)]

Distortion = Literal["none", "brown_conrady", "inverse_brown_conrady", "equidistant"]
"""Lens distortion models. `brown_conrady`: OpenCV's polynomial from rays to pixels. `inverse_brown_conrady`: the same
polynomial from pixels to rays, as in RealSense colour cameras (mostly all zero). `equidistant`: OpenCV's fisheye
model."""
LENS_COEFFICIENTS: dict[Distortion, tuple[int, ...]] = {
    "none": (),
    "brown_conrady": (5, 8, 12, 14),
    "inverse_brown_conrady": (5,),
    "equidistant": (4,),
}
"""Allowed numbers of coefficients of each model."""


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole camera with OpenCV's axes (x right, y down, z forward). Pixel centres have whole coordinates.

    Raises:
        EpisodeError: a value is impossible for a camera.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion = "none"
    coefficients: tuple[float, ...] = ()
    """In OpenCV's order. brown_conrady: k1, k2, p1, p2, k3, then optional k4 to k6 (rational), s1 to s4 (thin prism),
    and sensor tilt tau_x, tau_y [rad]. equidistant: k1 to k4."""

    def __post_init__(self) -> None:
        if self.distortion not in get_args(Distortion):
            raise EpisodeError(unknown_name("distortion model", self.distortion, get_args(Distortion)))
        if self.distortion == "none" and any(self.coefficients):
            raise EpisodeError(f"Distortion 'none' takes no coefficients, got {list(self.coefficients)}.")
        allowed = LENS_COEFFICIENTS[self.distortion]
        if self.coefficients and allowed and len(self.coefficients) not in allowed:
            raise EpisodeError(
                f"Distortion {self.distortion} has {', '.join(map(str, allowed))} coefficients, got "
                f"{len(self.coefficients)}."
            )
        numbers = [self.fx, self.fy, self.cx, self.cy, *self.coefficients]
        if not np.isfinite(numbers).all() or self.width < 1 or self.height < 1:
            raise EpisodeError(f"Intrinsics must be finite numbers and a size of at least 1 x 1, got {self}.")
        if not (0.1 * self.width < self.fx < 20 * self.width and 0.1 * self.height < self.fy < 20 * self.height):
            raise EpisodeError(
                f"A focal length of {self.fx:g} x {self.fy:g} px does not go with {self.width} x {self.height} pixels; "
                "focal lengths are in pixels of this resolution."
            )
        if not (0 <= self.cx <= self.width and 0 <= self.cy <= self.height):
            raise EpisodeError(
                f"The principal point ({self.cx:g}, {self.cy:g}) lies outside the {self.width} x {self.height} image; "
                "it belongs to another resolution."
            )

    @property
    def matrix(self) -> NDArray[np.float64]:
        """[3, 3] camera matrix in pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def same_camera(self, other: Intrinsics) -> bool:
        """Whether both may be one camera at the same resolution: focal lengths within 1 %, principal point within 5
        px."""
        return (
            (self.width, self.height) == (other.width, other.height)
            and abs(self.fx / other.fx - 1) < 0.01
            and abs(self.fy / other.fy - 1) < 0.01
            and max(abs(self.cx - other.cx), abs(self.cy - other.cy)) < 5
        )

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "coefficients": list(self.coefficients)}


class IntrinsicsFile(Checked):
    """Schema of `Intrinsics` in files."""

    width: Pixels
    height: Pixels
    fx: Component
    fy: Component
    cx: Component
    cy: Component
    distortion: Distortion = "none"
    coefficients: list[Component] = Field([], max_length=14)

    @model_validator(mode="after")
    def _is_a_camera(self) -> Self:
        self.intrinsics()
        return self

    def intrinsics(self) -> Intrinsics:
        try:
            return Intrinsics(**{**self.model_dump(), "coefficients": tuple(self.coefficients)})
        except EpisodeError as error:
            raise ValueError(str(error)) from error


def square(rows: list[list[float]], size: int) -> NDArray[np.float64]:
    """Convert rows to a square matrix [size, size].

    Raises:
        ValueError: the shape is different.
    """
    if len(rows) != size or any(len(row) != size for row in rows):
        raise ValueError(f"it must be {size} x {size} numbers")
    return np.array(rows, dtype=np.float64)


def _rigid(rows: list[list[float]]) -> list[list[float]]:
    """Return the rows of a valid rigid transform.

    Raises:
        ValueError: the matrix is not 4 x 4, not a rotation, or translates by more than 20 m (probably millimetres).
    """
    matrix = square(rows, 4)
    rotation = matrix[:3, :3]
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if not off <= 1e-4 or np.linalg.det(rotation) < 0 or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise ValueError(
            f"it is not a rigid transform (R Rᵀ differs from the identity by up to {off:.2g}); give [R t; 0 0 0 1] "
            "with det R = 1"
        )
    if not np.abs(matrix[:3, 3]).max() <= 20:
        raise ValueError(f"it translates by {np.abs(matrix[:3, 3]).max():.0f} m; give metres")
    return rows


def read_transform(path: Path) -> NDArray[np.float64]:
    """Read a rigid transform [4, 4] from a text file of four rows. Spaces or commas separate the numbers.

    Raises:
        EpisodeError: the file is not readable, or its matrix is not a rigid transform in metres.
    """
    with open_input(path, kind="transform file", error=EpisodeError, most_bytes=_LARGEST_TRANSFORM) as stream:
        content = stream.read()
    try:
        rows = [[number(word) for word in line.replace(",", " ").split()] for line in content.decode().splitlines()]
        return np.array(_rigid([row for row in rows if row]))
    except ValueError as error:
        raise EpisodeError(f"{path}: {error}.") from error


RigidTransform = Annotated[list[list[Component]], AfterValidator(_rigid)]
"""[4, 4] camera-to-world transform [m]."""
