"""What an arm may do beyond its tool's point: joints, singularity, every link against table and surroundings, tool frame.

A trajectory gives the tool's position; where elbow and wrist go follows from it. Before anything moves, the joints are
predicted along the whole path: from the measured joint state, inverse kinematics step by step, the tool keeping its
measured orientation, each step the shortest in joint space. An arm with more joints than it needs may resolve its freedom
otherwise, so this is a forecast; what is measured while it moves is held against the same limits.

The tool frame that is configured on the arm is not read but compared: where the arm reports its tool must be where its
joints and the description put it. That shows a wrong tool frame, a wrong description and a joint log of another arm alike.
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

if TYPE_CHECKING:  # brings torch, which the arm's own process, importing this package, neither needs nor waits for
    from diffcloud.sensing.robot import Robot

Floats = NDArray[np.float64]

_STEP_M = 0.005
"""Between predicted poses of the tool."""
_BASE_M = 0.1
"""Half the width of the base, which stands at the origin."""
_ELBOW_M = 0.76
"""Height of a Gen3's elbow when its upper arm points up [m]."""
_SPEED_WINDOW_S = 0.4
"""Joint speeds are measured over this long; a reading's moment is known to some 20 ms."""
_SPEED_SLACK = 1.1
"""A measured joint may be this much faster than a planned one: it also corrects errors, and its speed is known to 5 %."""
_NOISE = 2e-3
"""m and rad: so much a motion that comes back into the limits may go outwards in between."""
_TABLE = 8
"""Place of the table among the criteria of `ArmChecker.excess`: the third face of the links' space."""


@dataclass(frozen=True)
class ArmLimits:
    """What joints and links may do."""

    table_m: float = 0.0
    """Height of the table in the base frame: no moving link may come below it [m]."""
    clearance_m: float = 0.01
    """A planned path stays this much higher, and this much inside the arm's space."""
    margin_m: float = 0.15
    """Links may reach this far beyond the workspace box and the base: half a wrist, and fingers beyond the tool's point."""
    joint_margin_rad: float = float(np.deg2rad(5.0))
    """A planned path stays this far from the ends of the joints; a measured one, half as far."""
    joint_speed_rad_s: float = 1.2
    """The makers' limits are 1.22 (wrist) and 1.40."""
    singular_value: float = 0.05
    """Least of the tool's Jacobian (metres and radians per radian). Nearer to a singularity, a small motion of the tool
    needs a large one of the joints."""
    turn_rad: float = float(np.deg2rad(5.0))
    """The tool may turn by this much while it should keep its orientation."""
    tool_offset_m: float = 0.01
    """Between the tool that the arm reports and the one that its joints and the description give."""
    tool_turn_rad: float = float(np.deg2rad(3.0))

    def __post_init__(self) -> None:
        for name in ("margin_m", "joint_speed_rad_s", "singular_value", "turn_rad", "tool_offset_m", "tool_turn_rad"):
            if not getattr(self, name) > 0:
                raise LimitError(f"The limit {name} must be positive, got {getattr(self, name)}.")


@dataclass(frozen=True)
class JointPath:
    """Joints over time, straight lines in joint space between the rows."""

    times: Floats
    """[T] since the start [s]."""
    joints_rad: Floats
    """[T, J]."""

    @property
    def duration_s(self) -> float:
        return float(self.times[-1])

    @property
    def fastest_rad_s(self) -> float:
        """Of any joint at any time."""
        return float((np.abs(np.diff(self.joints_rad, axis=0)) / np.diff(self.times)[:, None]).max())

    def at(self, t_s: float) -> Floats:
        """[J] the ends are held."""
        return np.array([np.interp(t_s, self.times, column) for column in self.joints_rad.T])


