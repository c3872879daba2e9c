"""Keyframed motions are cubic Hermite splines."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from diffcloud.errors import SceneError
from diffcloud.sim.motion import Keyframe, Motion, axis_angle_quaternion


def test_agrees_with_scipys_hermite_spline():
    keys = (Keyframe(0.0), Keyframe(0.5, (0.0, 0.6, 1.5), 0.0), Keyframe(1.0, (0.0, 0.8, 0.5), 0.0))
    values = np.array([[*k.translation, k.scale] for k in keys])
    rates = np.vstack([np.zeros(4), values[2] - values[0], np.zeros(4)])
    times = np.linspace(-0.2, 1.3, 40)
    expected = CubicHermiteSpline([0, 0.5, 1.0], values, rates)(np.clip(times, 0, 1))
    linear, translation = Motion(keys).at(times)
    np.testing.assert_allclose(translation, expected[:, :3], atol=1e-14)
    np.testing.assert_allclose(linear, expected[:, 3, None, None] * np.eye(3), atol=1e-14)


def test_given_velocities_are_used():
    keys = (Keyframe(0.0, velocity=(1.0, 0, 0, 0, 0, 0, 0, 0)), Keyframe(2.0))
    _, translation = Motion(keys).at(np.array([1e-6]))
    assert translation[0, 0] == pytest.approx(1e-6, rel=1e-5)


def test_rotation_is_proper_and_reaches_its_key():
    keys = (Keyframe(0.0), Keyframe(1.0, quaternion=axis_angle_quaternion(90.0, (0.0, 0.0, 2.0))))
    linear, _ = Motion(keys).at(np.linspace(0, 1, 7))
    np.testing.assert_allclose(linear @ linear.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (7, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(linear[-1], Rotation.from_euler("z", 90, degrees=True).as_matrix(), atol=1e-12)


def test_times_must_increase():
    with pytest.raises(SceneError, match="increasing times"):
        Motion((Keyframe(0.0), Keyframe(0.0)))
    with pytest.raises(SceneError, match="increasing times"):
        Motion(())
