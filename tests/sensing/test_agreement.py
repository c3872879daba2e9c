"""One camera corrected against another: a moving surface seen by two cameras with known errors."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from diffcloud.errors import EpisodeError
from diffcloud.io.episodes import Episode, Pinhole
from diffcloud.sensing.agreement import agreement, corrected
from diffcloud.sensing.cameras import inverse, looking_at

CAMERAS = ("above", "side")
PLACES = {"above": (0.3, 0.1, 0.9), "side": (0.1, -0.9, 0.6)}
TURN = Rotation.from_rotvec(np.radians(1.0) * np.array([0.6, 0.64, -0.48]))
SHIFT_M, LAG_S = np.array([0.006, -0.0064, 0.0048]), 0.05
POINTS = 4000


def recording(*, noise_m=0.0, speed=1.0, flat=False, frames=20):
    """A cloth of 0.3 m with waves that travel while it rises. The side camera's points are displaced by 10 mm, turned by 1
    degree about the origin, and show the motion 50 ms after their time stamps."""
    rng, times, clouds, cameras = np.random.default_rng(0), 0.1 * np.arange(frames), [], []
    for time in times:
        for number in (0, 1):
            t = speed * (time + LAG_S * number)
            x, y = rng.uniform(-0.15, 0.15, (2, POINTS))
            wave = 0.0 if flat else 0.03 * np.sin(16 * x + 4 * t) + 0.025 * np.sin(14 * y - 3 * t + 1)
            points = np.column_stack([x + 0.02 * t, y, wave + 0.1 * t * (1 + x)])
            points += noise_m * rng.normal(size=points.shape)
            clouds.append(TURN.apply(points) + SHIFT_M if number else points)
            cameras.append(np.full(POINTS, number, dtype=np.uint8))
    poses = {name: inverse(looking_at(place, (0, 0, 0.1)))[:3] for name, place in PLACES.items()}
    pinholes = {name: Pinhole(640, 480, (615.0, 615.0), (320.0, 240.0), pose) for name, pose in poses.items()}
    meta = {
        "cameras": list(CAMERAS),
        "viewpoints": {name: list(place) for name, place in PLACES.items()},
        "pinholes": {name: pinhole.described() for name, pinhole in pinholes.items()},
        "cut_planes": {name: [0.0, 0.0, 1.0, -0.02] for name in CAMERAS},
    }
    offsets = 2 * POINTS * np.arange(frames + 1)
    return Episode(np.concatenate(clouds).astype(np.float32), offsets, times, camera=np.concatenate(cameras), meta=meta)


@pytest.mark.parametrize("noise_m", [0.0, 0.001])
def test_displacement_turn_and_clock_are_recovered(noise_m):
    """To 2 mm, 0.2 degrees and 5 ms; and the distance falls to the noise."""
    found = agreement([recording(noise_m=noise_m)], CAMERAS, scale=False)
    off = found.moved(TURN.apply(np.eye(3) * 0.1) + SHIFT_M) - np.eye(3) * 0.1
    assert np.linalg.norm(off, axis=1).max() < 0.002
    assert np.degrees((Rotation.from_rotvec(found.values[:3]) * TURN).magnitude()) < 0.2
    assert found.values[7] == pytest.approx(LAG_S, abs=0.005)
    assert found.values[6] == 0.0
    assert found.before_m > 0.004
    assert found.after_m < 0.0015 + noise_m


def test_the_lag_of_a_cloth_at_rest_is_left_alone():
    found = agreement([recording(flat=True, speed=0.0, noise_m=0.0005)], CAMERAS, scale=False)
    assert abs(found.moved(SHIFT_M[None])[0, 2]) < 0.001
    assert found.values[7] == 0.0
    assert found.sigmas[7] == pytest.approx(0.1, rel=0.01)


def test_points_pose_and_cut_plane_move_together():
    episode = recording()
    found = agreement([episode], CAMERAS, scale=False)
    after = corrected(episode, found, "side", {"from": ["a"]})
    side = episode.camera == 1
    np.testing.assert_array_equal(after.points[~side], episode.points[~side])
    before_pinhole, after_pinhole = episode.pinholes[1], after.pinholes[1]

    def in_camera(pinhole, points):
        return points @ pinhole.T_camera_scene[:, :3].T + pinhole.T_camera_scene[:, 3]

    np.testing.assert_allclose(
        in_camera(after_pinhole, after.points[side]), in_camera(before_pinhole, episode.points[side]), atol=1e-6
    )
    np.testing.assert_allclose(after.viewpoints["side"], after_pinhole.position, atol=1e-9)
    height = episode.points[side] @ [0, 0, 1] + 0.02
    plane = np.array(after.meta["cut_planes"]["side"])
    np.testing.assert_allclose(after.points[side] @ plane[:3] - plane[3], height, atol=1e-6)
    assert after.meta["agreement"]["side"]["from"] == ["a"]
    assert after.meta["clocks"]["side"]["offset_s"] == pytest.approx(LAG_S, abs=0.005)
    json.dumps(after.meta, allow_nan=False)


@pytest.mark.parametrize(
    ("frames", "cameras", "message"),
    [(20, ("above", "third"), "name the cameras above, side"), (3, CAMERAS, "in 1 frames")],
)
def test_what_cannot_be_compared_is_refused(frames, cameras, message):
    with pytest.raises(EpisodeError, match=message):
        agreement([recording(frames=frames)], cameras)
