"""Interfaces of cameras and arms for a capture. `realsense`, `kinova` and `arm_process` implement them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from diffcloud.io.raw_episodes import CameraInfo

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class CameraFrame:
    """A depth image and optional colour image of one moment."""

    time_s: float
    """Capture time [s]. A live camera uses `time.monotonic()`, which nobody can set back; a file uses its own clock."""
    depth: NDArray[np.uint16]
    """[H, W] aligned to colour, in units of the camera's depth scale."""
    color: NDArray[np.uint8] | None
    """[H, W, 3] red, green, blue."""


class Camera(Protocol):
    """A depth camera."""

    name: str

    def open(self) -> CameraInfo:
        """Start streaming. Raises HardwareError if it cannot."""

    def read(self, timeout_s: float) -> CameraFrame:
        """Wait for the next frame. Raises HardwareError if none comes in time."""

    def close(self) -> None:
        """Stop streaming. Further calls have no effect."""


@dataclass(frozen=True)
class ArmReading:
    """One measurement of the arm."""

    joints_rad: Floats
    """[J]."""
    tool_position_m: Floats
    """[3] in the base frame."""
    tool_quaternion: Floats
    """[4] (w, x, y, z)."""
    gripper: float | None
    """From 0 (open) to 1 (closed). None if unknown."""
    wrench: Floats
    """[6] external force [N] and torque [N·m] at the tool."""


class Arm(Protocol):
    """An arm under velocity control. Each method raises HardwareError on a fault or a lost connection."""

    joint_count: int

    def describe(self) -> dict[str, Any]:
        """Return model and address, for episode.json."""

    def clear_faults(self) -> None:
        """Clear all faults that can be cleared. The emergency stop must be released first."""

    def prepare(self) -> None:
        """Switch to velocity control. Raises HardwareError if the arm is in fault or under manual control."""

    def home_joints(self) -> Floats:
        """Return the joint angles [J] of the arm's own home pose [rad], without moving."""

    def read(self) -> ArmReading:
        """Measure joints, tool pose, gripper and wrench."""

    def send_velocity(self, linear_m_s: Floats) -> None:
        """Move the tool with this velocity [3] in the base frame, without rotation, until the next command."""

    def send_joint_velocity(self, rad_s: Floats) -> None:
        """Move the joints with these velocities [J] until the next command."""

    def set_gripper(self, position: float) -> None:
        """Move the gripper to a position from 0 (open) to 1 (closed), without waiting."""

    def stop(self) -> None:
        """Stop all motion and wait for the arm's confirmation. Must work from another thread."""

    def emergency_stop(self) -> None:
        """Apply the arm's emergency stop. The arm is in fault afterwards. Must work from another thread."""

    def close(self) -> None:
        """Disconnect. Further calls have no effect."""


@runtime_checkable
class GuardedArm(Arm, Protocol):
    """An arm that is stopped even if its user process hangs, is suspended or dies (`arm_process.ArmProcess`).

    After any Stop, velocities are refused until the next `prepare`.
    """

    def halt(self) -> None:
        """Send Stop now without waiting for the answer. A signal handler may call this at any time."""
