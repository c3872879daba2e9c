"""Checks of the tool poses in a joint log: units, frame and quaternions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_LONGEST_REACH_M = 3.0
"""Upper limit of the reach of such arms [m]."""
_LENGTH_OFF = 0.01
_TURNED = np.deg2rad(10.0)


def unreachable(positions: Floats) -> str | None:
    """Explain why tool positions [N, 3] are out of an arm's reach; None if they are reachable. NaN is ignored."""
    known = positions[np.isfinite(positions).all(axis=1)]
    farthest = float(np.linalg.norm(known, axis=1).max()) if len(known) else 0.0
    if farthest <= _LONGEST_REACH_M:
        return None
    unit = "they look like millimetres: divide by 1000" if farthest > 50 else "check their unit and their frame"
    return (
        f"The gripper's positions lie up to {farthest:.0f} m from the robot's base, farther than an arm reaches. They are "
        f"metres in the base frame; {unit}."
    )


def not_unit(quaternions: Floats) -> str | None:
    """Explain why tool orientations [N, 4] are no unit quaternions; None if they are. NaN is ignored."""
    lengths = np.linalg.norm(quaternions, axis=1)
    lengths = lengths[np.isfinite(lengths)]
    if not len(lengths) or np.abs(lengths - 1).max() <= _LENGTH_OFF:
        return None
    worst = float(lengths[np.abs(lengths - 1).argmax()])
    return (
        f"A tool quaternion in robot.csv has a length of {worst:.3g} instead of 1: tool_qw..qz "
        "are a unit quaternion (w, x, y, z), not angles in degrees or radians. Convert them."
    )


def turning(quaternions: Floats) -> str | None:
    """Warn if the tool rotates, since its track then differs from that of the fingertips; None if it hardly rotates.

    Args:
        quaternions: [N, 4] orientations (w, x, y, z); NaN is ignored.
    """
    lengths = np.linalg.norm(quaternions, axis=1)
    known = quaternions[np.abs(lengths - 1) <= _LENGTH_OFF]
    if not len(known):
        return None
    turned = 2 * float(np.arccos(np.abs(known @ known[0]).clip(max=1.0)).max())
    if turned <= _TURNED:
        return None
    return (
        f"The tool turns by {np.rad2deg(turned):.0f} degrees. The cloth follows the origin of the tool's frame: if that is "
        "not between the fingertips, they move otherwise. Record, or import (--tool-frame), the pose of a frame that is."
    )
