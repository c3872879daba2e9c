"""Calibrating fixed cameras with a ChArUco board on the gripper.

Chain, for corner X of the board, gripper pose i and camera c:

    pixel = project_c( inverse(T_world_camera_c) · T_world_gripper_i · T_gripper_board · X )

A hand-eye solution of each camera alone starts a joint least-squares refinement of all cameras and the one board, on
reprojection errors, with a robust loss. Every fifth pose is held out first: what the refined chain says there, in pixels
and in millimetres, is the number to believe. Then all poses are used.

The covariance is the sandwich estimator clustered by pose: errors of the robot's own kinematics move all corners of a pose
together, so counting corners as independent would be far too sure.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from diffcloud.errors import CalibrationError
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.raw_episodes import RawCamera, RobotLog
from diffcloud.sensing.cameras import inverse, project, rays, transform

Floats = NDArray[np.float64]

FEWEST_CORNERS = 6
FEWEST_POSES = 5
ADVISED_POSES = 15
_HELD_OUT_EVERY = 5
_ROBUST_PX = 1.0
_SMALLEST_TURN_DEG = 10.0
_NEW_POSE_M, _NEW_POSE_RAD = 0.01, np.deg2rad(2.0)
_STILL_M, _STILL_RAD = 0.001, np.deg2rad(0.2)
_STILL_WINDOW_S = 0.1


@dataclass(frozen=True)
class CharucoBoard:
    """A printed board; measure its squares with a calliper."""

    columns: int = 5
    """Squares."""
    rows: int = 7
    square_m: float = 0.03
    marker_m: float = 0.022
    dictionary: str = "DICT_5X5_100"

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or not 0 < self.marker_m < self.square_m < 1:
            raise CalibrationError(
                f"A board needs 3 x 3 squares or more and 0 < marker < square < 1 m, got {self.columns} x {self.rows}, "
                f"square {self.square_m:g} m, marker {self.marker_m:g} m."
            )

    def opencv(self) -> Any:
        """The board of cv2.aruco.

        Raises:
            CalibrationError: an unknown dictionary.
        """
        import cv2

        number = getattr(cv2.aruco, self.dictionary, None)
        if number is None or not self.dictionary.startswith("DICT_"):
            raise CalibrationError(
                f"Unknown dictionary {self.dictionary!r}; such as DICT_4X4_50, DICT_5X5_100, DICT_6X6_250."
            )
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, dictionary)

    def corners(self) -> Floats:
        """[K, 3] inner corners in the board's frame: x right, y down, z into the board [m]."""
        return np.asarray(self.opencv().getChessboardCorners(), dtype=np.float64).reshape(-1, 3)

    def detect(self, color: NDArray[np.uint8]) -> tuple[NDArray[np.int64], Floats]:
        """(corner numbers [N], pixels [N, 2]) in an image [H, W, 3]; empty where the board is not seen."""
        import cv2

        detector = cv2.aruco.CharucoDetector(self.opencv())
        pixels, numbers, _, _ = detector.detectBoard(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY))
        if numbers is None or len(numbers) < FEWEST_CORNERS:
            return np.zeros(0, np.int64), np.zeros((0, 2))
        return np.asarray(numbers, np.int64).reshape(-1), np.asarray(pixels, np.float64).reshape(-1, 2)


@dataclass(frozen=True)
class View:
    """What one camera saw of the board at one gripper pose."""

    pose: int
    numbers: NDArray[np.int64]
    """[N] corners."""
    pixels: Floats
    """[N, 2]."""
    depth_m: Floats | None = None
    """[N] measured at the corners; NaN where there is none."""
    frame: int = -1
    """Index of the image, for pictures."""


@dataclass(frozen=True)
class CameraViews:
    """All views of one camera."""

    intrinsics: Intrinsics
    views: tuple[View, ...]


