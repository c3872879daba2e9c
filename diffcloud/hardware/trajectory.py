"""Tool trajectories, their limits, and the velocity controller that follows them.

At each tick, the controller sends the trajectory's velocity plus a proportional correction of the position error,
limited in speed and acceleration. The reference implementation has the same gain, but no feed-forward velocity: it
sends 0.4 error / 0.1 s, so it lags behind a moving target by 0.25 s.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError, HardwareError, LimitError
from diffcloud.io.pickles import load_npy
from diffcloud.io.tables import numbers, read_csv

Floats = NDArray[np.float64]

DEFAULT_GAIN = 4.0
"""Gain of the position error [1/s]. The reference has 0.4 per 0.1 s."""
_APPROACH_RATE_HZ = 20.0


@dataclass(frozen=True)
class Limits:
    """Limits of the tool. The default box is the reference's workspace. The default speed is lower than the
    reference's, so that a person can react."""

    box_low_m: tuple[float, float, float] = (0.40, -0.36, 0.055)
    box_high_m: tuple[float, float, float] = (0.95, 0.36, 0.95)
    speed_m_s: float = 0.1
    acceleration_m_s2: float = 2.5
    force_N: float = 30.0
    """Largest change of the external force at the tool since rest."""
    torque_Nm: float = 10.0
    preload_N: float = 15.0
    """Largest external force at rest. A larger one is contact, not an offset of the estimate."""
    preload_Nm: float = 5.0
    tracking_error_m: float = 0.08
    """Largest distance from the trajectory. A larger one means that something blocks the arm."""
    box_slack_m: float = 0.01
    """Tolerance of the box for the measured tool position, since a controller overshoots."""

    def __post_init__(self) -> None:
        if not (np.array(self.box_low_m) < self.box_high_m).all():
            raise LimitError(f"The box needs low < high on each axis, got {self.box_low_m} and {self.box_high_m}.")
        names = ("speed_m_s", "acceleration_m_s2", "force_N", "torque_Nm", "preload_N", "preload_Nm", "tracking_error_m")
        for name in names:
            if not getattr(self, name) > 0:
                raise LimitError(f"The limit {name} must be positive, got {getattr(self, name)}.")

    def outside(self, positions: Floats, slack_m: float = 0.0) -> NDArray[np.bool_]:
        """Mask of positions [..., 3] that are outside the box by more than `slack_m`."""
        low, high = np.array(self.box_low_m) - slack_m, np.array(self.box_high_m) + slack_m
        return np.asarray(~((positions >= low) & (positions <= high)).all(axis=-1))


@dataclass(frozen=True)
class ToolTrajectory:
    """Keyframes of the tool, connected by straight lines.

    Raises:
        HardwareError: there are fewer than two keyframes, times do not increase from 0, or numbers are not finite.
    """

    times: Floats
    """[T] since the start [s]."""
    positions: Floats
    """[T, 3] in the robot's base frame [m]."""
    gripper: Floats | None = None
    """[T] from 0 (open) to 1 (closed)."""

    def __post_init__(self) -> None:
        count = len(self.times)
        if count < 2 or self.positions.shape != (count, 3):
            raise HardwareError(
                f"A trajectory needs at least 2 keyframes [T, 3], got {count} times and {list(self.positions.shape)}."
            )
        if not (np.isfinite(self.times).all() and np.isfinite(self.positions).all()):
            raise HardwareError("A trajectory holds NaN or infinite numbers.")
        if self.times[0] != 0 or (np.diff(self.times) <= 0).any():
            raise HardwareError("Keyframe times must start at 0 and increase; sort the rows and remove repeats.")
        if self.gripper is not None:
            wrong = self.gripper.shape != (count,) or not ((self.gripper >= 0) & (self.gripper <= 1)).all()
            if wrong:
                raise HardwareError(f"gripper must be {count} numbers from 0 (open) to 1 (closed).")

    @property
    def duration_s(self) -> float:
        return float(self.times[-1])

    def position(self, t_s: float) -> Floats:
        """[3] desired tool position. Before the start and after the end, the position at the ends."""
        return np.array([np.interp(t_s, self.times, self.positions[:, axis]) for axis in range(3)])

    def gripper_at(self, t_s: float) -> float | None:
        """Gripper state of the last keyframe that has passed. It changes at once, without interpolation."""
        if self.gripper is None:
            return None
        return float(self.gripper[max(0, int(np.searchsorted(self.times, t_s + 1e-9, side="right")) - 1)])

    @property
    def velocities(self) -> Floats:
        """[T - 1, 3] velocities of the segments [m/s]."""
        return np.diff(self.positions, axis=0) / np.diff(self.times)[:, None]

    @property
    def accelerations(self) -> Floats:
        """[T, 3] accelerations averaged around each keyframe, from rest and to rest [m/s²]."""
        velocity = np.concatenate([np.zeros((1, 3)), self.velocities, np.zeros((1, 3))])
        span = np.diff(self.times)
        beside = np.concatenate([span[:1], (span[:-1] + span[1:]) / 2, span[-1:]])
        return np.diff(velocity, axis=0) / beside[:, None]


