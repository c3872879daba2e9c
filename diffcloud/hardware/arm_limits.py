"""Limits of the arm beyond the tool's position: joints, singularities, collisions of links, tool frame.

A trajectory gives the tool's position only. So the joint angles along the whole path are predicted before the arm
moves: inverse kinematics step by step from the measured state, with constant tool orientation and the smallest joint
motion. A redundant arm may move differently, so the measured states are checked against the same limits during the
motion.

The tool frame configured on the arm cannot be read. Instead, the reported tool pose is compared with the forward
kinematics of the robot description. A difference reveals a wrong tool frame, a wrong description, or the joint log of
another arm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffcloud.errors import LimitError, RobotError
from diffcloud.hardware.devices import ArmReading
from diffcloud.hardware.trajectory import Limits, ToolTrajectory

if TYPE_CHECKING:  # imports torch, which the arm's own process does not need and would have to wait for
    from diffcloud.sensing.robot import Robot

Floats = NDArray[np.float64]

_STEP_M = 0.005
"""Distance between predicted tool poses along a path."""
_BASE_M = 0.1
"""Half the width of the arm's base, which is at the origin."""
_ELBOW_M = 0.76
"""Height of a Gen3's elbow when its upper arm is vertical."""
_SPEED_WINDOW_S = 0.4
"""Time window for measuring joint speeds. The time of a reading is uncertain by about 20 ms."""
_SPEED_SLACK = 1.1
"""Factor by which a measured joint speed may exceed the limit, for error corrections and 5 % measurement error."""
_NOISE = 2e-3
"""Tolerance [m, rad] for outward motion while the arm returns inside the limits."""
_TABLE = 8
"""Index of the table among the criteria of `ArmChecker.excess` (the third face for links)."""


@dataclass(frozen=True)
class ArmLimits:
    """Limits of joints and links."""

    table_m: float = 0.0
    """Height of the table in the base frame [m]. No moving link may be lower."""
    clearance_m: float = 0.01
    """Extra distance of a planned path from the table and from the walls of the links' space."""
    margin_m: float = 0.15
    """Distance by which links may extend beyond the workspace box and the base, for wrist and fingers."""
    joint_margin_rad: float = float(np.deg2rad(5.0))
    """Distance of a planned path from the joint limits. Measured joints may be half as far."""
    joint_speed_rad_s: float = 1.2
    """Largest joint speed. The maker's limits are 1.22 (wrist) and 1.40."""
    singular_value: float = 0.05
    """Smallest singular value of the tool's Jacobian [m/rad, rad/rad]. Closer to a singularity, small tool motions need
    large joint motions."""
    turn_rad: float = float(np.deg2rad(5.0))
    """Largest rotation of the tool from its orientation at the start."""
    tool_offset_m: float = 0.01
    """Largest distance between the reported tool position and the forward kinematics."""
    tool_turn_rad: float = float(np.deg2rad(3.0))

    def __post_init__(self) -> None:
        for name in ("margin_m", "joint_speed_rad_s", "singular_value", "turn_rad", "tool_offset_m", "tool_turn_rad"):
            if not getattr(self, name) > 0:
                raise LimitError(f"The limit {name} must be positive, got {getattr(self, name)}.")


@dataclass(frozen=True)
class JointPath:
    """Path in joint space: straight lines between rows."""

    times: Floats
    """[T] since the start [s]."""
    joints_rad: Floats
    """[T, J]."""

    @property
    def duration_s(self) -> float:
        return float(self.times[-1])

    @property
    def fastest_rad_s(self) -> float:
        """Highest speed of any joint at any time."""
        return float((np.abs(np.diff(self.joints_rad, axis=0)) / np.diff(self.times)[:, None]).max())

    def at(self, t_s: float) -> Floats:
        """[J] joint angles at time `t_s`. Before the start and after the end, those at the ends."""
        return np.array([np.interp(t_s, self.times, column) for column in self.joints_rad.T])


