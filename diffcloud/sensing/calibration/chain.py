"""Least-squares fit of the kinematic chain from the robot's base over gripper and board to pixels.

For corner X of the board, gripper pose i and camera c:

    pixel = project_c( inverse(T_world_camera_c) · T_world_gripper_i · T_gripper_board · s X )

Camera poses and board pose are fitted to reprojection errors with a robust loss (soft L1). The board's size s and each
camera's focal length are fixed at the entered values, or fitted too. The arm makes both identifiable, because it
measures how far the board moved.

The covariance is a jackknife over poses, with one Gauss–Newton step each (the sandwich estimator CR3 of Bell and
McCaffrey 2002). Kinematic errors of the robot move all corners of a pose together. Treating corners as independent
would underestimate the uncertainty strongly. With ten poses, even the plain sandwich estimator clustered by pose is too
small by half.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffcloud.errors import CalibrationError
from diffcloud.sensing.calibration.charuco import CameraViews
from diffcloud.sensing.cameras import inverse, project

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_ROBUST_PX = 1.0
_DIFFERENCE = 1e-6


@dataclass(frozen=True)
class Estimate:
    """Estimated ratio of the true value to an entered one."""

    value: float
    """True value divided by entered value."""
    deviation: float
    """Standard deviation of the ratio."""


@dataclass(frozen=True)
class Chain:
    """Result of the fit."""

    cameras: dict[str, Floats]
    """[4, 4] T_world_camera of each camera."""
    board: Floats
    """[4, 4] pose of the board on the gripper, T_gripper_board."""
    covariance: dict[str, Floats]
    """[6, 6] for each camera: translation [m] and rotation [rad], as left perturbations in the world."""
    board_size: Estimate | None = None
    """Estimated size ratio; None if the size was fixed."""
    focal_length: dict[str, Estimate] = field(default_factory=dict)
    """Estimated focal length ratio of each camera; empty if fixed."""


def fit_chain(
    cameras: Mapping[str, CameraViews],
    T_world_gripper: Floats,
    groups: Integers,
    corners: Floats,
    start: Mapping[str, Floats],
    board: Floats,
    *,
    sizes: bool = False,
) -> Chain:
    """Fit the poses of cameras and board.

    Args:
        T_world_gripper: [P, 4, 4] gripper poses.
        groups: [P] number of the distinct pose; the clusters of the covariance.
        corners: [K, 3] corners of the board as entered [m].
        start, board: initial poses of cameras and board.
        sizes: fit the board's size and the focal lengths too.

    Raises:
        CalibrationError: the fit does not converge.
    """
    from scipy.optimize import least_squares  # slow to import

    names = list(cameras)
    before = _Standing(cameras, T_world_gripper, corners, dict(start), board, np.ones(1 + len(names)) if sizes else None)
    fit = least_squares(
        before.errors,
        np.zeros(before.width),
        jac=before.jacobian,
        loss="soft_l1",
        f_scale=_ROBUST_PX,
        x_scale="jac",
        tr_solver="lsmr",  # the default SVD of such a tall matrix is slow
    )
    if not np.isfinite(fit.x).all():
        raise CalibrationError("The refinement did not converge; check that gripper poses and images belong together.")
    # the covariance refers to steps from the fitted poses, not from the start
    after, zero = before.after(fit.x), np.zeros(before.width)
    clusters = np.concatenate([np.repeat(groups[camera.stacked[0]], 2) for camera in cameras.values()])
    covariance = _clustered_covariance(after.errors(zero), after.jacobian(zero), clusters)
    blocks = {name: covariance[6 * index : 6 * index + 6, 6 * index : 6 * index + 6] for index, name in enumerate(names)}
    if after.factors is None:
        return Chain(after.placed, after.board, blocks)
    deviations = after.factors * np.sqrt(np.diag(covariance))[-len(after.factors) :]
    estimates = [Estimate(float(value), float(off)) for value, off in zip(after.factors, deviations, strict=True)]
    return Chain(after.placed, after.board, blocks, estimates[0], dict(zip(names, estimates[1:], strict=True)))


@dataclass(frozen=True)
class _Standing:
    """Current estimate of all poses, and the errors after a step from it. A step has 6 entries for each camera and 6
    for the board (translation, rotation vector). If sizes are fitted, it also has logarithms of the factors of the
    board's size and of each camera's focal length."""

    cameras: Mapping[str, CameraViews]
    T_world_gripper: Floats
    corners: Floats
    placed: dict[str, Floats]
    """T_world_camera of each camera."""
    board: Floats
    """Pose of the board on the gripper, T_gripper_board."""
    factors: Floats | None

    @property
    def width(self) -> int:
        return 6 * (len(self.cameras) + 1) + (0 if self.factors is None else len(self.factors))

    def errors(self, step: Floats) -> Floats:
        """Return reprojection errors [2 N] of all corners in all cameras [px]."""
        return np.concatenate([self._errors(name, step[self._columns(name)]) for name in self.cameras])

    def jacobian(self, step: Floats) -> Floats:
        """Return derivatives [2 N, width] by central differences, which are fast enough for so few parameters."""
        blocks = []
        for name in self.cameras:
            columns = self._columns(name)
            local = step[columns]
            derivatives = [
                (self._errors(name, local + change) - self._errors(name, local - change)) / (2 * _DIFFERENCE)
                for change in _DIFFERENCE * np.eye(len(columns))
            ]
            block = np.zeros((len(derivatives[0]), self.width))
            block[:, columns] = np.column_stack(derivatives)
            blocks.append(block)
        return np.concatenate(blocks)

    def after(self, step: Floats) -> _Standing:
        """Return the estimate after a step."""
        index = 6 * len(self.cameras)
        placed = {name: _moved(self.placed[name], step[self._columns(name)][:6]) for name in self.cameras}
        factors = None if self.factors is None else self.factors * np.exp(step[index + 6 :])
        return replace(self, placed=placed, board=_moved(self.board, step[index : index + 6]), factors=factors)

    def _columns(self, name: str) -> Integers:
        """Return the step entries that affect this camera's errors: camera, board, size, focal length."""
        index, count = list(self.cameras).index(name), len(self.cameras)
        board = 6 * count
        own = [*range(6 * index, 6 * index + 6), *range(board, board + 6)]
        return np.array(own if self.factors is None else [*own, board + 6, board + 7 + index])

    def _errors(self, name: str, step: Floats) -> Floats:
        poses, numbers, pixels = self.cameras[name].stacked
        intrinsics, size = self.cameras[name].intrinsics, 1.0
        if self.factors is not None:
            index = 1 + list(self.cameras).index(name)
            size, focal = self.factors[[0, index]] * np.exp(step[12:])
            intrinsics = replace(intrinsics, fx=float(intrinsics.fx * focal), fy=float(intrinsics.fy * focal))
        camera, board = _moved(self.placed[name], step[:6]), _moved(self.board, step[6:12])
        local = in_camera(camera, self.T_world_gripper, board, poses, size * self.corners[numbers])
        return (project(local, intrinsics) - pixels).ravel()


