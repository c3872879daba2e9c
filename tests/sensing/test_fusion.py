"""Raw episodes to clouds: what is cloth stays, what is robot or table goes, and each point knows its pixel."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from diffcloud.errors import CalibrationError, EpisodeError
from diffcloud.io.calibrations import Calibration, CameraCalibration
from diffcloud.io.episodes import Episode
from diffcloud.io.images import write_depth
from diffcloud.io.raw_episodes import ScenePlacement, read_raw_episode
from diffcloud.sensing.cameras import inverse, project, rays, transform
from diffcloud.sensing.depth_camera import DepthNoise, published_cameras
from diffcloud.sensing.filters import clean_frame, thin
from diffcloud.sensing.fusion import FusionSettings, _ideal_pixels, fit_table, fuse
from diffcloud.sensing.masking import RobotMask
from diffcloud.sensing.recorder import RecorderSettings, read_truth, record
from diffcloud.sensing.robot import gen3
from studies.cloud_quality import evaluate_clouds
from tests.sensing.cloth_scene import (
    CLOTH,
    INTRINSICS,
    ROBOT,
    SETTINGS,
    STEP_M,
    TABLE,
    TOOL_M,
    ClothScene,
    cloth_height,
    write_cloth_episode,
)
from tests.sensing.recorded_scene import META, motion

PLAIN = FusionSettings(**SETTINGS, refine=False)


@pytest.fixture(scope="module")
def mask() -> RobotMask:
    return RobotMask(gen3())


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> ClothScene:
    return write_cloth_episode(tmp_path_factory.mktemp("raw") / "lift_blue1")


@pytest.fixture(scope="module")
def fused(scene, mask) -> Episode:
    return fuse(read_raw_episode(scene.folder), mask, PLAIN)


def labels_of(episode: Episode, scene: ClothScene) -> np.ndarray:
    """[P] true label of each point's pixel."""
    frame = np.repeat(np.arange(episode.frame_count), np.diff(episode.offsets))
    images = np.array([scene.labels[name] for name in scene.labels])  # [camera, frame, H, W]
    return images[episode.camera, frame, episode.pixel[:, 1], episode.pixel[:, 0]]


def test_lost_pixels_are_all_that_show_no_cloth_and_could_not(scene, fused):
    """Where the robot stands, but nowhere that a point of the cloth was kept; told in the scene's frame."""
    assert list(fused.meta["pinholes"]) == list(fused.meta["viewpoints"])
    frame = np.repeat(np.arange(fused.frame_count), np.diff(fused.offsets))
    for camera, (pinhole, name) in enumerate(zip(fused.pinholes, fused.meta["pinholes"], strict=True)):
        mine, lost = fused.camera == camera, fused.lost_pixels(camera)
        there = fused.points[mine] @ pinhole.T_camera_scene[:, :3].T + pinhole.T_camera_scene[:, 3]
        pixels = there[:, :2] / there[:, 2:] * pinhole.focal + pinhole.centre
        np.testing.assert_allclose(pixels, fused.pixel[mine], atol=1e-3)
        column, row = fused.pixel[mine].T
        assert not lost[frame[mine], row, column].any()
        robot = np.array(scene.labels[name]) == ROBOT
        assert lost[robot].mean() > 0.99
        assert 0.0 < lost.mean() < 0.5
        eye = -pinhole.T_camera_scene[:, :3].T @ pinhole.T_camera_scene[:, 3]
        np.testing.assert_allclose(eye, fused.viewpoints[name], atol=1e-9)


