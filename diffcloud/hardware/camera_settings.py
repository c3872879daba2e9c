"""What a RealSense camera is set to while it records: exposure and white balance that are held, laser, preset, pace.

An exposure that keeps adjusting changes, from one frame to the next, the noise of depth and where depth is missing. So by
default the camera finds it while it warms up, and then holds it. The settings are read back and kept in camera.json.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from diffcloud.errors import HardwareError, unknown_name

Pace = Literal["free", "master", "slave"]
_PACES: Mapping[Pace, int] = {"free": 0, "master": 1, "slave": 2}
_KEPT = (
    "enable_auto_exposure", "exposure", "gain", "enable_auto_white_balance", "white_balance", "emitter_enabled",
    "laser_power", "visual_preset", "inter_cam_sync_mode",
)  # fmt: skip
_HELD = (("enable_auto_exposure", ("exposure", "gain")), ("enable_auto_white_balance", ("white_balance",)))


@dataclass(frozen=True)
class CameraSettings:
    """What is asked for; None leaves what is set."""

    hold: bool = True
    """Exposure, gain and white balance stay where they are at the end of the warm-up."""
    preset: str | None = None
    """Visual preset of the depth sensor, such as high_accuracy."""
    laser_mw: float | None = None
    """Power of the projector [mW]; 0 switches it off."""
    pace: Pace | None = None
    """Of cameras that are wired for it, one is the master and the others follow its trigger."""


def apply(rs: Any, sensors: Mapping[str, Any], settings: CameraSettings, camera: str) -> None:
    """Before the warm-up: all that is not held.

    Args:
        sensors: "depth" and "color".
        camera: names it in messages.

    Raises:
        HardwareError: the camera has no such option or preset, or the value is beyond its range; says what it allows.
    """
    depth = sensors["depth"]
    if settings.preset is not None:
        presets = rs.rs400_visual_preset.__members__
        if settings.preset not in presets:
            raise HardwareError(f"Camera {camera}: " + unknown_name("preset", settings.preset, list(presets)))
        _set(rs, depth, "visual_preset", float(int(presets[settings.preset])), camera)
    if settings.laser_mw is not None:
        _set(rs, depth, "emitter_enabled", float(settings.laser_mw > 0), camera)
        if settings.laser_mw > 0:
            _set(rs, depth, "laser_power", settings.laser_mw, camera)
    if settings.pace is not None:
        _set(rs, depth, "inter_cam_sync_mode", float(_PACES[settings.pace]), camera)
    for sensor in sensors.values():  # an earlier program may have left them held
        for automatic, _ in _HELD:
            if sensor.supports(getattr(rs.option, automatic)):
                _set(rs, sensor, automatic, 1.0, camera)


def hold(rs: Any, sensors: Mapping[str, Any], camera: str) -> None:
    """After the warm-up: what the camera has found stays."""
    for sensor in sensors.values():
        for automatic, names in _HELD:
            if not sensor.supports(getattr(rs.option, automatic)):
                continue
            found = {name: _get(rs, sensor, name) for name in names if sensor.supports(getattr(rs.option, name))}
            _set(rs, sensor, automatic, 0.0, camera)
            for name, value in found.items():  # switching it off makes some firmware return to its defaults
                _set(rs, sensor, name, value, camera)


def read_back(rs: Any, sensors: Mapping[str, Any]) -> dict[str, float]:
    """Option -> value, such as depth.exposure [µs], of those that the camera has."""
    return {
        f"{kind}.{name}": _get(rs, sensor, name)
        for kind, sensor in sensors.items()
        for name in _KEPT
        if sensor.supports(getattr(rs.option, name))
    }


def _get(rs: Any, sensor: Any, name: str) -> float:
    return float(sensor.get_option(getattr(rs.option, name)))


def _set(rs: Any, sensor: Any, name: str, value: float, camera: str) -> None:
    option = getattr(rs.option, name)
    if not sensor.supports(option):
        raise HardwareError(f"Camera {camera} has no option {name}; leave that setting out.")
    allowed = sensor.get_option_range(option)
    if not allowed.min <= value <= allowed.max:
        raise HardwareError(f"Camera {camera}: {name} is from {allowed.min:g} to {allowed.max:g}, got {value:g}.")
    try:
        sensor.set_option(option, value)
    except RuntimeError as error:
        raise HardwareError(f"Camera {camera}: {name} cannot be set to {value:g} ({error}).") from error
