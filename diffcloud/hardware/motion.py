"""The control loop: measure, check, command, and nothing else; it waits for no disk and no camera.

The way home, the approach and the recorded trajectory run through one loop, with the same checks. The arm is read about 50
times a second and commanded at the control rate. That the capture itself may hang is the business of `arm_process`, which
looks before each command whether the arm has been stopped meanwhile.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import LimitError
from diffcloud.hardware.arm_limits import ArmChecker, JointPath
from diffcloud.hardware.contact import Contact, at_rest
from diffcloud.hardware.devices import ArmReading, GuardedArm
from diffcloud.hardware.settings import CaptureSettings
from diffcloud.hardware.trajectory import Limits, ToolTrajectory, VelocityController, approach

Floats = NDArray[np.float64]

_LOG_RATE_HZ = 50.0
"""The arm is read about this often: joint angles are interpolated to the images' times, and limits are checked."""
_CATCH_UP = 1.5
"""On the way home a correction may make joints this much faster than the path's fastest joint at its fastest."""
_JOINT_ERROR_RAD = 0.15
"""Farther from its path home than this, something holds the arm."""
_GRIPPER_WAIT_S = 3.0
_GRIPPER_STILL = 25
"""Readings without a change after which a gripper has arrived, on its target or on what it holds."""


@dataclass(frozen=True)
class Motion:
    """An arm, and what it must keep to."""

    arm: GuardedArm
    checker: ArmChecker
    limits: Limits
    settings: CaptureSettings
    check: Callable[[], None]
    """Raises when the capture is to end: a signal."""


class _Follower(Protocol):
    duration_s: float

    def check(self, t: float, reading: ArmReading) -> None: ...

    def command(self, t: float, reading: ArmReading) -> None: ...


class ToolFollower:
    """Follows a trajectory of the tool by Cartesian velocities.

    Args:
        start: reading of the arm at rest, before it.
    """

    def __init__(self, motion: Motion, name: str, trajectory: ToolTrajectory, start: ArmReading, contact: Contact) -> None:
        self._arm, self._limits, self._contact, self._name = motion.arm, motion.limits, contact, name
        self._trajectory, self._watch = trajectory, motion.checker.watch(name, start)
        self._controller = VelocityController(
            trajectory, motion.limits, period_s=1 / motion.settings.rate_hz, gain=motion.settings.gain
        )
        self._gripper: float | None = None
        self.duration_s = trajectory.duration_s
        self.largest_error_m = 0.0

    def check(self, t: float, reading: ArmReading) -> None:
        """Raises:
        LimitError: contact, a limit of the arm, or too far from the trajectory.
        """
        self._contact.check(f"At t = {t:.2f} s of the {self._name}", reading.wrench)
        self._watch.check(t, reading)
        error = float(np.linalg.norm(reading.tool_position_m - self._trajectory.position(t)))
        self.largest_error_m = max(self.largest_error_m, error)
        if not error <= self._limits.tracking_error_m:
            raise LimitError(
                f"At t = {t:.2f} s the tool is {1000 * error:.0f} mm from the trajectory; the limit is "
                f"{1000 * self._limits.tracking_error_m:.0f} mm. Something holds it, or the motion is too fast."
            )

    def command(self, t: float, reading: ArmReading) -> None:
        """The gripper where its state changes, and the velocity."""
        gripper = self._trajectory.gripper_at(t)
        if gripper is not None and gripper != self._gripper:
            self._arm.set_gripper(gripper)
            self._gripper = gripper
        self._arm.send_velocity(self._controller.velocity(t, reading.tool_position_m))


class JointFollower:
    """Follows a path in joint space by joint velocities."""

    def __init__(self, motion: Motion, name: str, path: JointPath, start: ArmReading, contact: Contact) -> None:
        self._arm, self._contact, self._name, self._path = motion.arm, contact, name, path
        self._watch = motion.checker.watch(name, start, returning=True)
        self._fastest = min(_CATCH_UP * path.fastest_rad_s, motion.checker.arm_limits.joint_speed_rad_s)
        self._period, self._gain = 1 / motion.settings.rate_hz, motion.settings.gain
        self.duration_s = path.duration_s

    def check(self, t: float, reading: ArmReading) -> None:
        """Raises:
        LimitError: contact, a limit of the arm, or too far from the path.
        """
        self._contact.check(f"At t = {t:.2f} s of the {self._name}", reading.wrench)
        self._watch.check(t, reading)
        error = np.abs(reading.joints_rad - self._path.at(t))
        if not error.max() <= _JOINT_ERROR_RAD:
            worst = int(error.argmax())
            raise LimitError(
                f"At t = {t:.2f} s of the {self._name} joint {worst + 1} is {np.rad2deg(error[worst]):.1f}° from its path; "
                f"the limit is {np.rad2deg(_JOINT_ERROR_RAD):.1f}°. Something holds it."
            )

    def command(self, t: float, reading: ArmReading) -> None:
        """The path's velocity of the coming period, and a correction."""
        ahead, here = self._path.at(t + self._period), self._path.at(t)
        wanted = (ahead - here) / self._period + self._gain * (here - reading.joints_rad)
        # the whole vector: clipped joint by joint, the arm would leave the path's direction
        largest = float(np.abs(wanted).max())
        self._arm.send_joint_velocity(wanted if largest <= self._fastest else wanted * (self._fastest / largest))