def test_lost_pixels_of_a_camera_with_distortion_are_where_its_rays_go():
    bent = replace(INTRINSICS, distortion="brown_conrady", coefficients=(0.1, -0.05, 0.001, -0.002, 0.0))
    column, row = _ideal_pixels(bent)
    inside = (column >= 0) & (column < bent.width) & (row >= 0) & (row < bent.height)
    assert 0.8 < inside.mean() < 1.0
    ideal = np.stack(np.mgrid[: bent.height, : bent.width][::-1], axis=-1).reshape(-1, 2)[inside]
    ray = rays(np.column_stack([column, row])[inside].astype(float), bent)
    met = ray[:, :2] * [bent.fx, bent.fy] + [bent.cx, bent.cy]
    assert np.abs(met - ideal).max() < 1.0
    assert np.abs(np.column_stack([column, row])[inside] - ideal).max() > 2.0


def test_only_cloth_is_left_and_nearly_all_of_it(scene, fused):
    label = labels_of(fused, scene)
    assert (label == ROBOT).mean() <= 0.002
    assert (label == TABLE).mean() <= 0.01
    visible = sum((image == CLOTH).sum() for images in scene.labels.values() for image in images)
    assert (label == CLOTH).sum() >= 0.9 * visible  # some lies flat, some beside the fingers


def test_points_lie_on_the_cloth(scene, fused):
    cloth = fused.points[labels_of(fused, scene) == CLOTH]
    height = cloth_height(cloth[:, 0], cloth[:, 1])
    slope = (height - 0.002) * 2 * (cloth[:, 0] - 0.62) / 0.03**2
    off = (cloth[:, 2] - height) / np.hypot(1, slope)  # distance to the surface, to first order
    assert np.sqrt(np.mean(np.square(off))) < 0.004


def test_each_point_projects_onto_its_pixel(scene, fused):
    for index, view in enumerate(scene.views.values()):
        mine = fused.camera == index
        pixels = project(transform(inverse(view.T_world_camera), fused.points[mine].astype(float)), INTRINSICS)
        np.testing.assert_allclose(pixels, fused.pixel[mine], atol=1e-3)
    z = np.linalg.norm(fused.points - scene.views["overhead"].T_world_camera[:3, 3], axis=1)
    first = fused.camera == 0
    assert (fused.sigma[first] <= z[first] ** 2 * 0.08 / (154.0 * 0.05) + 1e-6).all()


def test_quality_figures_and_labels_are_kept(fused):
    quality = fused.meta["quality"]
    sizes = np.sum([quality["points_per_view"][name] for name in ("overhead", "side")], axis=0)
    np.testing.assert_array_equal(sizes, np.diff(fused.offsets))
    assert all(0 < part < 0.5 for name in ("overhead", "side") for part in quality["masked_fraction"][name])
    assert all(gap < 0.01 for gap in quality["overlap_m"])
    assert fused.meta["scenario"] == "lift"
    assert fused.meta["cameras"] == ["overhead", "side"]


def test_without_a_mask_the_robot_stays(scene):
    episode = fuse(read_raw_episode(scene.folder), None, PLAIN)
    assert (labels_of(episode, scene) == ROBOT).mean() > 0.1
    assert episode.gripper is None  # the log has no tool pose, and nothing says whose joints these are


