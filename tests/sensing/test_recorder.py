"""The synthetic recorder writes raw episodes like any other, and preprocessing finds back what it hid."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from diffcloud.errors import EpisodeError, RobotError
from diffcloud.io.raw_episodes import read_raw_episode
from diffcloud.io.urdf import Joint, LinkMesh, RobotDescription
from diffcloud.sensing.arm_body import cable, lookalike
from diffcloud.sensing.cameras import inverse, transform
from diffcloud.sensing.fusion import FusionSettings, fuse
from diffcloud.sensing.masking import RobotMask, joints_at
from diffcloud.sensing.recorder import CLOTH, ROBOT, TABLE, read_truth
from diffcloud.sensing.robot import GEN3_HOME_RAD, Robot, gen3
from diffcloud.sensing.validation.episode import validate_raw_episode
from studies.cloud_quality import evaluate_clouds, visible_clouds
from tests.sensing.recorded_scene import FRAMES, LIFT, motion, smooth_motion, write_recorded_episode

SETTINGS = FusionSettings(depth_jump_m=0.03)
ERROR = (5.0, 0.5)


@pytest.fixture(scope="module")
def mask() -> RobotMask:
    return RobotMask(gen3(), robot_margin_m=0.007)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_recorded_episode(tmp_path_factory.mktemp("recorded") / "lift_blue1")


@pytest.fixture(scope="module")
def shifted(tmp_path_factory) -> Path:
    return write_recorded_episode(tmp_path_factory.mktemp("shifted") / "lift_blue1", extrinsic_error=ERROR)


def box_robot() -> Robot:
    import trimesh

    box = trimesh.creation.box(extents=(0.1, 0.2, 0.3))
    still = Joint("j", "revolute", "base", "tool_frame", np.eye(4), np.array([0.0, 0.0, 1.0]), -1.0, 1.0)
    return Robot(
        RobotDescription("box", "base", (still,), {"base": LinkMesh(np.asarray(box.vertices), np.asarray(box.faces))})
    )


def off_by(truth, found: np.ndarray, name: str) -> float:
    """Greatest distance by which a camera's pose misplaces the cloth [m]."""
    nodes = truth.nodes.reshape(-1, 3)
    return float(np.linalg.norm(transform(found @ inverse(truth.T_world_camera[name]), nodes) - nodes, axis=1).max())


class TestArmBody:
    def test_a_box_becomes_rounder_and_at_most_3_mm_larger(self, rng):
        robot = box_robot()
        vertices = lookalike(robot, rng, largest_growth_m=0.003).description.meshes["base"].vertices
        growth = np.abs(vertices).max(axis=0) - [0.05, 0.1, 0.15]
        assert (growth > -0.0005).all()  # a ball of 42 points is a little smaller than a ball
        assert (growth <= 0.003).all()
        corner = np.linalg.norm(np.abs(vertices) - [0.05, 0.1, 0.15], axis=1)
        assert corner.min() > 0.001  # no vertex is where the box had its corner

    def test_the_cable_runs_along_the_arm(self):
        robot = gen3()
        poses = robot.forward_kinematics(robot.configuration(GEN3_HOME_RAD))
        found = cable(robot, poses)
        origins = poses[:, :3, 3]
        assert np.linalg.norm(found.nodes[:, None] - origins, axis=2).min(axis=1).max() < 0.25
        with pytest.raises(RobotError, match="has no links"):
            cable(box_robot(), np.eye(4)[None])