class ArmChecker:
    """Holds planned and measured joint states against the limits.

    Args:
        robot: description of the arm with its gripper, in the arm's base frame.
        limits: of the tool; the workspace box is also the core of the space that the links may use.

    Raises:
        LimitError: the description has no surfaces of links that move, or a joint of the arm without limits that is not
            one that turns without end.
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
        """Compare the reported tool with the one that joints and description give.

        Raises:
            LimitError: they differ; says by how much, in the reported tool's frame, and what to look at.
        """
        if not np.isfinite([*reading.joints_rad, *reading.tool_position_m, *reading.tool_quaternion]).all():
            raise LimitError(f"The arm reports no numbers for its joints or its tool: {reading}.")
        if len(reading.joints_rad) != len(self._ends):
            raise LimitError(
                f"The arm has {len(reading.joints_rad)} joints, the description {self.robot.description.name} has "
                f"{len(self._ends)}: name the description of this arm, urdf in rig.yaml."
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
        """[T', J] joints that bring the tool from `reading` along `positions` [T, 3] [m], without turning it.

        Returns:
            The joints up to the first position that is out of reach, and why that one is; None where all are reached.
        """
        tool = self.robot.tool_pose(reading.joints_rad)
        # the prediction is of the described arm, which may stand some millimetres beside the measured one
        positions = positions + (tool[:3, 3] - reading.tool_position_m)
        joints = reading.joints_rad
        found: list[Floats] = []
        for position in positions:  # each from the one before: the arm goes there in this order
            try:
                joints = self.robot.inverse_kinematics(position, rotations=tool[:3, :3], start_rad=joints)
            except RobotError as error:
                return np.array(found), str(error)
            found.append(joints)
        return np.array(found), None

    def check_trajectory(self, name: str, trajectory: ToolTrajectory, reading: ArmReading) -> ArmReading:
        """Refuse a trajectory that would break a limit on the way.

        Args:
            name: of the motion, for the message.
            reading: of the arm at its start.

        Returns:
            What the arm will measure at the end, to check what comes after.

        Raises:
            LimitError: says when, which joint or link, and by how much.
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
        """A straight minimum-jerk path in joint space, on which no point of the arm is faster than `speed_m_s`.

        It may begin outside the limits (a parked arm is folded beyond its joints' margins, and outside the box), but then
        only comes back into them; the table is no such limit.

        Raises:
            LimitError: it would leave the limits, or leave them farther.
        """
        home = self._nearest(home_rad, reading.joints_rad)
        s = np.linspace(0.0, 1.0, 101)
        joints = reading.joints_rad + s[:, None] * (home - reading.joints_rad)
        closed = np.full(len(s), _known(reading.gripper))
        self._check("way home", s, joints, closed, self.robot.tool_pose(joints)[:, :3, 3], returning=True)
        steps = [np.linalg.norm(np.diff(points, axis=0), axis=-1).max() for points in self._points(joints, closed).values()]
        path_m = float(max(steps)) / s[1]  # of the fastest point, had it its greatest speed all the way
        turn = float(np.abs(home - reading.joints_rad).max())
        # 15/8: peak over mean speed of minimum jerk
        duration = max(1.875 * path_m / speed_m_s, 1.875 * turn / self.arm_limits.joint_speed_rad_s, 0.5)
        eased = s**3 * (10 - 15 * s + 6 * s**2)
        return JointPath(s * duration, reading.joints_rad + eased[:, None] * (home - reading.joints_rad))

    def at(self, joints_rad: Floats, reading: ArmReading) -> ArmReading:
        """What the arm will measure with joints [J], if all else stays as in `reading`."""
        tool = self.robot.tool_pose(joints_rad)
        quaternion = Rotation.from_matrix(tool[:3, :3]).as_quat(scalar_first=True)
        return ArmReading(joints_rad, tool[:3, 3], quaternion, reading.gripper, reading.wrench)

    def watch(self, name: str, start: ArmReading, *, returning: bool = False) -> ArmWatch:
        """Checks for the readings of one motion.

        Args:
            returning: it may begin outside the limits, if it only comes back.
        """
        return ArmWatch(self, name, start, returning=returning)

    def excess(self, joints_rad: Floats, gripper: Floats, positions: Floats, *, slack: float) -> Floats:
        """[T, 12 + J] how far tool and links [m, six faces each] and joints [rad] are beyond their limits; negative inside.

        Args:
            gripper: [T] 0 open to 1 closed.
            positions: [T, 3] of the tool [m].
            slack: 0 for a planned path, 1 for a measured one, which may use the margins (half of a joint's).
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
        """[J, 2] of the joints, with the margins of `excess`."""
        return self._ends + np.array([1.0, -1.0]) * self.arm_limits.joint_margin_rad * (1 - slack / 2)

    def describe(self, criterion: int, joints_rad: Floats, gripper: float, position: Floats) -> str:
        """What is wrong at one state [J], where `excess` says that this criterion is exceeded."""
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
        """[...] least singular value of the tool's Jacobian at joints [..., J]."""
        return np.asarray(np.linalg.svd(self.robot.jacobian(joints_rad), compute_uv=False)[..., -1], dtype=np.float64)

    def _check(
        self, name: str, times: Floats, joints: Floats, gripper: Floats, positions: Floats, *, returning: bool = False
    ) -> None:
        excess = self.excess(joints, gripper, positions, slack=0.0)
        allowed = np.zeros_like(excess)
        if returning:  # beyond a limit by no more than the path was before; in the table no part of it may be
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
        if returning:  # in joint space a singularity is a place like others
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
        """[J] of each joint's target, the turn nearest to where the joint is that a planned path may go to; where there is
        none, one between the joint's ends, or else any: `_check` refuses those."""
        nearest = np.round((joints_rad - target_rad) / (2 * np.pi))
        turns = nearest
        for ends in (self._ends, self._kept_ends(slack=0.0)):
            low, high = (ends - target_rad[:, None]).T / (2 * np.pi)
            least, most = np.ceil(low), np.floor(high)
            turns = np.where(least <= most, np.clip(nearest, least, most), turns)
        return np.asarray(target_rad + 2 * np.pi * turns)

    def _points(self, joints_rad: Floats, gripper: Floats) -> dict[str, Floats]:
        """[T, V, 3] corners of each link that moves [m]."""
        poses = self.robot.forward_kinematics(self.robot.configuration(joints_rad, gripper))
        placed = ((name, poses[:, self.robot.links.index(name)]) for name in self._moving)
        meshes = self.robot.description.meshes
        return {
            name: meshes[name].vertices @ np.swapaxes(pose[:, :3, :3], 1, 2) + pose[:, None, :3, 3] for name, pose in placed
        }

    @cached_property
    def _moving(self) -> tuple[str, ...]:
        """Links with a surface that are not fixed to the base, which stands on the table."""
        description = self.robot.description
        fixed = {description.root}
        for joint in description.joints:  # from the root outwards
            if joint.kind == "fixed" and joint.parent in fixed:
                fixed.add(joint.child)
        return tuple(name for name in description.meshes if name not in fixed)


class ArmWatch:
    """The readings of one motion against the limits."""

    def __init__(self, checker: ArmChecker, name: str, start: ArmReading, *, returning: bool) -> None:
        self._checker, self._name, self._returning = checker, name, returning
        self._orientation = _rotation(start)
        self._since: tuple[float, Floats] | None = None
        """When the joints' speed was last measured, and their angles [J] then."""
        self._allowed = np.zeros(len(start.joints_rad) + 12)
        if returning:
            self._allowed = np.maximum(self._excess(start), 0.0)
            self._allowed[_TABLE] = 0.0

    def check(self, t: float, reading: ArmReading) -> None:
        """Raises:
        LimitError: says which joint or link, and when.
        """
        checker, when = self._checker, f"At t = {t:.2f} s of the {self._name}"
        excess = self._excess(reading)
        kept = excess <= self._allowed + (_NOISE if self._returning else 0.0)  # NaN is not kept
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
        turned = (joints_rad - joints + np.pi) % (2 * np.pi) - np.pi  # a joint that turns without end may begin anew
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
    """Not known is taken as open, when the fingers reach farthest."""
    return 0.0 if gripper is None else gripper


def _rotation(reading: ArmReading) -> Rotation:
    return Rotation.from_quat(np.roll(reading.tool_quaternion, -1))


def _sample_times(trajectory: ToolTrajectory) -> Floats:
    """[T] the keyframes, and between them so many that the tool moves by no more than a step."""
    lengths = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
    counts = np.maximum(1, np.ceil(lengths / _STEP_M)).astype(int)
    pieces = [
        np.linspace(start, end, count, endpoint=False)
        for start, end, count in zip(trajectory.times[:-1], trajectory.times[1:], counts, strict=True)
    ]
    return np.concatenate([*pieces, trajectory.times[-1:]])
