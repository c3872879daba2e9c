"""Checks whether a calibration is usable, and which input is suspected if it is not.

Lengths come from three sources: the arm (how far the board moved), the board (its squares as entered, seen with the
focal length), and depth. Each wrong source disagrees with the others in its own pattern:

    wrong          size of the board by the arm   focal length by the arm   depth over the board's
    square size    off                            right                     off by as much, in all cameras
    arm's scale    off                            right                     right
    focal length   right                          off, in this camera       off by as much, in this camera
    depth scale    right                          right                     off, in this camera

An *objection* is a reason not to use the calibration. A *warning* is about a problem that does not affect the camera
poses.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffcloud.errors import CalibrationError
from diffcloud.sensing.calibration.chain import Estimate
from diffcloud.sensing.calibration.charuco import CameraViews, board_in_camera
from diffcloud.sensing.tool_poses import unreachable

Floats = NDArray[np.float64]
Note = tuple[Literal["warning", "objection"], str]

FEWEST_POSES = 5
"""Minimum number of poses for a solution."""
HELD_OUT_POSES = 10
"""Minimum number of poses for a reliable held-out error. Five poses were simulated with arm errors of 1 mm and 0.2
degrees. Nine in ten cameras were then wrong by 6 to 28 mm, although the held-out errors were only 2 to 5 mm."""
ADVISED_POSES = 15
LARGEST_ERROR_MM = 10.0
"""Maximum held-out error."""
_LARGEST_TURN_DEG = 5.0
"""Maximum median difference between rotations of arm and board. Correct ones differ by tenths of a degree."""
_HINT, _WRONG = 0.01, 0.02
"""Relative errors for a warning and for an objection. Two percent at 1 m are 20 mm of depth. A board wrong by two
percent moves a camera by 13 mm."""
_SURE = 4.0
"""Significance limit in standard deviations. It is high because ten poses estimate these only roughly."""
_SMALLEST_DEVIATION = 0.003
"""Minimum standard deviation of a focal length. Depth follows it exactly only for a board that faces the camera."""
_CHECKERBOARD_WRONG = 0.05
"""Maximum relative error of the checkerboard's size. At 20 cm from the board, where cloth is recorded, it corresponds
to the 10 mm that are allowed elsewhere. A single board pose cannot separate errors of board and camera."""


@dataclass(frozen=True)
class CameraEvidence:
    """Quality figures of one camera's calibration."""

    poses: int
    held_out_poses: int
    rms_px: float | None
    """RMS reprojection error at held-out poses; None without any."""
    rms_mm: float | None
    rms_fit_px: float
    """RMS reprojection error at the fitted poses."""
    rms_fit_mm: float
    focal_px: float
    """Focal length as entered."""
    focal: Estimate
    """Focal length according to the arm, divided by the entered one."""
    depth_ratio: float | None
    """Measured depth divided by the depth of the board as entered; None without depth."""

    def residuals(self) -> dict[str, float]:
        """Return the figures for the calibration file."""
        optional = {"rms_px": self.rms_px, "rms_mm": self.rms_mm, "depth_scale": self.depth_ratio}
        return {
            **{key: value for key, value in optional.items() if value is not None},
            "rms_fit_px": self.rms_fit_px,
            "rms_fit_mm": self.rms_fit_mm,
            "poses": float(self.poses),
            "held_out_poses": float(self.held_out_poses),
            "focal_scale": self.focal.value,
        }


@dataclass(frozen=True)
class CheckerboardEvidence:
    """Quality figures of a checkerboard registration."""

    corners: int
    held_out_corners: int
    held_out_mm: float | None
    """None if there are too few corners."""
    size_ratio: float
    """Size of the board seen by the camera, divided by that in the robot's frame."""
    pitch_m: float
    """Distance of neighbouring corners in the robot's frame."""


def check_reach(positions: Floats) -> None:
    """Check that tool positions [N, 3] are within an arm's reach.

    Raises:
        CalibrationError: a position is more than three metres from the base, e.g. because it is in millimetres.
    """
    wrong = unreachable(positions)
    if wrong is not None:
        raise CalibrationError(wrong)