class TestRecording:
    def test_it_is_a_raw_episode_without_a_fault(self, folder):
        assert [finding for finding in validate_raw_episode(folder) if finding.severity == "fault"] == []
        raw = read_raw_episode(folder)
        assert {name: len(camera.frames) for name, camera in raw.cameras.items()} == {"overhead": FRAMES, "side": FRAMES}
        assert raw.description["source"] == "synthetic"
        assert raw.description["scene_in_world"]["length_unit_m"] == 1.0

    def test_labels_say_what_depth_shows(self, folder):
        raw, truth = read_raw_episode(folder), read_truth(folder)
        for name, camera in raw.cameras.items():
            labels = truth.labels(name, FRAMES - 1)
            assert {TABLE, CLOTH, ROBOT} <= set(np.unique(labels))
            cloth, pixels = truth.visible_cloth(name, camera.info.intrinsics, FRAMES - 1)
            assert len(cloth) > 1000
            z = transform(inverse(truth.T_world_camera[name]), cloth)[:, 2]
            depth = camera.depth(FRAMES - 1)[pixels[:, 1], pixels[:, 0]] * 0.001
            off = (depth - z)[depth > 0]
            assert abs(np.median(off)) < 0.001
            assert 1.4826 * np.median(np.abs(off)) < 0.008  # the noise at a metre

    def test_the_arm_holds_the_cloth_and_its_log_is_late(self, folder):
        raw, truth = read_raw_episode(folder), read_truth(folder)
        held = truth.nodes[:, motion().grasped[0]]
        times = raw.cameras["overhead"].times
        stated, corrected = (
            gen3().tool_pose(joints_at(raw.robot, times, clock_offset_s=lag)[0])[:, :3, 3] - held for lag in (0.0, 0.02)
        )
        np.testing.assert_allclose(
            corrected, np.tile([0, 0, 0.071], (FRAMES, 1)), atol=1e-3
        )  # rows are 25 ms apart, and the arm is at full speed after 0.1 s
        assert np.linalg.norm(stated - corrected, axis=1)[1:-1].min() > 0.005  # at rest as it starts and ends

    @pytest.mark.parametrize(("height", "leans"), [(0.40, 0.0), (0.46, 10.0), (0.50, 20.0)])
    def test_where_it_cannot_point_down_the_gripper_leans(self, height, leans, tmp_path):
        high = smooth_motion(((0.0, 0.0, 0.0), (0.0, -0.14, height)))
        raw = read_raw_episode(write_recorded_episode(tmp_path / "lift", seen=high, size=(64, 48)))
        tool = gen3().tool_pose(joints_at(raw.robot, high.times, clock_offset_s=0.02)[0])
        held = raw.placement.to_world(high.nodes[:, high.grasped[0]])
        np.testing.assert_allclose(tool[:, :3, 3] + 0.071 * tool[:, :3, 2], held, atol=1e-3)
        lean = np.arctan2(np.linalg.norm(tool[:, :2, 2], axis=1), -tool[:, 2, 2])
        assert np.degrees(lean) == pytest.approx(leans, abs=0.1)
        assert (tool[:, :2, 2] * held[:, :2]).sum(axis=1).min() > -0.01  # outwards

    def test_what_no_gripper_reaches_is_an_error(self, tmp_path):
        with pytest.raises(RobotError, match="does not reach"):
            write_recorded_episode(tmp_path / "lift", seen=smooth_motion(((0.0, 0.0, 0.0), (0.0, 0.0, 0.9))))
        assert not list(tmp_path.iterdir())

    def test_between_the_images_the_logged_arm_moves_smoothly(self, tmp_path):
        coarse, fine = (smooth_motion(LIFT, frames=frames) for frames in (26, 101))
        raw = read_raw_episode(write_recorded_episode(tmp_path / "lift", seen=coarse, size=(64, 48)))
        held = raw.placement.to_world(fine.nodes[:, fine.grasped[0]])
        logged = gen3().tool_pose(joints_at(raw.robot, fine.times, clock_offset_s=0.02)[0])[:, :3, 3]
        off = np.linalg.norm(logged - held - [0, 0, 0.071], axis=1)
        assert off.max() < 1.5e-4  # straight from image to image it would be 0.5 mm off

    def test_a_scene_beside_its_stated_place_is_turned_and_shifted_there(self, folder, tmp_path):
        beside = write_recorded_episode(tmp_path / "beside", placement_error=(30.0, 10.0))
        home, truth = read_truth(folder), read_truth(beside)
        assert read_raw_episode(beside).placement == read_raw_episode(folder).placement == home.placement
        (tmp_path / "old" / "truth").mkdir(parents=True)
        (tmp_path / "old" / "truth" / "cameras.json").write_text('{"overhead": [[1.0]]}')
        shutil.copyfile(beside / "truth" / "cloth.npz", tmp_path / "old" / "truth" / "cloth.npz")
        with pytest.raises(EpisodeError, match=r"cameras\.json does not say where .* record again"):
            read_truth(tmp_path / "old")
        np.testing.assert_allclose(truth.placement.to_scene(truth.nodes), home.placement.to_scene(home.nodes), atol=1e-12)
        middles = [one.nodes[0].mean(axis=0) for one in (home, truth)]
        assert np.linalg.norm(middles[1] - middles[0]) == pytest.approx(0.03, abs=1e-9)
        assert middles[1][0] <= middles[0][0]  # towards the arm
        assert abs(truth.placement.yaw_rad - home.placement.yaw_rad) == pytest.approx(np.deg2rad(10))

    def test_the_same_seed_gives_the_same_bytes(self, folder, tmp_path):
        again = write_recorded_episode(tmp_path / "again")
        files = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file() and path.suffix != ".npz")
        assert files == sorted(
            path.relative_to(again) for path in again.rglob("*") if path.is_file() and path.suffix != ".npz"
        )
        assert all((folder / file).read_bytes() == (again / file).read_bytes() for file in files)

    def test_an_episode_is_never_overwritten(self, folder):
        with pytest.raises(EpisodeError, match="never overwritten"):
            write_recorded_episode(folder)

    def test_only_synthetic_episodes_know_the_truth(self, tmp_path):
        with pytest.raises(EpisodeError, match="only synthetic recordings know"):
            read_truth(tmp_path)