@dataclass(frozen=True)
class HandEyeResult:
    """Cameras and board."""

    T_world_camera: Mapping[str, Floats]
    T_gripper_board: Floats
    covariance: Mapping[str, Floats]
    """[6, 6] by camera: translation [m], rotation [rad], on the world's side."""
    residuals: Mapping[str, Mapping[str, float]]
    """By camera: rms_px and rms_mm on held-out poses, rms_fit_px, poses, depth_scale where depth was there."""
    warnings: tuple[str, ...] = field(default=())


def find_views(
    cameras: Mapping[str, RawCamera], robot: RobotLog, board: CharucoBoard
) -> tuple[dict[str, CameraViews], Floats]:
    """Detections in the still frames of a raw episode, one per gripper pose and camera.

    Returns:
        Views by camera, and the gripper poses [P, 4, 4] that they number.
    """
    found: dict[str, CameraViews] = {}
    poses: list[Floats] = []
    for name, camera in cameras.items():
        views: list[View] = []
        for index, t in enumerate(camera.times):  # images come one after the other; corners are vectorised
            pose = still_pose(robot, float(t))
            if pose is None or (views and not _is_new(pose, poses[-1])):
                continue
            color = camera.color(index)
            if color is None:
                continue
            numbers, pixels = board.detect(color)
            if len(numbers):
                depth = _depth_at(camera.depth(index), pixels) * camera.info.depth_scale_m
                views.append(View(len(poses), numbers, pixels, depth, index))
                poses.append(pose)
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
        CalibrationError: too few poses, or the gripper did not turn about two axes; says what to record.
    """
    for name, camera in cameras.items():
        _check_poses(name, camera, T_world_gripper)
    corners = board.corners()
    warnings = tuple(
        f"Camera {name} saw the board at {len(camera.views)} poses; {ADVISED_POSES} or more are advised."
        for name, camera in cameras.items()
        if len(camera.views) < ADVISED_POSES
    )
    start = {name: _hand_eye(camera, T_world_gripper, corners) for name, camera in cameras.items()}
    first = next(iter(cameras))
    board_start = _board_on_gripper(cameras[first], T_world_gripper, corners, start[first])

    seen = sorted({view.pose for camera in cameras.values() for view in camera.views})
    held_out = set(seen[_HELD_OUT_EVERY // 2 :: _HELD_OUT_EVERY]) if len(seen) >= 2 * FEWEST_POSES else set()
    training = {name: _without(camera, held_out) for name, camera in cameras.items()}
    trained = _refine(training, T_world_gripper, corners, start, board_start)
    final = _refine(cameras, T_world_gripper, corners, trained.cameras, trained.board)

    residuals = {}
    for name, camera in cameras.items():
        test = _only(camera, held_out) if held_out else camera
        chain = trained if held_out else final
        pixel, millimetre = _errors(test, T_world_gripper, corners, chain.cameras[name], chain.board)
        fit, _ = _errors(camera, T_world_gripper, corners, final.cameras[name], final.board)
        residuals[name] = {
            "rms_px": _rms(pixel),
            "rms_mm": _rms(millimetre),
            "rms_fit_px": _rms(fit),
            "poses": float(len(camera.views)),
            "held_out_poses": float(len(test.views) if held_out else 0),
        }
        ratio = _depth_ratio(camera, T_world_gripper, corners, final.cameras[name], final.board)
        if ratio is not None:
            residuals[name]["depth_scale"] = ratio
            if abs(ratio - 1) > 0.01:
                warnings += (
                    f"Camera {name} measures depth {100 * (ratio - 1):+.1f} % off the board's geometry: run the camera's "
                    "own depth calibration, or check square_m and depth_scale_m.",
                )
    return HandEyeResult(final.cameras, final.board, final.covariance, residuals, warnings)


@dataclass(frozen=True)
class _Refined:
    cameras: dict[str, Floats]
    board: Floats
    covariance: dict[str, Floats]


def _refine(
    cameras: Mapping[str, CameraViews],
    T_world_gripper: Floats,
    corners: Floats,
    start: Mapping[str, Floats],
    board: Floats,
) -> _Refined:
    names = list(cameras)
    placed = {name: start[name] for name in names}
    observed = {name: _stacked(camera) for name, camera in cameras.items()}

    def chain(step: Floats) -> Floats:
        moved_board = _moved(board, step[-6:])
        errors = []
        for index, name in enumerate(names):
            poses, numbers, pixels = observed[name]
            camera = _moved(placed[name], step[6 * index : 6 * index + 6])
            local = _in_camera(camera, T_world_gripper[poses], moved_board, corners[numbers])
            errors.append((project(local, cameras[name].intrinsics) - pixels).ravel())
        return np.concatenate(errors)

    zero = np.zeros(6 * (len(names) + 1))
    from scipy.optimize import least_squares  # slow to import

    found = least_squares(
        chain, zero, jac=lambda step: _jacobian(chain, step), loss="soft_l1", f_scale=_ROBUST_PX, x_scale="jac"
    )
    if not np.isfinite(found.x).all():
        raise CalibrationError("The refinement did not converge; check that gripper poses and images belong together.")
    placed = {name: _moved(placed[name], found.x[6 * index : 6 * index + 6]) for index, name in enumerate(names)}
    board = _moved(board, found.x[-6:])
    clusters = np.concatenate([np.repeat(observed[name][0], 2) for name in names])
    covariance = _clustered_covariance(chain(zero), _jacobian(chain, zero), clusters)
    blocks = {name: covariance[6 * index : 6 * index + 6, 6 * index : 6 * index + 6] for index, name in enumerate(names)}
    return _Refined(placed, board, blocks)


def _clustered_covariance(residual: Floats, jacobian: Floats, clusters: NDArray[np.int64]) -> Floats:
    """Sandwich estimator of robust least squares (soft L1), with scores summed over each cluster."""
    weight = 1 / np.sqrt(1 + (residual / _ROBUST_PX) ** 2)  # derivative of the loss
    information = jacobian.T @ (weight[:, None] * jacobian)
    _, index = np.unique(clusters, return_inverse=True)
    count, width = int(index.max()) + 1, jacobian.shape[1]
    scores = np.zeros((count, width))
    np.add.at(scores, index, jacobian * (weight * residual)[:, None])
    bread = np.linalg.pinv(information)
    # few clusters: the usual correction of the number of clusters and of parameters
    small = count / max(count - 1, 1) * len(residual) / max(len(residual) - width, 1)
    return small * bread @ (scores.T @ scores) @ bread


def _moved(matrix: Floats, step: Floats) -> Floats:
    """A pose after a step [6] (translation, rotation vector) on the left of each: (t + dt, exp(dr) R)."""
    result = matrix.copy()
    result[:3, 3] += step[:3]
    result[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ matrix[:3, :3]
    return result


def _jacobian(function: Callable[[Floats], Floats], at: Floats, width: float = 1e-6) -> Floats:
    """Central differences: a handful of parameters and a cheap chain do not repay formulas."""
    columns = [(function(at + step) - function(at - step)) / (2 * width) for step in width * np.eye(len(at))]
    return np.column_stack(columns)


def _stacked(camera: CameraViews) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    poses = np.concatenate([np.full(len(view.numbers), view.pose) for view in camera.views])
    numbers = np.concatenate([view.numbers for view in camera.views])
    return poses, numbers, np.concatenate([view.pixels for view in camera.views])


def _in_camera(T_world_camera: Floats, grippers: Floats, T_gripper_board: Floats, points: Floats) -> Floats:
    """Board points [N, 3], each at its gripper pose [N, 4, 4], in the camera's frame."""
    chain = inverse(T_world_camera) @ grippers @ T_gripper_board
    return np.einsum("nij,nj->ni", chain[:, :3, :3], points) + chain[:, :3, 3]


