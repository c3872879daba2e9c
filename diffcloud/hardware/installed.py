"""Check whether everything for a capture is installed and connected: packages, cameras, the arm."""

from __future__ import annotations

import importlib.util
import shutil
import socket
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from diffcloud.errors import HardwareError
from diffcloud.hardware.kinova import TCP_PORT, load_kortex
from diffcloud.hardware.realsense import connected_cameras

_SPARE_BYTES = 5 * 2**30
"""Disk space for half an hour of two cameras at 10 Hz."""


@dataclass(frozen=True)
class Check:
    """Result of one check."""

    name: str
    state: str
    """ok, missing or wrong."""
    detail: str


def check_installation(
    *, arm: str | None = None, folder: Path = Path("."), context: Any | None = None, arm_port: int = TCP_PORT
) -> list[Check]:
    """Check packages, cameras, arm and disk space. Nothing moves, and no device stays open.

    Args:
        arm: address of the arm. None skips the arm.
        folder: folder in which episodes would be written.
        context: an `rs.context`, by default the computer's own.
    """
    checks = [
        _package("opencv-contrib-python-headless", "images, calibration"),
        _package("rosbags", "import of ROS bags and MCAP files"),
    ]
    checks += _realsense(context)
    try:
        load_kortex()
        checks.append(Check("kortex_api", "ok", "the arm's client library"))
    except HardwareError as error:
        checks.append(Check("kortex_api", "missing", str(error)))
    if arm is not None:
        checks.append(_reachable(arm, arm_port))
    free = shutil.disk_usage(folder).free
    checks.append(Check("disk", "ok" if free > _SPARE_BYTES else "missing", f"{free / 2**30:.0f} GiB free in {folder}"))
    return checks


def _package(name: str, why: str) -> Check:
    try:
        return Check(name, "ok", f"{version(name)}: {why}")
    except PackageNotFoundError:
        return Check(name, "missing", f"{why}. pip install {name}")


def _realsense(context: Any | None) -> list[Check]:
    if importlib.util.find_spec("pyrealsense2") is None:
        return [Check("pyrealsense2", "missing", "depth cameras. pip install pyrealsense2")]
    try:
        found = connected_cameras(context)
    except HardwareError as error:
        return [Check("pyrealsense2", "missing", str(error))]
    checks = [_package("pyrealsense2", "depth cameras, playback of recordings")]
    if not found:
        return [*checks, Check("cameras", "missing", "no RealSense camera is connected: USB 3 cable, udev rules, power")]
    for camera in found:
        usb = camera.get("usb", "")
        slow = usb.startswith("2")
        label = f"{camera.get('name', 'camera')}, firmware {camera.get('firmware', 'unknown')}"
        advice = f", USB {usb}: too slow for two streams, use a USB 3 port and cable" if slow else ""
        checks.append(Check(f"camera {camera['serial']}", "missing" if slow else "ok", label + advice))
    return checks


def _reachable(address: str, port: int) -> Check:
    try:
        with socket.create_connection((address, port), timeout=2.0):
            return Check("arm", "ok", f"{address} answers on port {port}")
    except OSError as error:
        return Check("arm", "missing", f"{address}:{port} does not answer ({error}): power, cable, this computer's network")
