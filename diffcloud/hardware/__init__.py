"""Cameras and arm. Their own packages are imported when a device is opened, and never needed for anything else."""

from diffcloud.hardware.session import ArmReading, CameraFrame, CaptureReport, CaptureSettings, capture
from diffcloud.hardware.trajectory import Limits, ToolTrajectory, VelocityController, check_trajectory, read_trajectory

__all__ = [
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
