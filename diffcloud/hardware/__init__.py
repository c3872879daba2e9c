"""Cameras and arm. The packages of their makers are imported only when a device is opened."""

from diffcloud.hardware.arm_limits import ArmLimits
from diffcloud.hardware.arm_process import ArmProcess
from diffcloud.hardware.devices import ArmReading, CameraFrame
from diffcloud.hardware.session import CaptureReport, capture
from diffcloud.hardware.settings import CaptureSettings
from diffcloud.hardware.trajectory import Limits, ToolTrajectory, VelocityController, check_trajectory, read_trajectory

__all__ = [
    "ArmLimits",
    "ArmProcess",
    "ArmReading",
    "CameraFrame",
    "CaptureReport",
    "CaptureSettings",
    "Limits",
    "ToolTrajectory",
    "VelocityController",
    "capture",
    "check_trajectory",
    "read_trajectory",
]