def _board_in_camera(view: View, corners: Floats, intrinsics: Intrinsics) -> Floats:
    """[4, 4] of one view alone (perspective-n-point)."""
    import cv2

    # distortion is taken out first, in the camera's own convention
    plane = np.ascontiguousarray(rays(view.pixels, intrinsics)[:, :2])
    done, turn, shift = cv2.solvePnP(corners[view.numbers], plane, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_ITERATIVE)
    if not done:
        raise CalibrationError("A board could not be placed from its corners.")
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(turn.ravel()).as_matrix(), shift.ravel()
    return matrix


def _hand_eye(camera: CameraViews, T_world_gripper: Floats, corners: Floats) -> Floats:
    """[4, 4] T_world_camera of one camera, by Park and Martin's method.

    OpenCV solves for a camera on the gripper. Here the camera stands and the board moves, so the inverted gripper poses go
    in and the camera in the base frame comes out.
    """
    import cv2

    boards = np.stack([_board_in_camera(view, corners, camera.intrinsics) for view in camera.views])
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
    if not np.isfinite(matrix).all():
        raise CalibrationError("The hand-eye start failed: turn the gripper about two axes by 20 degrees and more.")
    return matrix


def _board_on_gripper(camera: CameraViews, T_world_gripper: Floats, corners: Floats, T_world_camera: Floats) -> Floats:
    """[4, 4] mean over the views."""
    chains = np.stack(
        [
            inverse(T_world_gripper[view.pose]) @ T_world_camera @ _board_in_camera(view, corners, camera.intrinsics)
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
    if not camera.views:
        return np.zeros(0), np.zeros(0)
    poses, numbers, pixels = _stacked(camera)
    local = _in_camera(T_world_camera, T_world_gripper[poses], T_gripper_board, corners[numbers])
    off = np.linalg.norm(project(local, camera.intrinsics) - pixels, axis=1)
    own = np.concatenate(
        [transform(_board_in_camera(view, corners, camera.intrinsics), corners[view.numbers]) for view in camera.views]
    )
    return off, 1000 * np.linalg.norm(own - local, axis=1)


def _depth_ratio(
    camera: CameraViews, T_world_gripper: Floats, corners: Floats, T_world_camera: Floats, T_gripper_board: Floats
) -> float | None:
    """Measured depth over the depth the chain predicts, median; None without depth."""
    if any(view.depth_m is None for view in camera.views):
        return None
    poses, numbers, _ = _stacked(camera)
    measured = np.concatenate([view.depth_m for view in camera.views if view.depth_m is not None])
    predicted = _in_camera(T_world_camera, T_world_gripper[poses], T_gripper_board, corners[numbers])[:, 2]
    known = np.isfinite(measured) & (measured > 0)
    return float(np.median(measured[known] / predicted[known])) if known.sum() >= FEWEST_CORNERS else None


def _depth_at(depth: NDArray[np.uint16], pixels: Floats) -> Floats:
    """Median of the valid depths in 3 x 3 pixels around each corner, NaN where there is none."""
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


def _check_poses(name: str, camera: CameraViews, T_world_gripper: Floats) -> None:
    if len(camera.views) < FEWEST_POSES:
        raise CalibrationError(
            f"Camera {name} saw the board at {len(camera.views)} still poses; at least {FEWEST_POSES} are needed and "
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


def _is_new(pose: Floats, last: Floats) -> bool:
    between = inverse(last) @ pose
    far = np.linalg.norm(between[:3, 3]) > _NEW_POSE_M
    return bool(far or Rotation.from_matrix(between[:3, :3]).magnitude() > _NEW_POSE_RAD)


def _without(camera: CameraViews, poses: set[int]) -> CameraViews:
    return CameraViews(camera.intrinsics, tuple(view for view in camera.views if view.pose not in poses))


def _only(camera: CameraViews, poses: set[int]) -> CameraViews:
    return CameraViews(camera.intrinsics, tuple(view for view in camera.views if view.pose in poses))


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else 0.0
