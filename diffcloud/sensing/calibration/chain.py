"""The chain from the robot's base over gripper and board to pixels, and its least-squares fit.

For corner X of the board, gripper pose i and camera c:

    pixel = project_c( inverse(T_world_camera_c) · T_world_gripper_i · T_gripper_board · s X )

Cameras and board are fitted on reprojection errors with a robust loss (soft L1). The board's size s and each camera's
focal length are taken as entered, or fitted too: the arm measures both, since it says how far the board has moved.
Across the image, that distance over the board's size is what the image shows, whatever the focal length; along the view,
the focal length is what fits.

The covariance is a jackknife over poses (one Gauss-Newton step each; the sandwich estimator CR3 of Bell and McCaffrey
2002): errors of the robot's own kinematics move all corners of a pose together, so counting corners as independent would be
far too sure. The plain sandwich clustered by pose is still too sure by half with ten poses.
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
    """A fitted factor of something that was entered."""

    value: float
    """True over entered: 1 where it was entered right."""
    deviation: float
    """Standard deviation."""


@dataclass(frozen=True)
class Chain:
    """A fitted chain."""

    cameras: dict[str, Floats]
    """[4, 4] T_world_camera by camera."""
    board: Floats
    """[4, 4] T_gripper_board."""
    covariance: dict[str, Floats]
    """[6, 6] by camera: translation [m], rotation [rad], on the world's side."""
    board_size: Estimate | None = None
    """None where the size was taken as entered."""
    focal_length: dict[str, Estimate] = field(default_factory=dict)
    """By camera, likewise."""


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
    """Fit cameras and board.

    Args:
        T_world_gripper: [P, 4, 4].
        groups: [P] which poses are one and the same; the clusters of the covariance.
        corners: [K, 3] of the board as entered [m].
        start, board: where to begin.
        sizes: fit the board's size and the focal lengths too.

    Raises:
        CalibrationError: it does not converge.
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
        tr_solver="lsmr",  # the default's SVD of so tall a matrix spends its time on threads
    )
    if not np.isfinite(fit.x).all():
        raise CalibrationError("The refinement did not converge; check that gripper poses and images belong together.")
    # the covariance is that of steps from the fitted poses, not from the start
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
    """Where everything stands, and what steps from there do to the errors.

    A step has 6 entries for each camera and 6 for the board (translation, rotation vector), then logarithms of the factors,
    if there are any: one for the board's size and one for each camera's focal length.
    """

    cameras: Mapping[str, CameraViews]
    T_world_gripper: Floats
    corners: Floats
    placed: dict[str, Floats]
    """T_world_camera."""
    board: Floats
    """T_gripper_board."""
    factors: Floats | None

    @property
    def width(self) -> int:
        return 6 * (len(self.cameras) + 1) + (0 if self.factors is None else len(self.factors))

    def errors(self, step: Floats) -> Floats:
        """[2 N] reprojection errors of all corners that all cameras saw [px]."""
        return np.concatenate([self._errors(name, step[self._columns(name)]) for name in self.cameras])

    def jacobian(self, step: Floats) -> Floats:
        """[2 N, width] by central differences: a handful of parameters and a cheap chain do not repay formulas."""
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
        """Where everything stands after a step."""
        index = 6 * len(self.cameras)
        placed = {name: _moved(self.placed[name], step[self._columns(name)][:6]) for name in self.cameras}
        factors = None if self.factors is None else self.factors * np.exp(step[index + 6 :])
        return replace(self, placed=placed, board=_moved(self.board, step[index : index + 6]), factors=factors)

    def _columns(self, name: str) -> Integers:
        """Entries of a step that this camera's errors depend on: camera, board, size, focal length."""
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
    """Board points [N, 3], each at one of the gripper poses [P, 4, 4] (`poses` [N]), in the camera's frame."""
    chain = (inverse(T_world_camera) @ T_world_gripper @ T_gripper_board)[poses]
    return np.einsum("nij,nj->ni", chain[:, :3, :3], points) + chain[:, :3, 3]


def _moved(matrix: Floats, step: Floats) -> Floats:
    """A pose after a step [6] (translation, rotation vector) on the left of each: (t + dt, exp(dr) R)."""
    result = matrix.copy()
    result[:3, 3] += step[:3]
    result[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ matrix[:3, :3]
    return result


def _clustered_covariance(residual: Floats, jacobian: Floats, clusters: Integers) -> Floats:
    """One-step jackknife over clusters (the CR3 sandwich) of robust least squares."""
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
