"""One camera corrected against another: a moving surface seen by two cameras with known errors."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from diffcloud.errors import EpisodeError
from diffcloud.io.episodes import Episode, Pinhole
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.scene.scenarios import load_scenario
from diffcloud.sensing.agreement import agreement, corrected
from diffcloud.sensing.cameras import inverse, looking_at
from diffcloud.sensing.depth_camera import published_cameras
from diffcloud.sensing.recorder import RecorderSettings, caster
from diffcloud.sim.simulate import rollout

CAMERAS = ("above", "side")
PLACES = {"above": (0.3, 0.1, 0.9), "side": (0.1, -0.9, 0.6)}
TURN = Rotation.from_rotvec(np.radians(1.0) * np.array([0.6, 0.64, -0.48]))
SHIFT_M, LAG_S = np.array([0.006, -0.0064, 0.0048]), 0.05
POINTS = 4000
PRIORS = np.array([np.radians(5.0)] * 3 + [0.05] * 3 + [0.03, 0.1])


def recording(*, noise_m=0.0, speed=1.0, flat=False, frames=20, seed=0):
    """A cloth of 0.3 m with waves that travel while it rises. The side camera's points are displaced by 10 mm, turned by 1
    degree about the origin, and show the motion 50 ms after their time stamps."""
    rng, times, clouds, cameras = np.random.default_rng(seed), 0.1 * np.arange(frames), [], []
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


def errors(found):
    """[8] what the values of a correction lack, in their units."""
    back = TURN.inv()
    shift = back.apply(found.middle - SHIFT_M) - found.middle
    return found.values - np.array([*back.as_rotvec(), *shift, 0.0, LAG_S])


@pytest.mark.parametrize("seed", range(3))
def test_standard_deviations_hold_for_a_cloth_that_moves_and_bends(seed):
    found = agreement([recording(noise_m=0.002, seed=seed)], CAMERAS, scale=False)
    assert (np.abs(errors(found)) <= 3.5 * found.sigmas).all()
    assert np.degrees(found.sigmas[:3]).max() < 0.2
    assert found.sigmas[3:6].max() < 0.001
    assert found.sigmas[7] < 0.005


@pytest.mark.parametrize("seed", range(3))
def test_a_flat_cloth_at_rest_shows_only_height_and_tilt(seed):
    """Noise of its normals is no information: shift and turn in its plane and the lag stay as the prior has them."""
    found = agreement([recording(flat=True, speed=0.0, noise_m=0.002, seed=seed)], CAMERAS, scale=False)
    hidden = [2, 3, 4, 7]
    np.testing.assert_allclose(found.values[hidden] / PRIORS[hidden], 0.0, atol=0.02)
    np.testing.assert_allclose(found.sigmas[hidden] / PRIORS[hidden], 1.0, atol=0.02)
    assert found.sigmas[5] < 0.0005
    assert np.degrees(found.sigmas[:2]).max() < 0.2
    assert found.moved(TURN.apply([[0.0, 0.0, 0.0]]) + SHIFT_M)[0, 2] == pytest.approx(0.0, abs=0.0003)


@cache
def simulated(kind):
    """The middle part of a scenario's motion as depth cameras see it; second camera as in `recording`."""
    scenario, rng = load_scenario(kind), np.random.default_rng(0)
    system, _ = scenario.scene.build()
    run = rollout(system, scenario.steps)
    times = np.linspace(0.3, 0.9, 24) * scenario.steps * system.time_step
    seeing, clouds, numbers = published_cameras(640, 480), [], []
    to_world = RecorderSettings().placement.to_world
    for time in times:
        for number, camera in enumerate(seeing):
            nodes = run.at(torch.tensor([time + number * LAG_S], dtype=torch.float64))[0, 0].numpy()
            points = measured(camera, SurfaceMesh(to_world(nodes), system.mesh.faces), rng)
            clouds.append(TURN.apply(points) + SHIFT_M if number else points)
            numbers.append(np.full(len(points), number, dtype=np.uint8))
    places = {name: camera.view.T_world_camera[:3, 3].tolist() for name, camera in zip(CAMERAS, seeing, strict=True)}
    offsets = np.cumsum([0, *map(len, clouds)])[::2]
    meta = {"cameras": list(CAMERAS), "viewpoints": places}
    return Episode(np.concatenate(clouds).astype(np.float32), offsets, times, camera=np.concatenate(numbers), meta=meta)


def measured(camera, cloth, rng):
    """[P, 3] in the world, with the faults of depth images."""
    pose, directions = camera.view.T_world_camera, camera.view.directions
    rays = np.concatenate([np.broadcast_to(pose[:3, 3], directions.shape), directions @ pose[:3, :3].T], axis=-1)
    depth = caster([cloth]).cast_rays(rays.astype(np.float32), nthreads=1)["t_hit"].numpy().astype(np.float64)
    depth_m = 1e-3 * camera.measure(depth, np.zeros(depth.shape, dtype=bool), rng)
    seen = depth_m > 0
    return directions[seen] * depth_m[seen][:, None] @ pose[:3, :3].T + pose[:3, 3]


@pytest.mark.slow
def test_displacement_turn_and_clock_are_recovered_from_depth_images():
    """A lift and a fold before two cameras with the noise of stereo depth: to 2 mm, 0.2 degrees and 5 ms."""
    found = agreement([simulated("lift"), simulated("fold")], CAMERAS, scale=False)
    error = errors(found)
    assert np.linalg.norm(error[3:6]) < 0.002
    assert np.degrees(np.linalg.norm(error[:3])) < 0.2
    assert abs(error[7]) < 0.005
    assert found.before_m > 0.006
    assert found.after_m < 0.002


def test_points_pose_and_cut_plane_move_together():
    episode = recording()
    found = agreement([episode], CAMERAS, scale=False)
    after = corrected(episode, found, ["a"])
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