class ArmChecker:
    """Checks planned and measured joint states against the limits.

    Args:
        robot: description of the arm with its gripper, in the arm's base frame.
        limits: limits of the tool. The links' space is the workspace box, enlarged by a margin.

    Raises:
        LimitError: no moving link has a mesh, or a joint of the arm has no limits and is not continuous.
    """

    def __init__(self, robot: Robot, limits: Limits, arm_limits: ArmLimits) -> None:
        self.robot, self.limits, self.arm_limits = robot, limits, arm_limits
        if not self._moving:
            raise LimitError(
                f"The description {robot.description.name} has no surfaces of links that move, so that nothing can be held "
                "against table and box. Name a description whose links have meshes: urdf in rig.yaml."
            )
        joints = [robot.moving[index] for index in robot.arm]
        unlimited = [joint.name for joint in joints if joint.kind != "continuous" and not math.isfinite(joint.lower)]
        if unlimited:
            raise LimitError(
                f"The description {robot.description.name} states no limits of {', '.join(unlimited)}, so that nothing can "
                "keep them from their ends. Add <limit lower= upper=>, or make a joint that turns without end continuous."
            )
        self._ends = np.array([[joint.lower, joint.upper] for joint in joints])
        low, high = np.array(limits.box_low_m), np.array(limits.box_high_m)
        margin = arm_limits.margin_m
        self._space = np.stack(
            [np.minimum(low, -_BASE_M) - margin, np.maximum(high, [_BASE_M, _BASE_M, _ELBOW_M]) + margin]
        )
        self._space[0, 2] = arm_limits.table_m

    def check_tool_frame(self, reading: ArmReading) -> None:
        """Compare the reported tool pose with the forward kinematics of the robot description.

        Raises:
            LimitError: they differ. The message has the difference in the reported tool's frame, and hints.
        """
        if not np.isfinite([*reading.joints_rad, *reading.tool_position_m, *reading.tool_quaternion]).all():
            raise LimitError(f"The arm reports no numbers for its joints or its tool: {reading}.")
        if len(reading.joints_rad) != len(self._ends):
            raise LimitError(
                f"The arm has {len(reading.joints_rad)} joints, but the URDF {self.robot.description.name} has "
                f"{len(self._ends)}. Set `urdf` in rig.yaml to the URDF of this arm."
            )
        reported, expected = _rotation(reading), self.robot.tool_pose(reading.joints_rad)
        offset = reported.inv().apply(expected[:3, 3] - reading.tool_position_m)
        turn = float((reported.inv() * Rotation.from_matrix(expected[:3, :3])).magnitude())
        limits = self.arm_limits
        if np.linalg.norm(offset) > limits.tool_offset_m or turn > limits.tool_turn_rad:
            raise LimitError(
                f"The arm reports its tool {1000 * np.linalg.norm(offset):.0f} mm and {np.rad2deg(turn):.1f}° from where "
                f"its joints and the description {self.robot.description.name} put it, which is at "
                f"{(1000 * offset).round().tolist()} mm in the reported tool's frame; up to "
                f"{1000 * limits.tool_offset_m:g} mm and {np.rad2deg(limits.tool_turn_rad):g}° are accepted. A trajectory "
                "is for the described tool: set the arm's tool frame (web page: Configurations, Tool), or give the "
                "description of this arm (urdf in rig.yaml)."
            )

    def predict(self, reading: ArmReading, positions: Floats) -> tuple[Floats, str | None]:
        """Predict the joints [T', J] that move the tool from `reading` along `positions` [T, 3] [m] without rotation.

        Returns:
            Joints up to the first unreachable position, and the reason why it is unreachable (None if all are
            reachable).
        """
        tool = self.robot.tool_pose(reading.joints_rad)
        # The inverse kinematics is of the described arm, which may differ from the measured one by some millimetres.
        positions = positions + (tool[:3, 3] - reading.tool_position_m)
        joints = reading.joints_rad
        found: list[Floats] = []
        for position in positions:  # in order, because each solution starts from the previous one
            try:
                joints = self.robot.inverse_kinematics(position, rotations=tool[:3, :3], start_rad=joints)
            except RobotError as error:
                return np.array(found), str(error)
            found.append(joints)
        return np.array(found), None

    def check_trajectory(self, name: str, trajectory: ToolTrajectory, reading: ArmReading) -> ArmReading:
        """Check that a trajectory stays within all limits.

        Args:
            name: name of the motion, for messages.
            reading: state of the arm at the start.

        Returns:
            Predicted reading at the end, from which the next motion can be checked.

        Raises:
            LimitError: a limit is exceeded. The message has the time, the joint or link, and the excess.
        """
        times = _sample_times(trajectory)
        positions = np.array([trajectory.position(t) for t in times])
        gripper = [trajectory.gripper_at(t) for t in times]
        closed = np.array([_known(reading.gripper if value is None else value) for value in gripper])
        joints, unreached = self.predict(reading, positions)
        count = len(joints)
        if count:
            self._check(name, times[:count], joints, closed[:count], positions[:count])
        if unreached is not None:
            raise LimitError(
                f"The {name} would leave the arm's reach at t = {times[count]:.2f} s: with its present orientation the "
                f"tool does not get to {positions[count].round(3).tolist()} m. ({unreached}) Move the trajectory, or turn "
                "the tool."
            )
        speed = np.abs(np.diff(joints, axis=0)) / np.diff(times)[:, None]
        worst = np.unravel_index(int(speed.argmax()), speed.shape)
        if speed[worst] > self.arm_limits.joint_speed_rad_s:
            raise LimitError(
                f"At t = {times[worst[0]]:.2f} s of the {name} joint {worst[1] + 1} would have to turn with "
                f"{speed[worst]:.2f} rad/s; the limit is {self.arm_limits.joint_speed_rad_s:g} rad/s. Multiply "
                f"time_scale in rig.yaml by {1.05 * speed[worst] / self.arm_limits.joint_speed_rad_s:.2f}."
            )
        return ArmReading(joints[-1], positions[-1], reading.tool_quaternion, float(closed[-1]), reading.wrench)

    def plan_home(self, home_rad: Floats, reading: ArmReading, *, speed_m_s: float) -> JointPath:
        """Plan a straight minimum-jerk path in joint space on which no point of the arm exceeds `speed_m_s`.

        The path may start outside the limits, for example with folded joints or outside the box. It then may only
        return into the limits. Contact with the table is never allowed.

        Raises:
            LimitError: the path would leave the limits, or move farther outside.
        """
        home = self._nearest(home_rad, reading.joints_rad)
        s = np.linspace(0.0, 1.0, 101)
        joints = reading.joints_rad + s[:, None] * (home - reading.joints_rad)
        closed = np.full(len(s), _known(reading.gripper))
        self._check("way home", s, joints, closed, self.robot.tool_pose(joints)[:, :3, 3], returning=True)
        steps = [np.linalg.norm(np.diff(points, axis=0), axis=-1).max() for points in self._points(joints, closed).values()]
        path_m = float(max(steps)) / s[1]  # path length of the fastest point at its highest speed throughout
        turn = float(np.abs(home - reading.joints_rad).max())
        # 15/8 is the ratio of peak to mean speed of a minimum-jerk motion.
        duration = max(1.875 * path_m / speed_m_s, 1.875 * turn / self.arm_limits.joint_speed_rad_s, 0.5)
        eased = s**3 * (10 - 15 * s + 6 * s**2)
        return JointPath(s * duration, reading.joints_rad + eased[:, None] * (home - reading.joints_rad))

    def at(self, joints_rad: Floats, reading: ArmReading) -> ArmReading:
        """Predicted reading with joints [J], if everything else stays as in `reading`."""
        tool = self.robot.tool_pose(joints_rad)
        quaternion = Rotation.from_matrix(tool[:3, :3]).as_quat(scalar_first=True)
        return ArmReading(joints_rad, tool[:3, 3], quaternion, reading.gripper, reading.wrench)

    def watch(self, name: str, start: ArmReading, *, returning: bool = False) -> ArmWatch:
        """Return a checker for the readings of one motion.

        Args:
            returning: the motion may start outside the limits, if it only returns into them.
        """
        return ArmWatch(self, name, start, returning=returning)

    def excess(self, joints_rad: Floats, gripper: Floats, positions: Floats, *, slack: float) -> Floats:
        """[T, 12 + J] excess over the limits of tool, links (6 faces each) [m] and joints [rad]. Negative is inside.

        Args:
            gripper: [T] from 0 (open) to 1 (closed).
            positions: [T, 3] of the tool [m].
            slack: 0 for a planned path. 1 for a measured one, which may use the margins (for joints, half of them).
        """
        limits = self.arm_limits
        ends = self._kept_ends(slack)
        joint = np.maximum(ends[:, 0] - joints_rad, joints_rad - ends[:, 1])
        parts = self._points(joints_rad, gripper)
        lowest = np.min([points.min(axis=1) for points in parts.values()], axis=0)
        highest = np.max([points.max(axis=1) for points in parts.values()], axis=0)
        inset = limits.clearance_m * (1 - slack)
        links = np.concatenate([self._space[0] + inset - lowest, highest - (self._space[1] - inset)], axis=1)
        low, high, box_slack = self.limits.box_low_m, self.limits.box_high_m, self.limits.box_slack_m
        tool = np.concatenate([np.array(low) - box_slack - positions, positions - high - box_slack], axis=1)
        return np.concatenate([tool, links, joint], axis=1)

    def _kept_ends(self, slack: float) -> Floats:
        """[J, 2] joint limits, reduced by the margins of `excess`."""
        return self._ends + np.array([1.0, -1.0]) * self.arm_limits.joint_margin_rad * (1 - slack / 2)

    def describe(self, criterion: int, joints_rad: Floats, gripper: float, position: Floats) -> str:
        """Describe how one state [J] exceeds a criterion of `excess`."""
        face, joint = criterion - 6, criterion - 12
        if joint >= 0:
            low, high = np.rad2deg(self._ends[joint])
            margin = np.rad2deg(self.arm_limits.joint_margin_rad)
            return (
                f"joint {joint + 1} is at {np.rad2deg(joints_rad[joint]):.1f}°; its range is {low:.1f}° to {high:.1f}°, "
                f"from whose ends a planned path keeps {margin:g}° and a measured one {margin / 2:g}°"
            )
        if face < 0:
            return (
                f"the tool left the workspace box: {position.round(3).tolist()} m is not within {self.limits.box_low_m} to "
                f"{self.limits.box_high_m}"
            )
        parts = self._points(joints_rad[None], np.array([gripper]))
        axis, sign = face % 3, -1 if face < 3 else 1
        reach = {link: float((sign * points[..., axis]).max()) for link, points in parts.items()}
        link = max(reach, key=lambda name: reach[name])
        value = sign * reach[link]
        if face == 2:
            return (
                f"{link} reaches down to z = {value:.3f} m; the table is at {self.arm_limits.table_m:.3f} m, and a planned "
                f"path keeps {1000 * self.arm_limits.clearance_m:.0f} mm above it"
            )
        bound = self._space[0 if face < 3 else 1, axis]
        return f"{link} reaches {'xyz'[axis]} = {value:.3f} m; the arm's space ends at {bound:.3f} m"

    def singular_values(self, joints_rad: Floats) -> Floats:
        """[...] smallest singular value of the tool's Jacobian at joints [..., J]."""
        return np.asarray(np.linalg.svd(self.robot.jacobian(joints_rad), compute_uv=False)[..., -1], dtype=np.float64)

    def _check(
        self, name: str, times: Floats, joints: Floats, gripper: Floats, positions: Floats, *, returning: bool = False
    ) -> None:
        excess = self.excess(joints, gripper, positions, slack=0.0)
        allowed = np.zeros_like(excess)
        if returning:  # the excess may not grow along the path, and contact with the table is never allowed
            allowed = np.maximum(np.minimum.accumulate(excess, axis=0), 0.0) + _NOISE
            allowed[:, _TABLE] = np.minimum(allowed[:, _TABLE], self.arm_limits.clearance_m)
        bad = np.flatnonzero((excess > allowed + 1e-9).any(axis=1))
        if len(bad):
            first = int(bad[0])
            criterion = int((excess[first] > allowed[first] + 1e-9).argmax())
            what = self.describe(criterion, joints[first], float(gripper[first]), positions[first])
            moment = f"{times[first]:.0%}" if returning else f"t = {times[first]:.2f} s"
            raise LimitError(
                f"The {name} would break a limit at {moment}: {what}. Start from another pose (by hand) "
                "or move the trajectory. If the arm is free to go there, change table_height_m, link_margin_m or "
                "workspace_m in rig.yaml."
            )
        if returning:  # motion in joint space is not affected by singularities
            return
        values = self.singular_values(joints)
        if values.min() < self.arm_limits.singular_value:
            first = int(np.flatnonzero(values < self.arm_limits.singular_value)[0])
            raise LimitError(
                f"The {name} would come too near to a singularity at t = {times[first]:.2f} s "
                f"({positions[first].round(3).tolist()} m): the Jacobian's least singular value is {values[first]:.3f}, "
                f"the limit is {self.arm_limits.singular_value:g}. Keep farther from the edge of the arm's reach, or turn "
                "the tool."
            )

    def _nearest(self, target_rad: Floats, joints_rad: Floats) -> Floats:
        """[J] targets shifted by whole turns to the nearest value within the planned limits.

        If there is none, the nearest value within the joint limits, else the nearest one. `_check` refuses these.
        """
        nearest = np.round((joints_rad - target_rad) / (2 * np.pi))
        turns = nearest
        for ends in (self._ends, self._kept_ends(slack=0.0)):
            low, high = (ends - target_rad[:, None]).T / (2 * np.pi)
            least, most = np.ceil(low), np.floor(high)
            turns = np.where(least <= most, np.clip(nearest, least, most), turns)
        return np.asarray(target_rad + 2 * np.pi * turns)

    def _points(self, joints_rad: Floats, gripper: Floats) -> dict[str, Floats]:
        """[T, V, 3] mesh vertices of each moving link [m]."""
        poses = self.robot.forward_kinematics(self.robot.configuration(joints_rad, gripper))
        placed = ((name, poses[:, self.robot.links.index(name)]) for name in self._moving)
        meshes = self.robot.description.meshes
        return {
            name: meshes[name].vertices @ np.swapaxes(pose[:, :3, :3], 1, 2) + pose[:, None, :3, 3] for name, pose in placed
        }

    @cached_property
    def _moving(self) -> tuple[str, ...]:
        """Links with a mesh that are not fixed to the base, since the base touches the table."""
        description = self.robot.description
        fixed = {description.root}
        for joint in description.joints:  # ordered from the root outwards
            if joint.kind == "fixed" and joint.parent in fixed:
                fixed.add(joint.child)
        return tuple(name for name in description.meshes if name not in fixed)


