"""Projection of a pinhole camera with Brown–Conrady distortion, or of a fisheye camera.

The camera's frame is OpenCV's: x right, y down, z forward, with pixel centres at whole numbers. There are two
conventions for the same polynomial. OpenCV's `brown_conrady` maps ideal to distorted coordinates, and librealsense's
`inverse_brown_conrady` maps distorted to ideal ones. One direction is in closed form, the other uses fixed-point
iteration. OpenCV's `equidistant` is a polynomial from ideal to distorted angles to the optical axis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from diffcloud.io.camera_models import Intrinsics

Floats = NDArray[np.float64]

_ITERATIONS = 30
"""Number of fixed-point iterations. Lenses of depth cameras converge to 1e-12 px in about ten."""


_WIDEST_RAD, _LEAST_SLOPE = np.deg2rad(89.9), 1e-3
"""Fisheye limits: rays stay in front of the camera, and Newton steps are finite for a flat polynomial."""


def project(points: Floats, intrinsics: Intrinsics) -> Floats:
    """Project camera points [..., 3] [m] to pixels [..., 2] (column, row)."""
    ideal = points[..., :2] / points[..., 2:]
    if intrinsics.distortion == "brown_conrady":
        ideal = _polynomial(ideal, intrinsics.coefficients)
    elif intrinsics.distortion == "inverse_brown_conrady":
        ideal = _invert(ideal, intrinsics.coefficients)
    elif intrinsics.distortion == "equidistant":
        ideal = _fisheye(ideal, intrinsics.coefficients)
    return ideal * [intrinsics.fx, intrinsics.fy] + [intrinsics.cx, intrinsics.cy]


def rays(pixels: Floats, intrinsics: Intrinsics) -> Floats:
    """Return rays [..., 3] with z = 1 through pixels [..., 2]. Multiplied by depth they are camera points."""
    plane = (pixels - [intrinsics.cx, intrinsics.cy]) / [intrinsics.fx, intrinsics.fy]
    if intrinsics.distortion == "brown_conrady":
        plane = _invert(plane, intrinsics.coefficients)
    elif intrinsics.distortion == "inverse_brown_conrady":
        plane = _polynomial(plane, intrinsics.coefficients)
    elif intrinsics.distortion == "equidistant":
        plane = _unfisheye(plane, intrinsics.coefficients)
    return np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1)


def depth_points(
    depth: NDArray[np.uint16], intrinsics: Intrinsics, depth_scale_m: float, *, step: int = 1
) -> tuple[Floats, NDArray[np.int64]]:
    """Return camera points [P, 3] [m] and pixels [P, 2] of every `step`-th valid pixel of a depth image [H, W]."""
    row, column = np.nonzero(depth[::step, ::step])
    pixels = np.column_stack([column, row]) * step
    z = depth[pixels[:, 1], pixels[:, 0]] * depth_scale_m
    return rays(pixels.astype(np.float64), intrinsics) * z[:, None], pixels


def transform(matrix: Floats, points: Floats) -> Floats:
    """Apply rigid transforms [..., 4, 4] to points [..., P, 3]."""
    moved = rotate(matrix, points)
    for axis in range(3):  # numpy is slow where the last axis is short
        moved[..., axis] += matrix[..., None, axis, 3]
    return moved


def rotate(matrix: Floats, vectors: Floats) -> Floats:
    """Rotate directions [..., P, 3] by rigid transforms [..., 4, 4]."""
    rotated: Floats = vectors @ np.ascontiguousarray(np.swapaxes(matrix[..., :3, :3], -1, -2))  # for BLAS
    return rotated


def looking_at(position: ArrayLike, target: ArrayLike) -> Floats:
    """Return T_world_camera [4, 4] of an upright camera at `position` [3] that looks at `target` [3] [m]."""
    forward = np.subtract(target, position)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(right) < 1e-6 else right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = position
    return pose


def inverse(matrix: Floats) -> Floats:
    """Invert rigid transforms [..., 4, 4]."""
    result = np.zeros_like(matrix)
    rotation = np.swapaxes(matrix[..., :3, :3], -1, -2)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -(rotation @ matrix[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def _polynomial(xy: Floats, coefficients: tuple[float, ...]) -> Floats:
    if not any(coefficients):
        return xy
    radial, tangential = _terms(xy, coefficients)
    return _through(_tilt(coefficients), xy * radial + tangential)


def _invert(target: Floats, coefficients: tuple[float, ...]) -> Floats:
    if not any(coefficients):
        return target
    target = _through(np.asarray(np.linalg.inv(_tilt(coefficients)), np.float64), target)
    xy = target
    for _ in range(_ITERATIONS):
        radial, tangential = _terms(xy, coefficients)
        xy = (target - tangential) / radial
    return xy


def _terms(xy: Floats, coefficients: tuple[float, ...]) -> tuple[Floats, Floats]:
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = (*coefficients, *[0.0] * 7)[:12]
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    tangential = np.stack(
        [
            2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2),
            p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4),
        ],
        axis=-1,
    )
    return radial[..., None], tangential


def _tilt(coefficients: tuple[float, ...]) -> Floats:
    """Return the homography [3, 3] to a sensor tilted about x, then y (OpenCV's tau_x, tau_y [rad])."""
    x, y = coefficients[12:14] or (0.0, 0.0)
    turn = Rotation.from_euler("xy", [-x, -y]).as_matrix()
    onto = np.array([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, 1]])
    return np.asarray(onto @ turn)


def _through(homography: Floats, xy: Floats) -> Floats:
    if np.array_equal(homography, np.eye(3)):
        return xy
    moved = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1) @ homography.T
    return np.asarray(moved[..., :2] / moved[..., 2:])


def _fisheye(xy: Floats, coefficients: tuple[float, ...]) -> Floats:
    radius = np.linalg.norm(xy, axis=-1, keepdims=True)
    angle = np.arctan(radius)
    return np.asarray(xy * np.where(radius > 0, _bent(angle, coefficients) / np.where(radius > 0, radius, 1), 1))


def _unfisheye(xy: Floats, coefficients: tuple[float, ...]) -> Floats:
    bent = np.linalg.norm(xy, axis=-1, keepdims=True)
    angle = bent.clip(0, _WIDEST_RAD)
    for _ in range(_ITERATIONS):  # Newton's method
        angle = (angle - (_bent(angle, coefficients) - bent) / _slope(angle, coefficients)).clip(0, _WIDEST_RAD)
    return np.asarray(xy * np.where(bent > 0, np.tan(angle) / np.where(bent > 0, bent, 1), 1))


def _bent(angle: Floats, coefficients: tuple[float, ...]) -> Floats:
    k1, k2, k3, k4 = (*coefficients, *[0.0] * 4)[:4]
    squared = angle * angle
    return np.asarray(angle * (1 + squared * (k1 + squared * (k2 + squared * (k3 + squared * k4)))))


def _slope(angle: Floats, coefficients: tuple[float, ...]) -> Floats:
    k1, k2, k3, k4 = (*coefficients, *[0.0] * 4)[:4]
    squared = angle * angle
    slope = 1 + squared * (3 * k1 + squared * (5 * k2 + squared * (7 * k3 + squared * 9 * k4)))
    return np.asarray(np.where(slope > _LEAST_SLOPE, slope, _LEAST_SLOPE))