def check_orientations(cameras: Mapping[str, CameraViews], T_world_gripper: Floats, corners: Floats) -> None:
    """Check that the tool rotates like the board.

    Between two poses, both rotate by the same angle. One fixed rotation, that of the board on the gripper, maps the
    axes of one to those of the other, whatever the camera's pose.

    Raises:
        CalibrationError: the rotations differ; names the order of the quaternion if this explains it, or other causes.
    """
    for name, camera in cameras.items():
        boards = np.stack([board_in_camera(view, corners, camera.intrinsics)[:3, :3] for view in camera.views])
        arm = Rotation.from_matrix(T_world_gripper[[view.pose for view in camera.views], :3, :3])
        off = _turn_mismatch_deg(Rotation.from_matrix(boards), arm)
        if off > _LARGEST_TURN_DEG:
            # (x, y, z, w) read as (w, x, y, z) equals the inverse up to fixed rotations
            inverted = _turn_mismatch_deg(Rotation.from_matrix(boards), arm.inv())
            reason = (
                "Their inverses would fit, or the same numbers as x, y, z, w: robot.csv takes the tool in the base frame, "
                "and tool_qw first."
                if inverted <= _LARGEST_TURN_DEG
                else "Check that tool_qw..qz are (w, x, y, z), that no angles in degrees were taken for radians on the "
                "way, that they belong to these images, and that squares and dictionary are those of the board."
            )
            raise CalibrationError(
                f"The gripper's orientations do not turn as the board does in the images of camera {name}: from pose to "
                f"pose the turns differ by {off:.0f} degrees (median). {reason}"
            )


def judge_hand_eye(
    cameras: Mapping[str, CameraEvidence], board_size: Estimate, *, square_m: float
) -> tuple[list[str], list[str]]:
    """Return (warnings, objections) about a calibration with a board on the gripper.

    Args:
        board_size: size of the board as estimated from the arm's motion, divided by the entered size.
        square_m: entered side length of the board's squares [m].
    """
    notes = [*_size_notes(cameras, board_size, square_m)]
    for name, camera in cameras.items():
        if camera.held_out_poses < HELD_OUT_POSES:
            notes.append(
                (
                    "objection",
                    f"Camera {name} has {camera.held_out_poses} poses that could be held out; a held-out error from fewer "
                    f"than {HELD_OUT_POSES} is not to be relied on. Record {ADVISED_POSES} or more.",
                )
            )
        if camera.poses < ADVISED_POSES:
            notes.append(
                ("warning", f"Camera {name} saw the board at {camera.poses} poses; {ADVISED_POSES} or more are advised.")
            )
    notes += _too_far_off({name: camera.rms_mm for name, camera in cameras.items()}, "poses")
    return _parted(notes)


def judge_checkerboard(cameras: Mapping[str, CheckerboardEvidence]) -> tuple[list[str], list[str]]:
    """Return (warnings, objections) about registrations with a checkerboard that is known in the robot's frame."""
    notes: list[Note] = []
    for name, camera in cameras.items():
        if camera.held_out_mm is None:
            notes.append(
                (
                    "objection",
                    f"Camera {name} has {camera.corners} corners, too few to hold any out: its error is not known. Record "
                    "a board of 3 x 3 corners or more.",
                )
            )
    notes += _too_far_off({name: camera.held_out_mm for name, camera in cameras.items()}, "corners")
    off = {name: float(np.log(camera.size_ratio)) for name, camera in cameras.items()}
    common = _common(list(off.values()))
    for name, camera in cameras.items():
        if abs(off[name]) <= _HINT:
            continue
        seen = 1000 * camera.pitch_m * camera.size_ratio
        if common is None or len(cameras) == 1:
            suspects = "its depth scale, its focal length" + (" and the board's squares" if len(cameras) == 1 else "")
        else:
            suspects = (
                f"the board's squares, as all cameras see them alike: {seen:.1f} mm where the robot's corners are "
                f"{1000 * camera.pitch_m:.1f} mm apart; then a depth scale that is wrong in all of them"
            )
        notes.append(
            (
                "objection" if abs(off[name]) > _CHECKERBOARD_WRONG else "warning",
                f"Camera {name} sees the board {abs(100 * (camera.size_ratio - 1)):.1f} % too "
                f"{'large' if off[name] > 0 else 'small'}, which a rigid motion cannot absorb. Suspected are {suspects}.",
            )
        )
    return _parted(notes)