def go_to_start(motion: Motion, trajectory: ToolTrajectory, tell: Callable[[str], None]) -> tuple[ArmReading, Contact]:
    """Bring the arm to the first keyframe, over home if that is set, then the gripper to its first state.

    Everything that will move is planned and checked before anything does.

    Returns:
        The arm at rest, ready for the trajectory.

    Raises:
        LimitError: the plan breaks a limit, or the motion does.
        HardwareError: the arm is in fault, driven by somebody else, or lost.
    """
    arm, limits, checker = motion.arm, motion.limits, motion.checker
    speed = min(motion.settings.approach_speed_m_s, limits.speed_m_s)
    arm.prepare()
    rest, contact = at_rest(arm, limits)
    checker.check_tool_frame(rest)
    if motion.settings.go_home:
        path = checker.plan_home(arm.home_joints(), rest, speed_m_s=speed)
        plan_motion(checker, trajectory, checker.at(path.joints_rad[-1], rest), speed_m_s=speed)
        tell(f"moving home, {path.duration_s:.1f} s")
        run(motion, JointFollower(motion, "way home", path, rest, contact))
        arm.prepare()
        rest, contact = at_rest(arm, limits)
    way = plan_motion(checker, trajectory, rest, speed_m_s=speed)
    if way is not None:
        tell(f"approaching the first keyframe, {way.duration_s:.1f} s")
        run(motion, ToolFollower(motion, "approach", way, rest, contact))
    if trajectory.gripper is not None:  # not before: on the way here it must not let go, nor grasp
        _set_gripper(motion, float(trajectory.gripper[0]))
    arm.prepare()
    return at_rest(arm, limits)


def run(
    motion: Motion,
    follower: _Follower,
    *,
    start: float | None = None,
    heard: Callable[[float, ArmReading], None] = lambda _, __: None,
) -> None:
    """Drive the arm until the follower's duration and the settings' hold are over, then stop it.

    Args:
        start: of the motion, by time.monotonic(); None for now.
        heard: gets each reading and the monotonic time it was taken at; must not wait.
    """
    period = 1 / motion.settings.rate_hz
    readings_per_tick = max(1, round(_LOG_RATE_HZ * period))
    begun = time.monotonic() if start is None else start
    for index, t in enumerate(_ticks(begun, period / readings_per_tick, follower.duration_s + motion.settings.hold_s)):
        motion.check()
        before = time.monotonic()
        reading = motion.arm.read()
        heard((before + time.monotonic()) / 2, reading)
        follower.check(t, reading)
        if index % readings_per_tick == 0:
            follower.command(t, reading)
    motion.arm.stop()


def plan_motion(
    checker: ArmChecker, trajectory: ToolTrajectory, start: ArmReading, *, speed_m_s: float
) -> ToolTrajectory | None:
    """The approach from `start`, or None where it is at the first keyframe; it and the trajectory keep the limits.

    Args:
        speed_m_s: of the approach.

    Raises:
        LimitError: one of both breaks a limit: box, joints, reach, singularity, links.
    """
    position, limits = start.tool_position_m, checker.limits
    if limits.outside(position, limits.box_slack_m):
        raise LimitError(
            f"The tool is at {position.round(3).tolist()} m, outside the workspace box {limits.box_low_m} to "
            f"{limits.box_high_m}. Bring it inside first (--home, or by hand), or widen workspace_m in rig.yaml."
        )
    # a box is convex: between a start and a goal inside it the straight line is inside too
    way = approach(position, trajectory.positions[0], speed_m_s=min(speed_m_s, limits.speed_m_s))
    if way is not None:
        start = checker.check_trajectory("approach", way, start)
    checker.check_trajectory("trajectory", trajectory, start)
    return way


def _set_gripper(motion: Motion, position: float) -> None:
    """Set it, and wait until it has arrived or stands still; as long as it may take, where the arm does not say."""
    motion.arm.set_gripper(position)
    last, still = np.nan, 0
    end = time.monotonic() + _GRIPPER_WAIT_S
    while time.monotonic() < end and still < _GRIPPER_STILL:
        motion.check()
        value = motion.arm.read().gripper
        if value is not None:
            if abs(value - position) < 0.02:
                return
            still = still + 1 if abs(value - last) < 0.005 else 0
            last = value
        time.sleep(1 / _LOG_RATE_HZ)


def _ticks(start: float, period: float, duration: float) -> Iterator[float]:
    """Times since `start`, each yielded when it has come; a late loop skips none but does not wait."""
    count = int(np.ceil(duration / period)) + 1
    for index in range(count):
        ahead = start + index * period - time.monotonic()
        if ahead > 0:
            time.sleep(ahead)
        yield index * period if ahead > -period else time.monotonic() - start
