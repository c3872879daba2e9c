"""Keyframed motions: cubic Hermite splines over (translation, scale, quaternion), as ARCSim interpolates them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import SceneError

_IDENTITY_QUATERNION = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Keyframe:
    """A transform x -> translation + scale · R x at a time, with an optional time derivative."""

    time: float
    """Time of the keyframe [s]."""
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Translation [m]."""
    scale: float = 1.0
    quaternion: tuple[float, float, float, float] = _IDENTITY_QUATERNION
    """Rotation as a quaternion (w, x, y, z)."""
    velocity: tuple[float, ...] | None = None
    """[8] time derivative of (translation, scale, quaternion). None: central difference, zero at the first and last
    keyframe."""


@dataclass(frozen=True)
class Motion:
    """A spline through keyframes, constant before the first and after the last.

    Raises:
        SceneError: there are no keyframes, or their times do not increase.
    """

    keyframes: tuple[Keyframe, ...]

    def __post_init__(self) -> None:
        times = [key.time for key in self.keyframes]
        if not times or any(later <= earlier for earlier, later in pairwise(times)):
            raise SceneError(f"A motion needs keyframes at increasing times, got times {times}.")

    def at(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Transforms at times [S] [s]: linear part scale · R [S, 3, 3] and translation [S, 3] [m]."""
        key_times = np.array([key.time for key in self.keyframes])
        values = np.array([[*key.translation, key.scale, *key.quaternion] for key in self.keyframes])
        if len(values) == 1:
            state = np.repeat(values, len(times), axis=0)
        else:
            rates = self._rates(key_times, values)
            end = np.clip(np.searchsorted(key_times, times, side="right"), 1, len(values) - 1)
            span = (key_times[end] - key_times[end - 1])[:, None]
            s = np.clip((times - key_times[end - 1])[:, None] / span, 0.0, 1.0)
            state = (
                values[end - 1] * (2 * s**3 - 3 * s**2 + 1)
                + values[end] * (-2 * s**3 + 3 * s**2)
                + span * (rates[end - 1] * (s**3 - 2 * s**2 + s) + rates[end] * (s**3 - s**2))
            )
        return state[:, 3, None, None] * _rotation(state[:, 4:]), state[:, :3]

    def _rates(self, times: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        rates = np.zeros_like(values)
        rates[1:-1] = (values[2:] - values[:-2]) / (times[2:] - times[:-2])[:, None]
        for index, key in enumerate(self.keyframes):
            if key.velocity is not None:
                rates[index] = key.velocity
        return rates


def axis_angle_quaternion(degrees: float, axis: tuple[float, float, float]) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z) of a rotation about an axis. A zero angle gives the identity for any axis.

    Raises:
        SceneError: the axis is zero.
    """
    if degrees == 0:
        return _IDENTITY_QUATERNION
    length = float(np.linalg.norm(axis))
    if length == 0:
        raise SceneError(f"A rotation by {degrees:g}° about the axis {list(axis)}: give an axis that is not zero.")
    half = np.deg2rad(degrees) / 2
    x, y, z = np.asarray(axis) / length * np.sin(half)
    return float(np.cos(half)), float(x), float(y), float(z)


def _rotation(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices [S, 3, 3] of quaternions [S, 4], which are normalised first."""
    w, x, y, z = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)
