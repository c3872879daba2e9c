"""ChArUco boards and their detection in images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffcloud.errors import CalibrationError
from diffcloud.io.camera_models import Intrinsics
from diffcloud.sensing.cameras import rays

Floats = NDArray[np.float64]

FEWEST_CORNERS = 6


@dataclass(frozen=True)
class CharucoBoard:
    """A printed board. Measure its squares with a calliper."""

    columns: int = 5
    """Number of squares in a row."""
    rows: int = 7
    square_m: float = 0.03
    marker_m: float = 0.022
    dictionary: str = "DICT_5X5_100"
    legacy: bool = False
    """Whether the board has the pattern of OpenCV before 4.6, which calib.io also prints. It differs only for an even
    number of rows: the top left square is then white, with a marker. Corner numbers and positions are the same."""

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or not 0 < self.marker_m < self.square_m < 1:
            raise CalibrationError(
                f"A board needs 3 x 3 squares or more and 0 < marker < square < 1 m, got {self.columns} x {self.rows}, "
                f"square {self.square_m:g} m, marker {self.marker_m:g} m."
            )

    def opencv(self) -> Any:
        """Return the board as an object of cv2.aruco.

        Raises:
            CalibrationError: the dictionary is unknown.
        """
        import cv2

        number = getattr(cv2.aruco, self.dictionary, None)
        if number is None or not self.dictionary.startswith("DICT_"):
            raise CalibrationError(
                f"Unknown dictionary {self.dictionary!r}; such as DICT_4X4_50, DICT_5X5_100, DICT_6X6_250."
            )
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, dictionary)
        board.setLegacyPattern(self.legacy)
        return board

    @property
    def patterns(self) -> tuple[CharucoBoard, ...]:
        """All patterns with these dimensions; with an even number of rows, this includes the legacy pattern."""
        return (self,) if self.rows % 2 else (self, replace(self, legacy=not self.legacy))

    def corners(self) -> Floats:
        """Return inner corners [K, 3] in the board's frame: x right, y down, z into the board [m]."""
        return np.asarray(self.opencv().getChessboardCorners(), dtype=np.float64).reshape(-1, 3)

    def detect(self, color: NDArray[np.uint8]) -> tuple[NDArray[np.int64], Floats]:
        """Return (corner numbers [N], pixels [N, 2]) in an image [H, W, 3]; empty if the board is not detected. Corners
        on a single line are rejected, because they leave the rotation about the line undetermined."""
        import cv2

        detector = cv2.aruco.CharucoDetector(self.opencv())
        pixels, numbers, _, _ = detector.detectBoard(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY))
        if numbers is None or len(numbers) < FEWEST_CORNERS:
            return np.zeros(0, np.int64), np.zeros((0, 2))
        numbers = np.asarray(numbers, np.int64).reshape(-1)
        seen = self.corners()[numbers]
        across = float(np.linalg.svd(seen - seen.mean(axis=0), compute_uv=False)[1])
        if across < self.square_m / 2:  # even one corner beside a line exceeds this
            return np.zeros(0, np.int64), np.zeros((0, 2))
        return numbers, np.asarray(pixels, np.float64).reshape(-1, 2)


@dataclass(frozen=True)
class View:
    """Detection of the board by one camera at one gripper pose."""

    pose: int
    numbers: NDArray[np.int64]
    """[N] corner numbers."""
    pixels: Floats
    """[N, 2] corner positions."""
    depth_m: Floats | None = None
    """[N] depth measured at the corners; NaN if missing."""
    frame: int = -1
    """Index of the image, for pictures."""


@dataclass(frozen=True)
class CameraViews:
    """All views of one camera."""

    intrinsics: Intrinsics
    views: tuple[View, ...]

    def without(self, poses: set[int]) -> CameraViews:
        """Return the views without those of the given poses."""
        return CameraViews(self.intrinsics, tuple(view for view in self.views if view.pose not in poses))

    def only(self, poses: set[int]) -> CameraViews:
        """Return the views of the given poses."""
        return CameraViews(self.intrinsics, tuple(view for view in self.views if view.pose in poses))

    @cached_property
    def stacked(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
        """Poses [N], corner numbers [N] and pixels [N, 2] of all corners in all views."""
        poses = np.concatenate([np.full(len(view.numbers), view.pose) for view in self.views])
        numbers = np.concatenate([view.numbers for view in self.views])
        return poses, numbers, np.concatenate([view.pixels for view in self.views])


def board_in_camera(view: View, corners: Floats, intrinsics: Intrinsics) -> Floats:
    """Return T_camera_board [4, 4] from one view (perspective-n-point), with board corners [K, 3] [m]."""
    import cv2

    # undistort first, in the camera's own convention
    plane = np.ascontiguousarray(rays(view.pixels, intrinsics)[:, :2])
    done, turn, shift = cv2.solvePnP(corners[view.numbers], plane, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_ITERATIVE)
    if not done:
        raise CalibrationError("A board could not be placed from its corners.")
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(turn.ravel()).as_matrix(), shift.ravel()
    return matrix


def depth_at(depth: NDArray[np.uint16], pixels: Floats) -> Floats:
    """Return the median [N] of the valid depths in 3 x 3 pixels around `pixels` [N, 2]; NaN without any."""
    column, row = np.rint(pixels).astype(int).T
    offset = np.arange(-1, 2)
    rows = (row[:, None, None] + offset[:, None]).clip(0, depth.shape[0] - 1)
    columns = (column[:, None, None] + offset).clip(0, depth.shape[1] - 1)
    around = depth[rows, columns].reshape(len(pixels), -1).astype(np.float64)
    around[around == 0] = np.nan
    result = np.full(len(pixels), np.nan)
    some = np.isfinite(around).any(axis=1)
    result[some] = np.nanmedian(around[some], axis=1)
    return result