def _size_notes(cameras: Mapping[str, CameraEvidence], board: Estimate, square_m: float) -> Iterator[Note]:
    """Yield notes about disagreements between the lengths of arm, board and depth (see the table above)."""
    size, size_deviation = float(np.log(board.value)), board.deviation / board.value
    depth = {name: float(np.log(held.depth_ratio)) for name, held in cameras.items() if held.depth_ratio is not None}
    common = _common(list(depth.values()))
    entered, by_arm = 1000 * square_m, 1000 * square_m * board.value
    explained = 0.0
    """Part of the depth ratios that a wrong board explains."""
    if abs(size) > max(_HINT, _SURE * size_deviation):
        with_arm = [abs(ratio - size) < abs(ratio) for ratio in depth.values()]
        said = f"by how the arm moves the board its squares are {by_arm:.1f} mm, entered are {entered:.1f} mm"
        if not with_arm:
            suspect = f"the board's square size, or the scale of the arm's positions: {said}"
        elif np.mean(with_arm) > 0.5:
            suspect = f"the board's square size: {said}, and depth agrees with the arm"
            explained = size if common is None else common  # depth is more accurate
        else:
            suspect = f"the scale of the arm's positions: {said}, and depth agrees with what was entered"
        yield "objection" if abs(size) > _WRONG else "warning", f"Suspected is {suspect}."
    elif common is not None and len(depth) > 1 and abs(common - size) < _SURE * size_deviation:
        explained = common
        yield (
            "objection" if abs(common) > _WRONG else "warning",
            f"Suspected is the board's square size: all cameras measure depth {_percent(common)} off the board's geometry, "
            f"as if its squares were {entered * np.exp(common):.1f} mm and not {entered:.1f} mm. How the arm moved the "
            "board does not tell; measure the squares again.",
        )
    for name, held in cameras.items():
        off = depth[name] - explained if name in depth else 0.0
        # with two cameras, a wrong board would affect both
        board_too = len(depth) == 1 and not explained and abs(off - size) < _SURE * size_deviation
        yield from _camera_notes(name, held, off, board_too=board_too)


def _camera_notes(name: str, camera: CameraEvidence, off: float, *, board_too: bool) -> Iterator[Note]:
    """Yield notes about one camera.

    Args:
        off: logarithm of its depth ratio, without the part that a wrong board explains.
    """
    focal = float(np.log(camera.focal.value))
    deviation = max(camera.focal.deviation / camera.focal.value, _SMALLEST_DEVIATION)
    measures = f"Camera {name} measures depth {_percent(off)} off the board's geometry"
    if abs(focal) > max(_WRONG, _SURE * deviation):
        yield (
            "objection",
            f"Suspected is the focal length of camera {name}: by how the arm moves the board it is "
            f"{camera.focal_px * camera.focal.value:.0f} px, entered are {camera.focal_px:.0f} px"
            + (f" ({measures}, too)" if abs(off) > _HINT else "")
            + ". Are the intrinsics of this camera, at this resolution?",
        )
    elif abs(off) > _HINT:
        others = ["its focal length"] if abs(focal - off) < _SURE * deviation else []
        if board_too:
            others.append("the board's square size")
        if not others:
            yield (
                "warning",
                f"{measures}. Suspected is its depth scale, since board and focal length agree with the arm: run the "
                "camera's own depth calibration, or check depth_scale_m. The camera's place does not depend on it; its "
                "clouds do.",
            )
        else:
            yield (
                "objection" if abs(off) > _WRONG else "warning",
                f"{measures}. Suspected are {', '.join(others)} and its depth scale: these poses do not tell them "
                "apart. Record more, with the board 20 cm nearer and farther.",
            )


def _common(values: list[float]) -> float | None:
    """Return the value on which all agree; None if they differ or agree on zero."""
    if not values or max(values) - min(values) > _HINT or min(map(abs, values)) <= _HINT:
        return None
    return float(np.median(values))


def _turn_mismatch_deg(board: Rotation, arm: Rotation) -> float:
    """Return the median difference between rotations of board and arm over pairs of poses, after axis alignment."""
    one, other = np.triu_indices(len(board), 1)
    seen, told = ((turns[one].inv() * turns[other]).as_rotvec() for turns in (board, arm))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # for rotations about one axis, any solution will do
        held, _ = Rotation.align_vectors(seen, told)
    return float(np.rad2deg(np.median(np.linalg.norm(seen - held.apply(told), axis=1))))


def _too_far_off(held_out_mm: Mapping[str, float | None], of: str) -> Iterator[Note]:
    far = {name: error for name, error in held_out_mm.items() if error is not None and error > LARGEST_ERROR_MM}
    if far:
        errors = ", ".join(f"{error:.1f} mm (camera {name})" for name, error in far.items())
        yield (
            "objection",
            f"The error on held-out {of} is {errors}; at most {LARGEST_ERROR_MM:.0f} mm are allowed. Look for a bent "
            "board, a wrong size, or places of the robot that do not belong to the images.",
        )


def _percent(log_ratio: float) -> str:
    return f"{100 * (np.exp(log_ratio) - 1):+.1f} %"


def _parted(notes: list[Note]) -> tuple[list[str], list[str]]:
    return [text for kind, text in notes if kind == "warning"], [text for kind, text in notes if kind == "objection"]
