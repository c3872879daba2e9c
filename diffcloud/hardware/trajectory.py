"""Tool trajectories, the limits they must keep, and the controller that follows them with Cartesian velocities.

The arm takes velocities, not positions: at each tick the command is the trajectory's own velocity plus a proportional
correction of the position error, held within speed and acceleration limits. The reference sends 0.4 error / 0.1 s and no
velocity of its own, which lags behind a moving target by a quarter of a second's motion; its gain is kept.
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
"""1/s: the reference's 0.4 per 0.1 s."""
_APPROACH_RATE_HZ = 20.0


@dataclass(frozen=True)
class Limits:
    """What the tool may do. The default box is the reference's workspace; its trajectories are faster than the default
    speed, which is one that a person can react to."""

    box_low_m: tuple[float, float, float] = (0.40, -0.36, 0.055)
    box_high_m: tuple[float, float, float] = (0.95, 0.36, 0.95)
    speed_m_s: float = 0.1
    acceleration_m_s2: float = 2.5
    force_N: float = 30.0
    """Of the external wrench at the tool, beyond what it was at rest."""
    torque_Nm: float = 10.0
    preload_N: float = 15.0
    """Of the external wrench at rest: more is no offset of the estimate, but something that the tool presses on."""
    preload_Nm: float = 5.0
    tracking_error_m: float = 0.08
    """Farther from the trajectory than this, something holds the arm."""
    box_slack_m: float = 0.01
    """The measured tool may leave the box by this much, since a controller overshoots."""

    def __post_init__(self) -> None:
        if not (np.array(self.box_low_m) < self.box_high_m).all():
            raise LimitError(f"The box needs low < high on each axis, got {self.box_low_m} and {self.box_high_m}.")
        names = ("speed_m_s", "acceleration_m_s2", "force_N", "torque_Nm", "preload_N", "preload_Nm", "tracking_error_m")
        for name in names:
            if not getattr(self, name) > 0:
                raise LimitError(f"The limit {name} must be positive, got {getattr(self, name)}.")

    def outside(self, positions: Floats, slack_m: float = 0.0) -> NDArray[np.bool_]:
        """Which positions [..., 3] leave the box by more than `slack_m`."""
        low, high = np.array(self.box_low_m) - slack_m, np.array(self.box_high_m) + slack_m
        return np.asarray(~((positions >= low) & (positions <= high)).all(axis=-1))


@dataclass(frozen=True)
class ToolTrajectory:
    """Keyframes of the tool, joined by straight lines.

    Raises:
        HardwareError: fewer than two keyframes, times that do not increase from 0, or numbers that are not finite.
    """

    times: Floats
    """[T] since the start [s]."""
    positions: Floats
    """[T, 3] in the robot's base frame [m]."""
    gripper: Floats | None = None
    """[T] 0 open to 1 closed."""

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
        """[3] where the tool should be; the ends are held."""
        return np.array([np.interp(t_s, self.times, self.positions[:, axis]) for axis in range(3)])

    def gripper_at(self, t_s: float) -> float | None:
        """Of the last keyframe that has passed: a gripper closes at once, not over seconds."""
        if self.gripper is None:
            return None
        return float(self.gripper[max(0, int(np.searchsorted(self.times, t_s + 1e-9, side="right")) - 1)])

    @property
    def velocities(self) -> Floats:
        """[T - 1, 3] of the segments [m/s]."""
        return np.diff(self.positions, axis=0) / np.diff(self.times)[:, None]

    @property
    def accelerations(self) -> Floats:
        """[T, 3] at the keyframes, from rest and to rest, spread over the segments beside them [m/s²]."""
        velocity = np.concatenate([np.zeros((1, 3)), self.velocities, np.zeros((1, 3))])
        span = np.diff(self.times)
        beside = np.concatenate([span[:1], (span[:-1] + span[1:]) / 2, span[-1:]])
        return np.diff(velocity, axis=0) / beside[:, None]


def check_trajectory(trajectory: ToolTrajectory, limits: Limits) -> None:
    """Refuse a motion before it starts.

    Raises:
        LimitError: a keyframe outside the box, or too much speed or acceleration; names keyframe, value and limit.
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
    """Refuse a control rate at which the correction of an error is larger than twice the error.

    Raises:
        LimitError: says which rates and gains are stable.
    """
    if not gain < 2 * rate_hz:
        raise LimitError(
            f"A gain of {gain:g} 1/s at {rate_hz:g} Hz overshoots for ever: the arm needs control_rate_hz (rig.yaml) "
            f"above {gain / 2:g} Hz, or a gain below {2 * rate_hz:g} 1/s."
        )


def approach(start: Floats, goal: Floats, *, speed_m_s: float) -> ToolTrajectory | None:
    """A straight minimum-jerk motion from `start` to `goal` [3] that peaks at `speed_m_s`; None where they are one."""
    distance = float(np.linalg.norm(goal - start))
    if distance < 1e-3:
        return None
    duration = max(1.875 * distance / speed_m_s, 0.5)  # 15/8: peak over mean speed of minimum jerk
    times = np.linspace(0.0, duration, max(3, round(duration * _APPROACH_RATE_HZ) + 1))
    s = times / duration
    along = s**3 * (10 - 15 * s + 6 * s**2)
    return ToolTrajectory(times, start + along[:, None] * (goal - start))


class VelocityController:
    """Closed loop: positions in, velocities out, one call per tick."""

    def __init__(self, trajectory: ToolTrajectory, limits: Limits, *, period_s: float, gain: float = DEFAULT_GAIN) -> None:
        check_control_rate(1 / period_s, gain)
        self._trajectory, self._limits, self._period, self._gain = trajectory, limits, period_s, gain
        self._last = np.zeros(3)

    def velocity(self, t_s: float, position: Floats) -> Floats:
        """[3] to command at `t_s` for a tool measured at `position` [3] [m/s]."""
        # the velocity of the coming period, not of this instant: it is held until the next tick
        ahead = self._trajectory.position(t_s + self._period)
        here = self._trajectory.position(t_s)
        wanted = (ahead - here) / self._period + self._gain * (here - position)
        change = _clipped(wanted - self._last, self._limits.acceleration_m_s2 * self._period)
        self._last = _clipped(self._last + change, self._limits.speed_m_s)
        return self._last.copy()


def read_trajectory(path: Path, *, rate_hz: float = 10.0, stretch_time: float = 1.0) -> ToolTrajectory:
    """Keyframes from a file.

    Args:
        path: CSV with the columns x, y, z [m] and optionally t_s [s] and gripper; or NPY [T, 3], as the published
            trajectories are.
        rate_hz: of keyframes without times.
        stretch_time: 2 makes the motion half as fast.

    Raises:
        HardwareError: missing, not numbers, or no trajectory.
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
