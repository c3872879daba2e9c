"""Calibrating fixed cameras with a ChArUco board on the gripper.

A hand-eye solution of each camera alone starts a joint least-squares fit of all cameras and the one board
(`chain`). The error that is stated is held out: poses are left out in turn, the rest is fitted from its own start,
and what that fit says of the poses left out, in pixels and in millimetres, is the number to believe. Then all poses are
used. `checks` says whether the result may be used.
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
    """Cameras and board."""

    T_world_camera: Mapping[str, Floats]
    T_gripper_board: Floats
    covariance: Mapping[str, Floats]
    """[6, 6] by camera: translation [m], rotation [rad], on the world's side."""
    residuals: Mapping[str, Mapping[str, float]]
    """By camera: rms_px and rms_mm on held-out poses and how many those are (held_out_poses; without any, neither rms is
    there), rms_fit_px and rms_fit_mm of the fit itself, poses, focal_scale (its focal length by the arm over the entered
    one), and depth_scale (measured depth over that of the board as entered) where depth was there."""
    board_size: Estimate
    """The board's size by the arm over the entered one."""
    warnings: tuple[str, ...] = ()
    objections: tuple[str, ...] = ()
    """Why this calibration is not to be used; empty for a good one."""


def find_views(
    cameras: Mapping[str, RawCamera], robot: RobotLog, board: CharucoBoard
) -> tuple[dict[str, CameraViews], Floats]:
    """Detections in the still frames of a raw episode, one per gripper pose and camera.

    Where the board may have been printed in two patterns, the one with more corners in all images together is taken: few
    markers of one pattern can be mistaken for the other, many cannot.

    Returns:
        Views by camera, and the gripper poses [P, 4, 4] that they number.

    Raises:
        CalibrationError: a joint log without tool poses or in other units, or a camera without colour images.
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
    """Detect the board as `find_views` does, but in one pattern only: that of `board`."""
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
    """[4, 4] of the gripper at a time, interpolated; None while it moves or where the log does not reach."""
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
    """Place all cameras and the board.

    Args:
        T_world_gripper: [P, 4, 4] gripper poses, which the views number.

    Raises:
        CalibrationError: too few poses, the gripper did not turn about two axes, or its poses are in other units; says what
            to record.
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
    """From the hand-eye solution of the same views alone."""
    start = {name: _hand_eye(camera, T_world_gripper, corners) for name, camera in cameras.items()}
    first = next(iter(cameras))
    board = _board_on_gripper(cameras[first], T_world_gripper, corners, start[first])
    return fit_chain(cameras, T_world_gripper, groups, corners, start, board)


def _held_out(
    cameras: Mapping[str, CameraViews], T_world_gripper: Floats, groups: Integers, corners: Floats
) -> dict[str, tuple[Floats, Floats, int]]:
    """By camera, errors [N] in pixels and millimetres at poses that the fit had not seen, and how many poses.

    A pose is held out for all cameras at once, with every other visit to it. Folds are dealt so that each camera loses its
    poses evenly. Too few poses for folds are left out one by one.
    """
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
            continue  # these poses stay without a figure, and the count says so
        for name, camera in cameras.items():
            test = camera.only(views)
            if test.views:
                found[name].append(_errors(test, T_world_gripper, corners, chain.cameras[name], chain.board))
                poses[name] += _count(test, groups)
    empty = [(np.zeros(0), np.zeros(0))]
    joined = {name: [np.concatenate(part) for part in zip(*(found[name] or empty), strict=True)] for name in cameras}
    return {name: (joined[name][0], joined[name][1], poses[name]) for name in cameras}


def _hand_eye(camera: CameraViews, T_world_gripper: Floats, corners: Floats) -> Floats:
    """[4, 4] T_world_camera of one camera, by Park and Martin's method.

    OpenCV solves for a camera on the gripper. Here the camera stands and the board moves, so the inverted gripper poses go
    in and the camera in the base frame comes out.
    """
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
    # where the poses contradict each other it may also come out as a mirror image
    if not np.isfinite(matrix).all() or np.linalg.det(matrix[:3, :3]) < 0.5:
        raise CalibrationError("The hand-eye start failed: turn the gripper about two axes by 20 degrees and more.")
    return matrix


def _board_on_gripper(camera: CameraViews, T_world_gripper: Floats, corners: Floats, T_world_camera: Floats) -> Floats:
    """[4, 4] mean over the views."""
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
    """Reprojection [N] in pixels, and in millimetres the distance [N] between corners where the camera alone puts them
    (from the view's own board pose) and where the robot does."""
    poses, numbers, pixels = camera.stacked
    local = in_camera(T_world_camera, T_world_gripper, T_gripper_board, poses, corners[numbers])
    off = np.linalg.norm(project(local, camera.intrinsics) - pixels, axis=1)
    own = np.concatenate(
        [transform(board_in_camera(view, corners, camera.intrinsics), corners[view.numbers]) for view in camera.views]
    )
    return off, 1000 * np.linalg.norm(own - local, axis=1)


def _depth_ratio(camera: CameraViews, corners: Floats) -> float | None:
    """Measured depth over that of the board as entered, by each view alone, median; None without depth."""
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
    # about how many axes, and by how much: the second singular value is the turning beside the main axis
    spread = np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(turns))
    if spread[1] < _SMALLEST_TURN_DEG / 2:
        raise CalibrationError(
            f"For camera {name} the gripper turned by {spread[0]:.0f} degrees about one axis and only {spread[1]:.1f} "
            "about another: the camera's position along the first cannot be found. Tilt the board about two axes by "
            "20 degrees and more."
        )


def _pose_groups(T_world_gripper: Floats) -> Integers:
    """[P] number of the first pose that each is the same as. A second visit, or another camera's image of the same halt,
    is no pose of its own: held out beside it, it would be known already."""
    groups = np.full(len(T_world_gripper), -1)
    for index, pose in enumerate(T_world_gripper):
        if groups[index] < 0:
            groups[(groups < 0) & _same_pose(pose, T_world_gripper)] = index
    return groups


def _same_pose(pose: Floats, others: Floats) -> NDArray[np.bool_]:
    """[N] whether each of `others` [N, 4, 4] is as good as `pose`."""
    between = inverse(pose) @ others
    turned = Rotation.from_matrix(between[:, :3, :3]).magnitude()
    return (np.linalg.norm(between[:, :3, 3], axis=1) <= _NEW_POSE_M) & (turned <= _NEW_POSE_RAD)


def _count(camera: CameraViews, groups: Integers) -> int:
    return len({int(groups[view.pose]) for view in camera.views})


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else 0.0
