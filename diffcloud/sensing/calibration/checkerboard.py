"""Registration of a camera with a checkerboard whose corners are known in the robot's frame: the paper's method.

The camera's corner points come from its depth image. Their depth is noisy, so z is first replaced by the least-squares
plane z = a x + b y + c. (Vertical instead of orthogonal distances, like the published calibration.) The rigid transform
to the robot's points then follows in closed form (Kabsch 1976).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import CalibrationError
from diffcloud.sensing.calibration.checks import CheckerboardEvidence
from diffcloud.sensing.cameras import transform

Floats = NDArray[np.float64]

_STRIPS = 5
_FEWEST_HELD_OUT = 9
"""Minimum number of corners for held-out errors: three along each side."""


@dataclass(frozen=True)
class Registration:
    """Result of a registration."""

    T_world_camera: Floats
    """[4, 4] transform from the camera to the robot's base frame [m]."""
    residual_m: Floats
    """[N] distances of the transformed plane points to the robot's corners."""
    scale: float
    """Size of the robot's board divided by that in the camera; 1 is correct. The transform does not include it."""

    @property
    def rms_m(self) -> float:
        return float(np.sqrt((self.residual_m**2).mean()))


def register_checkerboard(camera_points: Floats, robot_points: Floats) -> Registration:
    """Return the pose of a camera from corners in its frame and the same corners in the robot's frame.

    Args:
        camera_points: [N, 3] in the camera's frame [m].
        robot_points: [N, 3] in the base frame [m], in the same order.

    Raises:
        CalibrationError: shapes differ, there are fewer than 4 corners, corners are collinear, or values are not
            finite.
    """
    if camera_points.shape != robot_points.shape or camera_points.ndim != 2 or camera_points.shape[1] != 3:
        raise CalibrationError(
            f"Camera and robot must give the same corners [N, 3], got {list(camera_points.shape)} and "
            f"{list(robot_points.shape)}."
        )
    if len(camera_points) < 4:
        raise CalibrationError(f"A registration needs at least 4 corners, got {len(camera_points)}.")
    if not (np.isfinite(camera_points).all() and np.isfinite(robot_points).all()):
        raise CalibrationError("A corner is NaN or infinite: depth was missing there. Leave such corners out.")
    if np.abs(camera_points).max() > 20 or np.abs(robot_points).max() > 20:
        raise CalibrationError("A corner is more than 20 m away: these are millimetres; divide by 1000.")
    flat = onto_plane(camera_points)
    matrix = rigid_motion(flat, robot_points)
    residual = np.linalg.norm(transform(matrix, flat) - robot_points, axis=1)
    spread = [np.linalg.norm(points - points.mean(axis=0)) for points in (robot_points, flat)]
    return Registration(matrix, residual, float(spread[0] / spread[1]))


def checkerboard_evidence(found: Registration, camera_points: Floats, robot_points: Floats) -> CheckerboardEvidence:
    """Return quality figures of a registration, from the points it was computed with."""
    held_out = held_out_errors(camera_points, robot_points)
    apart = np.linalg.norm(robot_points[:, None] - robot_points, axis=-1) + np.diag(np.full(len(robot_points), np.inf))
    return CheckerboardEvidence(
        corners=len(camera_points),
        held_out_corners=0 if held_out is None else len(camera_points),
        held_out_mm=None if held_out is None else 1000 * float(np.sqrt((held_out**2).mean())),
        size_ratio=1 / found.scale,
        pitch_m=float(np.median(apart.min(axis=1))),
    )


def held_out_errors(camera_points: Floats, robot_points: Floats) -> Floats | None:
    """Return distances [M] [m] of left-out corners to their positions from a registration with the others.

    Corners are left out in strips across the board, along both axes. They are transformed as in the published method,
    at the depth of the plane through the others. Strips are used because errors of nearby corners are correlated.
    Errors that all corners share, such as the board's position under the robot, do not appear here.

    Args:
        camera_points, robot_points: see `register_checkerboard`.

    Returns:
        None for fewer than 9 corners.
    """
    if len(camera_points) < _FEWEST_HELD_OUT:
        return None
    centred = robot_points - robot_points.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2][:2]
    everything = np.arange(len(camera_points))
    errors = []
    for axis in axes:
        for strip in np.array_split(np.argsort(centred @ axis, kind="stable"), _STRIPS):
            rest = np.setdiff1d(everything, strip)
            coefficients = _plane(camera_points[rest])
            matrix = rigid_motion(_at_depth(camera_points[rest], coefficients), robot_points[rest])
            placed = transform(matrix, _at_depth(camera_points[strip], coefficients))
            errors.append(np.linalg.norm(placed - robot_points[strip], axis=1))
    return np.concatenate(errors)


def onto_plane(points: Floats) -> Floats:
    """Return points [N, 3] with z replaced by their least-squares plane z = a x + b y + c."""
    return _at_depth(points, _plane(points))


def rigid_motion(source: Floats, target: Floats) -> Floats:
    """Return the rigid transform [4, 4] that best maps `source` [N, 3] to `target` [N, 3], in closed form."""
    centres = source.mean(axis=0), target.mean(axis=0)
    u, singular, vt = np.linalg.svd((source - centres[0]).T @ (target - centres[1]))
    if singular[1] < 1e-9 * singular[0]:
        raise CalibrationError("The corners lie on a line; a rotation about it cannot be found.")
    handed = np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
    matrix = np.eye(4)
    matrix[:3, :3] = vt.T @ handed @ u.T
    matrix[:3, 3] = centres[1] - matrix[:3, :3] @ centres[0]
    return matrix


def _plane(points: Floats) -> Floats:
    """Return (a, b, c) of the least-squares plane z = a x + b y + c."""
    design = np.column_stack([points[:, :2], np.ones(len(points))])
    coefficients, _, rank, _ = np.linalg.lstsq(design, points[:, 2], rcond=None)
    if rank < 3:
        raise CalibrationError("The corners lie on a line in the image; a plane needs a grid.")
    return np.asarray(coefficients)


def _at_depth(points: Floats, coefficients: Floats) -> Floats:
    return np.column_stack([points[:, :2], np.column_stack([points[:, :2], np.ones(len(points))]) @ coefficients])