def test_the_gripper_follows_the_joints_into_the_scene(scene, fused, mask):
    np.testing.assert_allclose(fused.gripper[:, 0], TOOL_M + np.arange(3)[:, None] * STEP_M, atol=5e-5)
    placement = ScenePlacement((0.55, 0.1, 0.02), np.pi / 2, 0.35)
    moved = fuse(read_raw_episode(scene.folder), mask, replace(PLAIN, placement=placement))
    np.testing.assert_allclose(moved.points, placement.to_scene(fused.points.astype(float)), atol=1e-5)
    np.testing.assert_allclose(moved.gripper, placement.to_scene(fused.gripper), atol=1e-12)
    np.testing.assert_allclose(placement.to_scene(np.array([0.55, 0.1 + 0.35, 0.02])), [-1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(placement.to_world(moved.gripper), fused.gripper, atol=1e-12)


def test_flat_cloth_needs_colour(scene, mask, tmp_path):
    grey = write_cloth_episode(tmp_path / "grey", colored=False)
    episode = fuse(read_raw_episode(grey.folder), mask, PLAIN)
    label = labels_of(episode, grey)
    assert (label == TABLE).mean() <= 0.01
    assert episode.points[:, 2].min() > 0.003  # the ridge is there, the sheet 2 mm above the table is not
    visible = sum((image == CLOTH).sum() for images in grey.labels.values() for image in images)
    assert 0.2 * visible < (label == CLOTH).sum() < 0.8 * visible


def test_one_camera_is_enough(scene, mask):
    raw = read_raw_episode(scene.folder)
    one = fuse(replace(raw, cameras={"side": raw.cameras["side"]}), mask, PLAIN)
    assert one.meta["quality"]["overlap_m"] == [None] * 3
    assert set(one.camera) == {0}


def test_a_plane_is_found_under_clutter(rng):
    table = np.column_stack([rng.uniform(-0.3, 0.3, (3000, 2)), np.zeros(3000)])
    table[:, 2] = 0.02 + 0.05 * table[:, 0] + rng.normal(size=3000) * 0.002
    clutter = rng.uniform([-0.3, -0.3, 0.05], [0.3, 0.3, 0.65], (2500, 3))
    found = fit_table([(table, None), (clutter, None)])
    expected = np.array([-0.05, 0.0, 1.0]) / np.linalg.norm([-0.05, 0.0, 1.0])
    assert found.color is None
    np.testing.assert_allclose(found.normal, expected, atol=2e-3)
    np.testing.assert_allclose(
        found.height(table[:, :3] * [1, 1, 0] + [0, 0, 0.02] + table[:, :1] * [0, 0, 0.05]), 0, atol=1e-3
    )


@pytest.mark.parametrize("deviation", [0.0015, 0.004])
def test_how_uneven_a_table_is_does_not_depend_on_what_lies_on_it(deviation, rng):
    table = np.column_stack([rng.uniform(-0.3, 0.3, (5000, 2)), deviation * rng.normal(size=5000)])
    cloth = np.column_stack([rng.uniform(-0.1, 0.1, (2000, 2)), np.full(2000, 0.002)])
    hill = rng.uniform([-0.1, -0.1, 0.01], [0.1, 0.1, 0.3], (2000, 3))
    found = fit_table([(table, None), (np.concatenate([cloth, hill]), None)])
    assert found.deviation == pytest.approx(deviation, rel=0.35)  # the sheet draws the plane up


def test_a_table_that_noise_lifts_is_no_cloth(tmp_path):
    """Errors that reach over several pixels, which smoothing does not remove: whole patches of table rise together."""
    seen, noise = motion(), DepthNoise(subpixel_px=0.15, correlation_px=2.0)
    cameras = [replace(camera, noise=noise) for camera in published_cameras(424, 240)]
    record(tmp_path / "raw", seen, cameras, settings=RecorderSettings(), seed=3, meta=META)
    raw = read_raw_episode(tmp_path / "raw")
    found = evaluate_clouds(fuse(raw, None, FusionSettings(refine=False)), raw, read_truth(tmp_path / "raw"), noise)
    raised = found.table[~found.flat] / found.points[~found.flat]
    assert raised.max() < 0.005


def test_no_plane_where_there_is_none(rng):
    assert fit_table([(rng.uniform(0, 1, (3000, 3)), None)]) is None
    wall = rng.uniform(0, 1, (3000, 3)) * [0, 1, 1]
    assert fit_table([(wall, None)]) is None
    assert fit_table([(np.zeros((3, 3)), None)]) is None


@pytest.mark.parametrize("downsampling", ["random", "voxel", "farthest"])
def test_thinning_keeps_no_point_twice(rng, downsampling):
    points = rng.normal(size=(2000, 3)).astype(np.float32)
    kept = thin(points, 300, downsampling, rng)
    assert len(np.unique(kept)) == len(kept)
    assert 250 <= len(kept) <= 300


@pytest.mark.parametrize("downsampling", ["voxel", "farthest"])
def test_even_thinning_evens(rng, downsampling):
    dense = rng.uniform(0, 0.1, (4000, 3)) * [1, 1, 0]
    sparse = rng.uniform(0.2, 0.3, (400, 3)) * [1, 1, 0]
    kept = thin(np.concatenate([dense, sparse]).astype(np.float32), 200, downsampling, rng)
    assert 0.35 < (kept < 4000).mean() < 0.65  # both squares are of one size


def test_lonely_points_go(rng):
    points = np.concatenate([rng.uniform(0, 0.05, (500, 3)), [[0.5, 0.5, 0.5], [0.501, 0.5, 0.5]]]).astype(np.float32)
    kept, _ = clean_frame(points, neighbours=0, radius_m=0.02, radius_neighbours=3, rng=rng)
    assert kept.max() == 499
    with pytest.raises(EpisodeError, match="Widen the radius"):
        clean_frame(points, neighbours=0, radius_m=1e-6, rng=rng)


class TestBadInput:
    def test_no_depth(self, tmp_path, mask):
        folder = write_cloth_episode(tmp_path / "raw", frames=2).folder
        write_depth(folder / "cameras" / "side" / "depth" / "000001.png", np.zeros((120, 160), np.uint16))
        with pytest.raises(EpisodeError, match="side, frame 1: 0 valid depth"):
            fuse(read_raw_episode(folder), mask, PLAIN)

    def test_joint_log_shorter_than_the_video(self, tmp_path, mask):
        folder = write_cloth_episode(tmp_path / "raw").folder
        rows = (folder / "robot.csv").read_text(encoding="utf-8").splitlines(keepends=True)
        (folder / "robot.csv").write_text("".join(rows[:2]), encoding="utf-8")
        with pytest.raises(EpisodeError, match="The joint log covers"):
            fuse(read_raw_episode(folder), mask, PLAIN)

    def test_no_joint_log(self, scene, mask):
        with pytest.raises(EpisodeError, match="no joint log"):
            fuse(replace(read_raw_episode(scene.folder), robot=None), mask, PLAIN)

    def test_calibration_of_another_camera(self, scene, mask):
        other = Calibration({"999": CameraCalibration("999", INTRINSICS, np.eye(4), None, "front", {})}, "test", {})
        with pytest.raises(CalibrationError, match=r"no camera overhead \(serial 000\)"):
            fuse(read_raw_episode(scene.folder), mask, PLAIN, calibration=other)

    def test_cameras_that_never_see_the_same_moment(self, tmp_path, mask):
        folder = write_cloth_episode(tmp_path / "raw", frames=2).folder
        place = folder / "cameras" / "side" / "timestamps.csv"
        rows = [line.split(",") for line in place.read_text(encoding="utf-8").splitlines()]
        later = [f"{number},{float(t) + 0.5}" for number, t in rows[1:]]
        place.write_text("\n".join([",".join(rows[0]), *later]) + "\n", encoding="utf-8")
        with pytest.raises(EpisodeError, match=r"no frame in which all cameras .* Are they on one clock"):
            fuse(read_raw_episode(folder), None, FusionSettings(**SETTINGS))

    def test_not_calibrated(self, tmp_path, mask):
        folder = write_cloth_episode(tmp_path / "raw", frames=1).folder
        path = folder / "cameras" / "side" / "camera.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), "T_world_camera": None}), encoding="utf-8")
        with pytest.raises(EpisodeError, match="side is not calibrated"):
            fuse(read_raw_episode(folder), mask, PLAIN)

    def test_empty_workspace(self, scene, mask):
        settings = replace(PLAIN, workspace_m=((5.0, 5.0, 5.0), (6.0, 6.0, 6.0)))
        with pytest.raises(EpisodeError, match=r"Frame 0: no point is left \(overhead: 0 in the workspace"):
            fuse(read_raw_episode(scene.folder), mask, settings)
