"""Settings of a RealSense camera during a recording: exposure, white balance, laser, preset, synchronisation.

Automatic exposure changes the noise and the holes of depth from frame to frame. So by default the camera adjusts during
the warm-up, and then exposure, gain and white balance are locked. The settings are read back and stored in camera.json.
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
    """Requested settings. None keeps the current value."""

    hold: bool = True
    """Lock exposure, gain and white balance at the end of the warm-up."""
    preset: str | None = None
    """Visual preset of the depth sensor, such as high_accuracy."""
    laser_mw: float | None = None
    """Power of the projector [mW]. 0 switches it off."""
    pace: Pace | None = None
    """Role in hardware synchronisation: one camera is the master, and the others follow its trigger over a cable."""


def apply(rs: Any, sensors: Mapping[str, Any], settings: CameraSettings, camera: str) -> None:
    """Apply the settings before the warm-up, with automatic exposure and white balance on.

    Args:
        sensors: "depth" and "color" sensor of the camera.
        camera: name of the camera, for messages.

    Raises:
        HardwareError: the camera lacks an option or preset, or a value is out of range.
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
    for sensor in sensors.values():  # an earlier program may have locked them
        for automatic, _ in _HELD:
            if sensor.supports(getattr(rs.option, automatic)):
                _set(rs, sensor, automatic, 1.0, camera)


def hold(rs: Any, sensors: Mapping[str, Any], camera: str) -> None:
    """Lock exposure, gain and white balance at their current values, after the warm-up."""
    for sensor in sensors.values():
        for automatic, names in _HELD:
            if not sensor.supports(getattr(rs.option, automatic)):
                continue
            found = {name: _get(rs, sensor, name) for name in names if sensor.supports(getattr(rs.option, name))}
            _set(rs, sensor, automatic, 0.0, camera)
            for name, value in found.items():  # some firmware resets the values when automatic control is switched off
                _set(rs, sensor, name, value, camera)


def read_back(rs: Any, sensors: Mapping[str, Any]) -> dict[str, float]:
    """Return option -> value, such as depth.exposure [µs], for all options that the camera has."""
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
