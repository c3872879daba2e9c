"""Load the user's own drivers for arms and cameras, named as module:Class.

A camera class implements `devices.Camera` and is called with the camera's name and serial number. An arm class
implements `devices.Arm` and is called with the arm's address. It runs in a separate process with a watchdog
(`arm_process`), as the driver of the Gen3 does.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

from diffcloud.errors import ConfigError
from diffcloud.hardware.arm_process import ArmProcess
from diffcloud.hardware.devices import Arm, Camera


def open_arm(driver: str, address: str) -> ArmProcess:
    """Connect to the arm at an address, in a separate process.

    Raises:
        ConfigError: the driver does not exist, or lacks a method.
        HardwareError: the driver could not connect.
    """
    _load(driver, Arm)  # report errors of the driver before a process is started
    return ArmProcess(partial(_make_arm, driver, address))


def make_camera(driver: str, name: str, serial: str, **options: Any) -> Camera:
    """Create a camera that is not open yet.

    Args:
        options: requested width, height and fps. A driver that cannot set them ignores them.

    Raises:
        ConfigError: see `open_arm`.
    """
    camera: Camera = _load(driver, Camera)(name, serial, **options)
    return camera


def _make_arm(driver: str, address: str) -> Arm:
    arm: Arm = _load(driver, Arm)(address)
    return arm


def _load(driver: str, protocol: type) -> Callable[..., Any]:
    module, colon, name = driver.partition(":")
    if not (module and colon and name):
        raise ConfigError(f"A driver is named as module:Class, such as my_lab.arms:Franka, got {driver!r}.")
    here = os.getcwd()
    if here not in sys.path:  # find modules in the current folder, as `python -m` does
        sys.path.insert(0, here)
    try:
        found = getattr(importlib.import_module(module), name)
    except Exception as error:  # a module may raise anything while it is imported
        raise ConfigError(f"The driver {driver} cannot be imported ({type(error).__name__}: {error}).") from error
    methods = [key for key in vars(protocol) if not key.startswith("_") and callable(getattr(protocol, key))]
    missing = [key for key in methods if not callable(getattr(found, key, None))]
    if missing or not callable(found):
        raise ConfigError(
            f"The driver {driver} lacks {', '.join(missing) or 'a constructor'}; what a driver must do is described at "
            f"diffcloud.hardware.devices.{protocol.__name__}."
        )
    return found