class ArmWatch:
    """Checks the readings of one motion against the limits."""

    def __init__(self, checker: ArmChecker, name: str, start: ArmReading, *, returning: bool) -> None:
        self._checker, self._name, self._returning = checker, name, returning
        self._orientation = _rotation(start)
        self._since: tuple[float, Floats] | None = None
        """Time and joint angles [J] of the latest speed measurement."""
        self._allowed = np.zeros(len(start.joints_rad) + 12)
        if returning:
            self._allowed = np.maximum(self._excess(start), 0.0)
            self._allowed[_TABLE] = 0.0

    def check(self, t: float, reading: ArmReading) -> None:
        """Check one reading.

        Raises:
            LimitError: a limit is exceeded. The message has the time and the joint or link.
        """
        checker, when = self._checker, f"At t = {t:.2f} s of the {self._name}"
        excess = self._excess(reading)
        kept = excess <= self._allowed + (_NOISE if self._returning else 0.0)  # false for NaN
        if not kept.all():
            gripper = _known(reading.gripper)
            what = checker.describe(int(kept.argmin()), reading.joints_rad, gripper, reading.tool_position_m)
            raise LimitError(f"{when} {what}.")
        if self._returning:
            self._allowed = np.minimum(self._allowed, np.maximum(excess, 0.0))
        else:
            self._check_tool(when, reading)
        self._check_speed(when, t, reading.joints_rad)

    def _check_tool(self, when: str, reading: ArmReading) -> None:
        checker = self._checker
        turned = float((self._orientation.inv() * _rotation(reading)).magnitude())
        if not turned <= checker.arm_limits.turn_rad:
            raise LimitError(
                f"{when} the tool has turned by {np.rad2deg(turned):.1f}°; it should keep its orientation to "
                f"{np.rad2deg(checker.arm_limits.turn_rad):g}°. Something turns it, or a joint is at its limit."
            )
        value = float(checker.singular_values(reading.joints_rad))
        if not value >= checker.arm_limits.singular_value:
            raise LimitError(
                f"{when} the arm is too near to a singularity: the Jacobian's least singular value is {value:.3f}, the "
                f"limit is {checker.arm_limits.singular_value:g}."
            )

    def _check_speed(self, when: str, t: float, joints_rad: Floats) -> None:
        if self._since is None:
            self._since = t, joints_rad
        before, joints = self._since
        if t - before < _SPEED_WINDOW_S:
            return
        self._since = t, joints_rad
        turned = (joints_rad - joints + np.pi) % (2 * np.pi) - np.pi  # the angle of a continuous joint may wrap around
        speed = np.abs(turned) / (t - before)
        limit = _SPEED_SLACK * self._checker.arm_limits.joint_speed_rad_s
        if not speed.max() <= limit:
            joint = int(speed.argmax())
            raise LimitError(
                f"{when} joint {joint + 1} turns with {speed[joint]:.2f} rad/s; the limit is {limit:g} rad/s. Raise "
                "time_scale in rig.yaml, or look for what turns it."
            )

    def _excess(self, reading: ArmReading) -> Floats:
        closed = np.array([_known(reading.gripper)])
        return self._checker.excess(reading.joints_rad[None], closed, reading.tool_position_m[None], slack=1.0)[0]


def _known(gripper: float | None) -> float:
    """Return the gripper state. If unknown, assume open, because open fingers extend farthest."""
    return 0.0 if gripper is None else gripper


def _rotation(reading: ArmReading) -> Rotation:
    return Rotation.from_quat(np.roll(reading.tool_quaternion, -1))


def _sample_times(trajectory: ToolTrajectory) -> Floats:
    """[T] times of the keyframes and of points between them, such that the tool moves at most `_STEP_M` in between."""
    lengths = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
    counts = np.maximum(1, np.ceil(lengths / _STEP_M)).astype(int)
    pieces = [
        np.linspace(start, end, count, endpoint=False)
        for start, end, count in zip(trajectory.times[:-1], trajectory.times[1:], counts, strict=True)
    ]
    return np.concatenate([*pieces, trajectory.times[-1:]])
