"""Contact detection: compare the external wrench at the tool with its value at rest."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import LimitError
from diffcloud.hardware.devices import Arm, ArmReading
from diffcloud.hardware.trajectory import Limits

Floats = NDArray[np.float64]

_READINGS = 20
_INTERVAL_S = 0.02


class Contact:
    """The wrench of an arm at rest, against which later wrenches are checked.

    The arm estimates the wrench from its joint torques, with an offset that depends on the pose. So each motion takes
    its own zero, the mean over some readings at rest. A large value is not an offset: the tool presses on something.
    The motion could then add the full limit to this force, so it is refused.

    Args:
        zero: [6] force [N] and torque [N·m].

    Raises:
        LimitError: the zero is not finite, or exceeds the preload limits.
    """

    def __init__(self, zero: Floats, limits: Limits) -> None:
        force, torque = sizes(zero)
        kept = {"force": force <= limits.preload_N, "torque": torque <= limits.preload_Nm}  # false for NaN
        if not all(kept.values()):
            beyond = ", ".join(name for name, inside in kept.items() if not inside)
            raise LimitError(
                f"At rest the tool feels {force:.1f} N and {torque:.1f} N·m; up to {limits.preload_N:g} N and "
                f"{limits.preload_Nm:g} N·m are taken for the estimate's offset (not within it: {beyond}). Free the tool, "
                "check the payload that is configured on the arm (web page: Configurations, Tool), or raise "
                "static_force_n in rig.yaml, which scales both."
            )
        self._zero, self._limits = zero, limits

    def check(self, when: str, wrench: Floats) -> None:
        """Check one wrench.

        Raises:
            LimitError: the change exceeds the limits, or is not a number.
        """
        limits = self._limits
        force, torque = sizes(wrench - self._zero)
        if not (force <= limits.force_N and torque <= limits.torque_Nm):  # also true of NaN
            raise LimitError(
                f"{when} the tool felt {force:.1f} N and {torque:.1f} N·m; limits are {limits.force_N:g} N and "
                f"{limits.torque_Nm:g} N·m. Something is in the way, or the cloth is caught."
            )


def at_rest(arm: Arm, limits: Limits) -> tuple[ArmReading, Contact]:
    """Read an arm at rest. Return the last reading, and the zero of the wrench as the mean over all readings.

    Raises:
        LimitError: see `Contact`.
    """
    readings = []
    for _ in range(_READINGS):
        readings.append(arm.read())
        time.sleep(_INTERVAL_S)
    return readings[-1], Contact(np.mean([reading.wrench for reading in readings], axis=0), limits)


def sizes(wrench: Floats) -> tuple[float, float]:
    """Return the magnitudes of force [N] and torque [N·m] of a wrench [6]."""
    return float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(wrench[3:]))
