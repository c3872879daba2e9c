"""Drivers for arms and cameras of other makes: a user's own classes, named as module:Class.

A camera's class is called with its name in the episode and its serial number, and implements `devices.Camera`. An arm's
class is called with its address, and implements `devices.Arm`; it runs in the arm's own process (`arm_process`), which
watches it as it watches the Gen3's.
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
    """The arm at an address, in a process of its own.

    Raises:
        ConfigError: no such driver, or one that lacks a method.
        HardwareError: the driver could not connect.
    """
    _load(driver, Arm)  # here first, so that its faults are reported before a process is started
    return ArmProcess(partial(_make_arm, driver, address))


def make_camera(driver: str, name: str, serial: str, **options: Any) -> Camera:
    """A camera, not yet open.

    Args:
        options: width, height and fps that were asked for; a driver that cannot choose them ignores them.

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
    if here not in sys.path:  # as `python -m` does: a file beside the recordings is found
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