class TestFoundBack:
    def test_the_cloth_is_left_and_the_robot_is_gone(self, folder, mask):
        raw, truth = read_raw_episode(folder), read_truth(folder)
        figures = evaluate_clouds(fuse(raw, mask, SETTINGS), raw, truth)
        assert figures.robot.sum() <= 0.002 * figures.points.sum()
        assert figures.table.sum() <= 0.01 * figures.points.sum()
        assert figures.lost.max() <= 0.1  # it lies on the table but for the corner that the fingers hold
        assert figures.cloud_to_cloth_m.mean() <= 0.004
        assert figures.cloth_to_cloud_m.mean() <= 0.004
        assert figures.flat.tolist() == [True] + [False] * (FRAMES - 1)

    def test_what_faultless_cameras_see_lies_on_the_cloth(self, folder):
        raw, truth = read_raw_episode(folder), read_truth(folder)
        for cloud, nodes in zip(visible_clouds(raw, truth), truth.nodes, strict=True):
            assert (cloud.min(axis=0) >= nodes.min(axis=0) - 1e-5).all()
            assert (cloud.max(axis=0) <= nodes.max(axis=0) + 1e-5).all()

    def test_extrinsics_are_recovered_within_2_mm(self, shifted, mask):
        raw, truth = read_raw_episode(shifted), read_truth(shifted)
        assert off_by(truth, raw.cameras["side"].info.T_world_camera, "side") > 0.004
        found = fuse(raw, mask, SETTINGS).meta["quality"]["refinement"]
        assert off_by(truth, np.array(found["T_world_camera"]["side"]), "side") < 0.002
        assert found["shift_m"]["overhead"] == 0.0

    def test_cameras_moved_together_are_found_by_the_arm(self, tmp_path, mask):
        seen = smooth_motion(LIFT, frames=6)
        folder = write_recorded_episode(tmp_path / "moved", seen=seen, rig_error=(20.0, 2.0))
        raw, truth = read_raw_episode(folder), read_truth(folder)
        stated = {name: camera.info.T_world_camera for name, camera in raw.cameras.items()}
        assert min(off_by(truth, stated[name], name) for name in stated) > 0.02
        between = [inverse(poses["overhead"]) @ poses["side"] for poses in (stated, truth.T_world_camera)]
        np.testing.assert_allclose(*between, atol=1e-12)
        found = fuse(raw, mask, SETTINGS).meta["quality"]["refinement"]
        assert max(off_by(truth, np.array(pose), name) for name, pose in found["T_world_camera"].items()) < 0.005
        assert found["clock_offset_s"] == pytest.approx(0.02, abs=0.004)
        assert abs(found["clock_offset_s"] - 0.02) < 3 * found["lag_sigma_s"] < 0.01

    def test_right_extrinsics_are_not_made_worse(self, folder, mask):
        raw, truth = read_raw_episode(folder), read_truth(folder)
        refined, plain = (
            fuse(raw, mask, replace(SETTINGS, refine=refine, clock_offset_s=0.02)) for refine in (True, False)
        )
        found = refined.meta["quality"]["refinement"]
        assert off_by(truth, np.array(found["T_world_camera"]["side"]), "side") < 0.0015
        assert 0 < found["skin_m"] < 0.003  # drawn from 0 to 3 mm
        distances = [evaluate_clouds(episode, raw, truth).cloud_to_cloth_m.mean() for episode in (refined, plain)]
        assert distances[0] < distances[1] + 0.0003
