"""What a capture asks of cameras and of an arm: `realsense`, `kinova` and `arm_process` keep these, tests bring others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from diffcloud.io.raw_episodes import CameraInfo

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class CameraFrame:
    """One pair of images."""

    time_s: float
    """When it was taken: of a live camera `time.monotonic()`, which nobody can set back; of a file, the file's clock."""
    depth: NDArray[np.uint16]
    """[H, W] aligned to colour, in units of the camera's depth scale."""
    color: NDArray[np.uint8] | None
    """[H, W, 3] red, green, blue."""


class Camera(Protocol):
    """A depth camera that delivers frames one after the other."""

    name: str

    def open(self) -> CameraInfo:
        """Start streaming. Raises HardwareError if it cannot."""

    def read(self, timeout_s: float) -> CameraFrame:
        """The next frame. Raises HardwareError if none comes in time."""

    def close(self) -> None:
        """Stop streaming; harmless twice."""


@dataclass(frozen=True)
class ArmReading:
    """What the arm measures."""

    joints_rad: Floats
    """[J]."""
    tool_position_m: Floats
    """[3] in the base frame."""
    tool_quaternion: Floats
    """[4] (w, x, y, z)."""
    gripper: float | None
    """0 open to 1 closed."""
    wrench: Floats
    """[6] external force [N] and torque [N·m] at the tool."""


class Arm(Protocol):
    """An arm under velocity control. Each call raises HardwareError on a fault or a lost connection."""

    joint_count: int

    def describe(self) -> dict[str, Any]:
        """Model and address, for episode.json."""

    def clear_faults(self) -> None:
        """Clear what can be cleared; the emergency stop must be released first."""

    def prepare(self) -> None:
        """Switch to velocity control. Refuses an arm in fault, and one that somebody else is driving."""

    def home_joints(self) -> Floats:
        """[J] joint angles of the arm's own home pose [rad]; nothing moves."""

    def read(self) -> ArmReading:
        """Measure."""

    def send_velocity(self, linear_m_s: Floats) -> None:
        """Move the tool with this velocity [3] in the base frame, without turning it, until the next command."""

    def send_joint_velocity(self, rad_s: Floats) -> None:
        """Move the joints with these velocities [J] until the next command."""

    def set_gripper(self, position: float) -> None:
        """Drive the gripper to 0 (open) .. 1 (closed); does not wait."""

    def stop(self) -> None:
        """Stop all motion; returns once the arm has confirmed it. Must work from another thread."""

    def emergency_stop(self) -> None:
        """Stop by the arm's emergency stop, after which it is in fault. Must work from another thread."""

    def close(self) -> None:
        """Disconnect; harmless twice."""


@runtime_checkable
class GuardedArm(Arm, Protocol):
    """An arm that is stopped although its user hangs, is suspended or dies (`arm_process.ArmProcess`).

    Velocities are refused from any Stop until the next `prepare`, whoever sent that Stop.
    """

    def halt(self) -> None:
        """Have Stop sent now, without waiting for the answer; may be called from a signal handler, at any moment."""