def check_trajectory(trajectory: ToolTrajectory, limits: Limits) -> None:
    """Check a trajectory against the limits of the tool.

    Raises:
        LimitError: a keyframe is outside the box, or speed or acceleration is too high.
    """
    outside = np.flatnonzero(limits.outside(trajectory.positions))
    if len(outside):
        first = int(outside[0])
        position = trajectory.positions[first]
        scale = " These look like millimetres." if np.abs(position).max() > 20 else ""
        raise LimitError(
            f"Keyframe {first} (t = {trajectory.times[first]:.2f} s) at {_triple(position)} m lies outside the workspace "
            f"box {_triple(limits.box_low_m)} to {_triple(limits.box_high_m)}; {len(outside)} keyframes do.{scale} Move "
            "the trajectory, or widen workspace_m in rig.yaml if the arm is free to go there."
        )
    speed = np.linalg.norm(trajectory.velocities, axis=1)
    if speed.max() > limits.speed_m_s:
        segment = int(speed.argmax())
        raise LimitError(
            f"Between keyframes {segment} and {segment + 1} (t = {trajectory.times[segment]:.2f} s) the tool moves at "
            f"{speed[segment]:.3f} m/s; the limit is {limits.speed_m_s:g} m/s. Multiply time_scale in "
            f"rig.yaml by {1.05 * speed[segment] / limits.speed_m_s:.2f}, or raise speed_m_s there."
        )
    acceleration = np.linalg.norm(trajectory.accelerations, axis=1)
    if acceleration.max() > limits.acceleration_m_s2:
        keyframe = int(acceleration.argmax())
        slower = 1.05 * np.sqrt(acceleration[keyframe] / limits.acceleration_m_s2)
        raise LimitError(
            f"At keyframe {keyframe} (t = {trajectory.times[keyframe]:.2f} s) the tool accelerates with "
            f"{acceleration[keyframe]:.2f} m/s²; the limit is {limits.acceleration_m_s2:g} m/s². Multiply "
            f"time_scale in rig.yaml by {slower:.2f}, or raise acceleration_m_s2 there."
        )


def check_control_rate(rate_hz: float, gain: float = DEFAULT_GAIN) -> None:
    """Refuse a control rate at which the correction overshoots by more than the error, which is unstable.

    Raises:
        LimitError: the message lists stable rates and gains.
    """
    if not gain < 2 * rate_hz:
        raise LimitError(
            f"A gain of {gain:g} 1/s at {rate_hz:g} Hz overshoots for ever: the arm needs control_rate_hz (rig.yaml) "
            f"above {gain / 2:g} Hz, or a gain below {2 * rate_hz:g} 1/s."
        )


def approach(start: Floats, goal: Floats, *, speed_m_s: float) -> ToolTrajectory | None:
    """Plan a straight minimum-jerk motion from `start` to `goal` [3] with peak `speed_m_s`. None if they coincide."""
    distance = float(np.linalg.norm(goal - start))
    if distance < 1e-3:
        return None
    duration = max(1.875 * distance / speed_m_s, 0.5)  # 15/8: ratio of peak to mean speed of a minimum-jerk motion
    times = np.linspace(0.0, duration, max(3, round(duration * _APPROACH_RATE_HZ) + 1))
    s = times / duration
    along = s**3 * (10 - 15 * s + 6 * s**2)
    return ToolTrajectory(times, start + along[:, None] * (goal - start))


class VelocityController:
    """Closed-loop controller: maps measured positions to velocities, with one call per tick."""

    def __init__(self, trajectory: ToolTrajectory, limits: Limits, *, period_s: float, gain: float = DEFAULT_GAIN) -> None:
        check_control_rate(1 / period_s, gain)
        self._trajectory, self._limits, self._period, self._gain = trajectory, limits, period_s, gain
        self._last = np.zeros(3)

    def velocity(self, t_s: float, position: Floats) -> Floats:
        """Return the velocity command [3] [m/s] at `t_s` for a tool measured at `position` [3]."""
        # Use the mean velocity over the next period, because the command is valid until the next tick.
        ahead = self._trajectory.position(t_s + self._period)
        here = self._trajectory.position(t_s)
        wanted = (ahead - here) / self._period + self._gain * (here - position)
        change = _clipped(wanted - self._last, self._limits.acceleration_m_s2 * self._period)
        self._last = _clipped(self._last + change, self._limits.speed_m_s)
        return self._last.copy()


def read_trajectory(path: Path, *, rate_hz: float = 10.0, stretch_time: float = 1.0) -> ToolTrajectory:
    """Read keyframes from a file.

    Args:
        path: CSV file with columns x, y, z [m], optionally t_s [s] and gripper. Or an NPY file [T, 3], as published.
        rate_hz: rate of the keyframes if the file has no times.
        stretch_time: factor on the times. With 2, the motion is half as fast.

    Raises:
        HardwareError: the file is missing, has no numbers, or is not a valid trajectory.
    """
    path = Path(path)
    if stretch_time <= 0 or rate_hz <= 0:
        raise HardwareError(f"Rate and time stretch must be positive, got {rate_hz:g} Hz and {stretch_time:g}.")
    times = gripper = None
    try:
        if path.suffix.lower() == ".npy":
            positions = np.asarray(load_npy(path), dtype=np.float64)
        else:
            table = read_csv(path, kind="trajectory", error=EpisodeError)

            def columns(*names: str) -> Floats:
                return numbers(table, names, place=str(path), error=EpisodeError)

            positions = columns("x", "y", "z")
            times = columns("t_s")[:, 0] if "t_s" in table.columns else None
            gripper = columns("gripper")[:, 0] if "gripper" in table.columns else None
    except EpisodeError as error:
        raise HardwareError(str(error)) from error
    except (OSError, ValueError, TypeError) as error:
        raise HardwareError(f"{path} is not a readable trajectory: {error}.") from error
    if times is None:
        times = np.arange(len(positions)) / rate_hz
    try:
        return ToolTrajectory((times - times[:1]) * stretch_time, positions, gripper)
    except HardwareError as error:
        raise HardwareError(f"{path}: {error}") from error


def _clipped(vector: Floats, length: float) -> Floats:
    size = float(np.linalg.norm(vector))
    return vector if size <= length else vector * (length / size)


def _triple(values: object) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in np.asarray(values, dtype=np.float64)) + ")"