def in_camera(
    T_world_camera: Floats, T_world_gripper: Floats, T_gripper_board: Floats, poses: Integers, points: Floats
) -> Floats:
    """Transform board points [N, 3] to the camera's frame. `poses` [N] are indices of gripper poses [P, 4, 4]."""
    chain = (inverse(T_world_camera) @ T_world_gripper @ T_gripper_board)[poses]
    return np.einsum("nij,nj->ni", chain[:, :3, :3], points) + chain[:, :3, 3]


def _moved(matrix: Floats, step: Floats) -> Floats:
    """Apply a step [6] (translation, rotation vector) to a pose from the left: (t + dt, exp(dr) R)."""
    result = matrix.copy()
    result[:3, 3] += step[:3]
    result[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ matrix[:3, :3]
    return result


def _clustered_covariance(residual: Floats, jacobian: Floats, clusters: Integers) -> Floats:
    """Return the one-step jackknife covariance over clusters (CR3 sandwich) of robust least squares."""
    weight = 1 / np.sqrt(1 + (residual / _ROBUST_PX) ** 2)  # derivative of the loss
    information = jacobian.T @ (weight[:, None] * jacobian)
    names = np.unique(clusters)
    steps = []
    for name in names:
        own = clusters == name
        weighted = weight[own, None] * jacobian[own]
        # how far the fit would move without this cluster
        steps.append(np.linalg.pinv(information - jacobian[own].T @ weighted) @ (weighted.T @ residual[own]))
    stacked = np.array(steps)
    return (len(names) - 1) / len(names) * (stacked.T @ stacked)
