"""The control loop: measure, check, command. It never waits for a disk or a camera.

The motion home, the approach and the trajectory use the same loop and the same checks. The arm is read about 50 times a
second and commanded at the control rate. `arm_process` handles a capture that hangs, and refuses commands after a Stop.
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
"""Approximate reading rate of the arm. Joint angles are later interpolated to the times of images."""
_CATCH_UP = 1.5
"""Factor by which corrections may exceed the highest joint speed of the path home."""
_JOINT_ERROR_RAD = 0.15
"""Largest deviation from the path home. A larger one means that something blocks the arm."""
_GRIPPER_WAIT_S = 3.0
_GRIPPER_STILL = 25
"""Number of unchanged readings after which a gripper has reached its target or an object."""


@dataclass(frozen=True)
class Motion:
    """An arm with its limits and settings."""

    arm: GuardedArm
    checker: ArmChecker
    limits: Limits
    settings: CaptureSettings
    check: Callable[[], None]
    """Function that raises KeyboardInterrupt if a signal has ended the capture."""


class _Follower(Protocol):
    duration_s: float

    def check(self, t: float, reading: ArmReading) -> None: ...

    def command(self, t: float, reading: ArmReading) -> None: ...


class ToolFollower:
    """Follows a tool trajectory with Cartesian velocities.

    Args:
        start: reading of the arm at rest, before the motion.
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
        """Check one reading.

        Raises:
            LimitError: contact, a limit is exceeded, or the tool is too far from the trajectory.
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
        """Send the velocity, and the gripper command if its state changes."""
        gripper = self._trajectory.gripper_at(t)
        if gripper is not None and gripper != self._gripper:
            self._arm.set_gripper(gripper)
            self._gripper = gripper
        self._arm.send_velocity(self._controller.velocity(t, reading.tool_position_m))


class JointFollower:
    """Follows a path in joint space with joint velocities."""

    def __init__(self, motion: Motion, name: str, path: JointPath, start: ArmReading, contact: Contact) -> None:
        self._arm, self._contact, self._name, self._path = motion.arm, contact, name, path
        self._watch = motion.checker.watch(name, start, returning=True)
        self._fastest = min(_CATCH_UP * path.fastest_rad_s, motion.checker.arm_limits.joint_speed_rad_s)
        self._period, self._gain = 1 / motion.settings.rate_hz, motion.settings.gain
        self.duration_s = path.duration_s

    def check(self, t: float, reading: ArmReading) -> None:
        """Check one reading.

        Raises:
            LimitError: contact, a limit is exceeded, or a joint is too far from the path.
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
        """Send the path's velocity for the next period, plus a proportional correction."""
        ahead, here = self._path.at(t + self._period), self._path.at(t)
        wanted = (ahead - here) / self._period + self._gain * (here - reading.joints_rad)
        # Scale the whole vector. Clipping single joints would change the direction of the motion.
        largest = float(np.abs(wanted).max())
        self._arm.send_joint_velocity(wanted if largest <= self._fastest else wanted * (self._fastest / largest))


def go_to_start(motion: Motion, trajectory: ToolTrajectory, tell: Callable[[str], None]) -> tuple[ArmReading, Contact]:
    """Move the arm to the first keyframe, via home if requested, and the gripper to its first state.

    All motions are planned and checked before the arm moves.

    Returns:
        Reading and contact reference of the arm at rest, ready for the trajectory.

    Raises:
        LimitError: a limit is exceeded by the plan or during the motion.
        HardwareError: the arm is in fault, under manual control, or does not answer.
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
    if trajectory.gripper is not None:  # only now, so that the gripper neither drops nor grasps anything on the way
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
    """Control the arm for the follower's duration plus the hold time, then stop it.

    Args:
        start: start time by `time.monotonic()`. None: now.
        heard: called with the monotonic time and each reading. It must not block.
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
    """Plan the approach from `start` to the first keyframe (None if already there), and check it and the trajectory.

    Args:
        speed_m_s: speed of the approach.

    Raises:
        LimitError: one of them exceeds a limit (box, joints, reach, singularity, links).
    """
    position, limits = start.tool_position_m, checker.limits
    if limits.outside(position, limits.box_slack_m):
        raise LimitError(
            f"The tool is at {position.round(3).tolist()} m, outside the workspace box {limits.box_low_m} to "
            f"{limits.box_high_m}. Bring it inside first (--home, or by hand), or widen workspace_m in rig.yaml."
        )
    # The box is convex, so the straight line between two points inside is inside too.
    way = approach(position, trajectory.positions[0], speed_m_s=min(speed_m_s, limits.speed_m_s))
    if way is not None:
        start = checker.check_trajectory("approach", way, start)
    checker.check_trajectory("trajectory", trajectory, start)
    return way


def _set_gripper(motion: Motion, position: float) -> None:
    """Move the gripper and wait until it has arrived or stopped. If it reports no state, wait `_GRIPPER_WAIT_S`."""
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
    """Yield times since `start` when they have come. A late loop skips no tick, but does not wait."""
    count = int(np.ceil(duration / period)) + 1
    for index in range(count):
        ahead = start + index * period - time.monotonic()
        if ahead > 0:
            time.sleep(ahead)
        yield index * period if ahead > -period else time.monotonic() - start
