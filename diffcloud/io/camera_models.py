"""How files describe a camera: its intrinsics and its place, checked on the way in."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from diffcloud.errors import EpisodeError, unknown_name
from diffcloud.io.schema import Checked, Component

Pixels = Annotated[int, Field(ge=1, le=20_000)]

Distortion = Literal["none", "brown_conrady", "inverse_brown_conrady", "equidistant"]
"""`brown_conrady`: OpenCV's, from rays to pixels. `inverse_brown_conrady`: the same polynomial from pixels to rays, which
RealSense colour cameras state (mostly with zeros). `equidistant`: OpenCV's fisheye, from rays to pixels."""
LENS_COEFFICIENTS: dict[Distortion, tuple[int, ...]] = {
    "none": (),
    "brown_conrady": (5, 8, 12, 14),
    "inverse_brown_conrady": (5,),
    "equidistant": (4,),
}
"""How many coefficients a model may have."""


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera with OpenCV's frame: x right, y down, z forward; pixel centres at whole numbers.

    Raises:
        EpisodeError: a number that no camera has.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion = "none"
    coefficients: tuple[float, ...] = ()
    """In OpenCV's order: (k1, k2, p1, p2, k3), of brown_conrady also with k4..k6 (rational), s1..s4 (thin prism), and the
    tilt of the sensor tau_x, tau_y [rad]; of equidistant (k1, k2, k3, k4)."""

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
        """[3, 3]."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def same_camera(self, other: Intrinsics) -> bool:
        """Whether both can describe one camera at one resolution: focal lengths within 1 %, principal point within 5 px."""
        return (
            (self.width, self.height) == (other.width, other.height)
            and abs(self.fx / other.fx - 1) < 0.01
            and abs(self.fy / other.fy - 1) < 0.01
            and max(abs(self.cx - other.cx), abs(self.cy - other.cy)) < 5
        )

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "coefficients": list(self.coefficients)}


class IntrinsicsFile(Checked):
    """`Intrinsics` as files state them."""

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
    """[n, n] of rows.

    Raises:
        ValueError: another shape.
    """
    if len(rows) != size or any(len(row) != size for row in rows):
        raise ValueError(f"it must be {size} x {size} numbers")
    return np.array(rows, dtype=np.float64)


def _rigid(rows: list[list[float]]) -> list[list[float]]:
    """
    Raises:
        ValueError: not 4 x 4, not a rotation, or a translation of more than 20 m (millimetres).
    """
    matrix = square(rows, 4)
    rotation = matrix[:3, :3]
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > 1e-4 or np.linalg.det(rotation) < 0 or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise ValueError(f"it is no rigid transform (its rotation is off by {off:.2g}); give [R t; 0 0 0 1], right-handed")
    if np.abs(matrix[:3, 3]).max() > 20:
        raise ValueError(f"it puts the camera {np.abs(matrix[:3, 3]).max():.0f} m away; translations are metres")
    return rows


RigidTransform = Annotated[list[list[Component]], AfterValidator(_rigid)]
"""[4, 4], from camera to world [m]."""
