"""Calibration of fixed cameras with a ChArUco board on the gripper.

A hand-eye solution of each camera initialises a joint least-squares fit of all cameras and the board (`chain`). The
reported error comes from cross-validation: poses are left out in turn, the others are fitted from their own hand-eye
solution, and the errors at the left-out poses are collected in pixels and millimetres. The final fit uses all poses.
`checks` decides whether the result is usable.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from diffcloud.errors import CalibrationError
from diffcloud.io.raw_episodes import RawCamera, RobotLog
from diffcloud.sensing.calibration.chain import Chain, Estimate, fit_chain, in_camera
from diffcloud.sensing.calibration.charuco import FEWEST_CORNERS, CameraViews, CharucoBoard, View, board_in_camera, depth_at
from diffcloud.sensing.calibration.checks import (
    ADVISED_POSES,
    FEWEST_POSES,
    HELD_OUT_POSES,
    CameraEvidence,
    check_orientations,
    check_reach,
    judge_hand_eye,
)
from diffcloud.sensing.cameras import inverse, project, transform
from diffcloud.sensing.tool_poses import not_unit

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_FOLDS = 5
_SMALLEST_TURN_DEG = 10.0
_NEW_POSE_M, _NEW_POSE_RAD = 0.01, np.deg2rad(2.0)
_STILL_M, _STILL_RAD = 0.001, np.deg2rad(0.2)
_STILL_WINDOW_S = 0.1


@dataclass(frozen=True)
class HandEyeResult:
    """Poses of cameras and board, with quality figures."""

    T_world_camera: Mapping[str, Floats]
    T_gripper_board: Floats
    covariance: Mapping[str, Floats]
    """[6, 6] for each camera: translation [m] and rotation [rad], as left perturbations in the world."""
    residuals: Mapping[str, Mapping[str, float]]
    """Quality figures of each camera. rms_px and rms_mm are errors at held_out_poses held-out poses (missing if there
    are none). rms_fit_px and rms_fit_mm are those of the fit. poses is their number. focal_scale is the focal length
    according to the arm divided by the entered one. depth_scale is measured depth divided by that of the entered board,
    if there is depth."""
    board_size: Estimate
    """Size of the board according to the arm, divided by the entered one."""
    warnings: tuple[str, ...] = ()
    objections: tuple[str, ...] = ()
    """Reasons not to use this calibration; empty for a good one."""


def find_views(
    cameras: Mapping[str, RawCamera], robot: RobotLog, board: CharucoBoard
) -> tuple[dict[str, CameraViews], Floats]:
    """Detect the board in the still frames of a raw episode, once per gripper pose and camera.

    If the board may have one of two patterns, the one with more corners in all images is chosen. A few markers may be
    mistaken for those of the other pattern, but not many.

    Returns:
        Views by camera, and the gripper poses [P, 4, 4] to which they refer.

    Raises:
        CalibrationError: the joint log lacks tool poses or has wrong units, or a camera has no colour images.
    """
    check_reach(robot.tool_position_m)
    if not all(np.isfinite(column).all(axis=1).any() for column in (robot.tool_position_m, robot.tool_quaternion)):
        raise CalibrationError(
            "robot.csv has no poses of the tool (tool_x..z and tool_qw..qz): where the board was is not known. Record "
            "them, or import with the tool's frame in tf (--tool-frame)."
        )
    wrong = not_unit(robot.tool_quaternion)
    if wrong is not None:
        raise CalibrationError(wrong)
    candidates = [_detected(cameras, robot, pattern) for pattern in board.patterns]
    return max(candidates, key=lambda one: sum(len(view.numbers) for held in one[0].values() for view in held.views))


def _detected(
    cameras: Mapping[str, RawCamera], robot: RobotLog, board: CharucoBoard
) -> tuple[dict[str, CameraViews], Floats]:
    """Detect the board like `find_views`, but only in the pattern of `board`."""
    found: dict[str, CameraViews] = {}
    poses: list[Floats] = []
    for name, camera in cameras.items():
        views: list[View] = []
        colorless = 0
        for index, t in enumerate(camera.times):  # images come one after the other; corners are vectorised
            pose = still_pose(robot, float(t))
            if pose is None or (views and _same_pose(pose, poses[-1][None])[0]):
                continue
            color = camera.color(index)
            if color is None:
                colorless += 1
                continue
            numbers, pixels = board.detect(color)
            if len(numbers):
                depth = depth_at(camera.depth(index), pixels) * camera.info.depth_scale_m
                views.append(View(len(poses), numbers, pixels, depth, index))
                poses.append(pose)
        if colorless and not views:
            raise CalibrationError(
                f"Camera {name} has no colour images, in which the board would be found. Record colour, aligned to depth."
            )
        found[name] = CameraViews(camera.info.intrinsics, tuple(views))
    return found, np.array(poses).reshape(-1, 4, 4)


def still_pose(robot: RobotLog, t_s: float) -> Floats | None:
    """Return the interpolated gripper pose [4, 4] at a time; None while it moves or outside the log."""
    around = np.array([t_s - _STILL_WINDOW_S, t_s, t_s + _STILL_WINDOW_S])
    known = np.isfinite(robot.tool_position_m).all(axis=1) & np.isfinite(robot.tool_quaternion).all(axis=1)
    times = robot.times[known]
    if len(times) < 2 or not times[0] <= t_s <= times[-1]:
        return None
    around = around.clip(times[0], times[-1])
    position = np.column_stack([np.interp(around, times, robot.tool_position_m[known, axis]) for axis in range(3)])
    turned = Slerp(times, Rotation.from_quat(np.roll(robot.tool_quaternion[known], -1, axis=1)))(around)
    if np.ptp(position, axis=0).max() > _STILL_M or (turned[0].inv() * turned[2]).magnitude() > _STILL_RAD:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turned[1].as_matrix(), position[1]
    return pose


def calibrate_hand_eye(cameras: Mapping[str, CameraViews], T_world_gripper: Floats, board: CharucoBoard) -> HandEyeResult:
    """Calibrate all cameras and the board.

    Args:
        T_world_gripper: [P, 4, 4] gripper poses to which the views refer.

    Raises:
        CalibrationError: there are too few poses, the gripper did not rotate about two axes, or units are wrong. States
            what to record.
    """
    check_reach(T_world_gripper[:, :3, 3])
    groups = _pose_groups(T_world_gripper)
    for name, camera in cameras.items():
        _check_poses(name, camera, T_world_gripper, groups)
    corners = board.corners()
    check_orientations(cameras, T_world_gripper, corners)
    final = _fitted(cameras, T_world_gripper, groups, corners)
    sized = fit_chain(cameras, T_world_gripper, groups, corners, final.cameras, final.board, sizes=True)
    held_out = _held_out(cameras, T_world_gripper, groups, corners)
    evidence = {}
    for name, camera in cameras.items():
        fit_px, fit_mm = _errors(camera, T_world_gripper, corners, final.cameras[name], final.board)
        pixel, millimetre, count = held_out[name]
        evidence[name] = CameraEvidence(
            poses=_count(camera, groups),
            held_out_poses=count,
            rms_px=_rms(pixel) if count else None,
            rms_mm=_rms(millimetre) if count else None,
            rms_fit_px=_rms(fit_px),
            rms_fit_mm=_rms(fit_mm),
            focal_px=camera.intrinsics.fx,
            focal=sized.focal_length[name],
            depth_ratio=_depth_ratio(camera, corners),
        )
    assert sized.board_size is not None  # it was fitted
    warnings, objections = judge_hand_eye(evidence, sized.board_size, square_m=board.square_m)
    residuals = {name: camera.residuals() for name, camera in evidence.items()}
    return HandEyeResult(
        final.cameras, final.board, final.covariance, residuals, sized.board_size, tuple(warnings), tuple(objections)
    )


def _fitted(cameras: Mapping[str, CameraViews], T_world_gripper: Floats, groups: Integers, corners: Floats) -> Chain:
    """Fit the chain, starting from the hand-eye solution of the same views."""
    start = {name: _hand_eye(camera, T_world_gripper, corners) for name, camera in cameras.items()}
    first = next(iter(cameras))
    board = _board_on_gripper(cameras[first], T_world_gripper, corners, start[first])
    return fit_chain(cameras, T_world_gripper, groups, corners, start, board)


def _held_out(
    cameras: Mapping[str, CameraViews], T_world_gripper: Floats, groups: Integers, corners: Floats
) -> dict[str, tuple[Floats, Floats, int]]:
    """Return errors [N] in pixels and millimetres at held-out poses, and the number of these poses, for each camera. A
    pose is held out for all cameras at once, together with repeated visits. Folds are balanced, so that each camera
    loses about the same number of poses. If there are few poses, each is left out separately."""
    seen = {name: {int(groups[view.pose]) for view in camera.views} for name, camera in cameras.items()}
    order = sorted(set().union(*seen.values()), key=lambda group: ([group in held for held in seen.values()], group))
    count = _FOLDS if len(order) >= HELD_OUT_POSES else len(order)
    found: dict[str, list[tuple[Floats, Floats]]] = {name: [] for name in cameras}
    poses = dict.fromkeys(cameras, 0)
    for fold in range(count):
        left_out = set(order[fold::count])
        views = {int(pose) for pose in np.flatnonzero(np.isin(groups, list(left_out)))}
        try:
            chain = _fitted(
                {name: camera.without(views) for name, camera in cameras.items()}, T_world_gripper, groups, corners
            )
        except CalibrationError:
            continue  # these poses have no error, and are not counted
        for name, camera in cameras.items():
            test = camera.only(views)
            if test.views:
                found[name].append(_errors(test, T_world_gripper, corners, chain.cameras[name], chain.board))
                poses[name] += _count(test, groups)
    empty = [(np.zeros(0), np.zeros(0))]
    joined = {name: [np.concatenate(part) for part in zip(*(found[name] or empty), strict=True)] for name in cameras}
    return {name: (joined[name][0], joined[name][1], poses[name]) for name in cameras}


def _hand_eye(camera: CameraViews, T_world_gripper: Floats, corners: Floats) -> Floats:
    """Return T_world_camera [4, 4] of one camera by the method of Park and Martin. OpenCV solves for a camera on the
    gripper. Here the camera is fixed and the board moves. So the inverted gripper poses are passed, and the result is
    the camera in the base frame."""
    import cv2

    if len(camera.views) < 3:
        raise CalibrationError(f"A hand-eye solution needs three poses, got {len(camera.views)}.")
    boards = np.stack([board_in_camera(view, corners, camera.intrinsics) for view in camera.views])
    inverted = inverse(T_world_gripper[[view.pose for view in camera.views]])
    rotation, translation = cv2.calibrateHandEye(
        R_gripper2base=list(inverted[:, :3, :3]),
        t_gripper2base=list(inverted[:, :3, 3]),
        R_target2cam=list(boards[:, :3, :3]),
        t_target2cam=list(boards[:, :3, 3]),
        method=cv2.CALIB_HAND_EYE_PARK,
    )
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, np.asarray(translation).ravel()
    # contradictory poses may also give a reflection
    if not np.isfinite(matrix).all() or np.linalg.det(matrix[:3, :3]) < 0.5:
        raise CalibrationError("The hand-eye start failed: turn the gripper about two axes by 20 degrees and more.")
    return matrix


def _board_on_gripper(camera: CameraViews, T_world_gripper: Floats, corners: Floats, T_world_camera: Floats) -> Floats:
    """Return T_gripper_board [4, 4], averaged over the views."""
    chains = np.stack(
        [
            inverse(T_world_gripper[view.pose]) @ T_world_camera @ board_in_camera(view, corners, camera.intrinsics)
            for view in camera.views
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_matrix(chains[:, :3, :3]).mean().as_matrix()
    matrix[:3, 3] = np.median(chains[:, :3, 3], axis=0)
    return matrix


def _errors(
    camera: CameraViews, T_world_gripper: Floats, corners: Floats, T_world_camera: Floats, T_gripper_board: Floats
) -> tuple[Floats, Floats]:
    """Return reprojection errors [N] in pixels, and position errors [N] in millimetres. A position error is the
    distance between a corner from the view's own board pose and from the robot's chain."""
    poses, numbers, pixels = camera.stacked
    local = in_camera(T_world_camera, T_world_gripper, T_gripper_board, poses, corners[numbers])
    off = np.linalg.norm(project(local, camera.intrinsics) - pixels, axis=1)
    own = np.concatenate(
        [transform(board_in_camera(view, corners, camera.intrinsics), corners[view.numbers]) for view in camera.views]
    )
    return off, 1000 * np.linalg.norm(own - local, axis=1)


def _depth_ratio(camera: CameraViews, corners: Floats) -> float | None:
    """Return measured depth divided by that of the entered board in each view, median; None without depth."""
    ratios = []
    for view in camera.views:
        if view.depth_m is not None:
            expected = transform(board_in_camera(view, corners, camera.intrinsics), corners[view.numbers])[:, 2]
            known = np.isfinite(view.depth_m) & (view.depth_m > 0)
            ratios.append(view.depth_m[known] / expected[known])
    joined = np.concatenate(ratios) if ratios else np.zeros(0)
    return float(np.median(joined)) if len(joined) >= FEWEST_CORNERS else None


def _check_poses(name: str, camera: CameraViews, T_world_gripper: Floats, groups: Integers) -> None:
    count = _count(camera, groups)
    if count < FEWEST_POSES:
        raise CalibrationError(
            f"Camera {name} saw the board at {count} still poses; at least {FEWEST_POSES} are needed and "
            f"{ADVISED_POSES} advised. Hold the gripper still for half a second at each pose, the whole board in view, "
            "and check squares, marker size and dictionary."
        )
    rotations = Rotation.from_matrix(T_world_gripper[[view.pose for view in camera.views], :3, :3])
    turns = np.rad2deg((rotations * rotations[0].inv()).as_rotvec())
    # the second singular value is the rotation about axes other than the main one
    spread = np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(turns))
    if spread[1] < _SMALLEST_TURN_DEG / 2:
        raise CalibrationError(
            f"For camera {name} the gripper turned by {spread[0]:.0f} degrees about one axis and only {spread[1]:.1f} "
            "about another: the camera's position along the first cannot be found. Tilt the board about two axes by "
            "20 degrees and more."
        )


def _pose_groups(T_world_gripper: Floats) -> Integers:
    """Return the number [P] of the first equal pose for each pose. Repeated visits, and images of other cameras at the
    same stop, are the same pose. They must be held out together."""
    groups = np.full(len(T_world_gripper), -1)
    for index, pose in enumerate(T_world_gripper):
        if groups[index] < 0:
            groups[(groups < 0) & _same_pose(pose, T_world_gripper)] = index
    return groups


def _same_pose(pose: Floats, others: Floats) -> NDArray[np.bool_]:
    """Return whether each of `others` [N, 4, 4] is nearly equal to `pose`, bool [N]."""
    between = inverse(pose) @ others
    turned = Rotation.from_matrix(between[:, :3, :3]).magnitude()
    return (np.linalg.norm(between[:, :3, 3], axis=1) <= _NEW_POSE_M) & (turned <= _NEW_POSE_RAD)


def _count(camera: CameraViews, groups: Integers) -> int:
    return len({int(groups[view.pose]) for view in camera.views})


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else 0.0
