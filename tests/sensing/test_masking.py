"""Ray-cast masks against brute force over triangles; shadows, flying pixels, joints between rows."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.errors import EpisodeError
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.raw_episodes import RobotLog
from diffcloud.io.urdf import Joint, LinkMesh, RobotDescription
from diffcloud.sensing.cameras import inverse, looking_at, project, transform
from diffcloud.sensing.masking import RobotMask, View, flying_pixels, inflate, joints_at, spoilt_pixels
from diffcloud.sensing.robot import GEN3_HOME_RAD, Robot, gen3

INTRINSICS = Intrinsics(40, 30, 38.0, 38.0, 19.5, 14.5)
AHEAD = View(INTRINSICS, np.eye(4))


def brute_force_depth(vertices: np.ndarray, faces: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """[...] first hit of rays from the origin: Möller and Trumbore on every pair of ray and triangle."""
    a, b, c = (vertices[faces[:, index]] for index in range(3))
    d = directions[..., None, :]
    p = np.cross(d, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / ((b - a) * p).sum(-1)
        u = (-a * p).sum(-1) * scale
        q = np.cross(-a, b - a)
        v = (d * q).sum(-1) * scale
        t = ((c - a) * q).sum(-1) * scale
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return np.where(hit, t, np.inf).min(axis=-1)


def one_box(low: tuple[float, ...], high: tuple[float, ...]) -> Robot:
    """A robot that is one box in the world."""
    import trimesh

    box = trimesh.creation.box(bounds=[low, high])
    mesh = LinkMesh(np.asarray(box.vertices), np.asarray(box.faces))
    still = Joint("j", "revolute", "base", "tool_frame", np.eye(4), np.array([0.0, 0.0, 1.0]), -1.0, 1.0)
    return Robot(RobotDescription("box", "base", (still,), {"base": mesh}))


def poses(robot: Robot) -> np.ndarray:
    return robot.forward_kinematics(np.zeros(len(robot.moving)))


@pytest.mark.parametrize("distortion", ["none", "brown_conrady", "inverse_brown_conrady"])
@pytest.mark.parametrize("inflation", [0.0, 0.02])
def test_the_arm_is_where_brute_force_sees_it(distortion, inflation):
    robot = gen3()
    coefficients = () if distortion == "none" else (0.1, -0.05, 0.002, -0.001, 0.01)
    place = looking_at((1.4, -0.6, 0.9), (0.3, 0.0, 0.4))
    view = View(Intrinsics(40, 30, 38.0, 38.0, 19.5, 14.5, distortion, coefficients), place)
    placed = robot.forward_kinematics(robot.configuration(GEN3_HOME_RAD, 0.5))
    expected = np.full((30, 40), np.inf)
    for name, mesh in robot.description.meshes.items():
        solid = inflate(mesh, inflation)
        here = transform(inverse(view.T_world_camera) @ placed[robot.links.index(name)], solid.vertices)
        expected = np.minimum(expected, brute_force_depth(here, solid.faces, view.directions))
    found = RobotMask(robot, robot_margin_m=inflation).surface(view, placed)
    differing = np.isfinite(found) != np.isfinite(expected)
    assert np.isfinite(expected).mean() > 0.05
    assert differing.sum() <= 1  # float32 rays may pass an edge on its other side
    both = np.isfinite(found) & np.isfinite(expected)
    np.testing.assert_allclose(found[both], expected[both], atol=1e-4)


def test_a_link_behind_the_camera_still_masks_what_reaches_before_it():
    robot = one_box((-0.1, -0.1, -1.0), (0.1, 0.1, 1.0))
    assert np.isfinite(RobotMask(robot).surface(AHEAD, poses(robot))).all()  # the camera stands inside


def test_inflation_moves_every_face_of_a_box_by_the_margin():
    robot = one_box((-0.1, -0.2, 0.5), (0.3, 0.2, 0.9))
    solid = inflate(robot.description.meshes["base"], 0.03)
    np.testing.assert_allclose(solid.vertices.min(axis=0), [-0.13, -0.23, 0.47], atol=1e-9)
    np.testing.assert_allclose(solid.vertices.max(axis=0), [0.33, 0.23, 0.93], atol=1e-9)


def test_a_box_shrinks_by_a_negative_margin_and_each_link_by_its_own():
    robot = one_box((-0.1, -0.2, 0.5), (0.3, 0.2, 0.9))
    solid = inflate(robot.description.meshes["base"], -0.03)
    np.testing.assert_allclose(solid.vertices.min(axis=0), [-0.07, -0.17, 0.53], atol=1e-9)
    np.testing.assert_allclose(solid.vertices.max(axis=0), [0.27, 0.17, 0.87], atol=1e-9)
    for margins, expected in (({"base": -0.03}, 0.53), ({"base": 0.03}, 0.47), ({}, 0.5)):
        depth = RobotMask(robot, robot_margin_m=margins).surface(AHEAD, poses(robot))
        np.testing.assert_allclose(depth[15, 20], expected, atol=1e-6)


def test_rays_that_pass_within_the_margin_are_masked(rng):
    robot = gen3()
    placed = robot.forward_kinematics(robot.configuration(GEN3_HOME_RAD))
    place = looking_at((1.4, -0.6, 0.9), (0.3, 0.0, 0.4))
    view = View(Intrinsics(160, 120, 150.0, 150.0, 79.5, 59.5), place)
    masked = np.isfinite(RobotMask(robot, robot_margin_m=0.02).surface(view, placed))
    near = []
    for name, mesh in robot.description.meshes.items():
        shifted = mesh.vertices + rng.normal(size=mesh.vertices.shape) * 0.005
        near.append(transform(inverse(view.T_world_camera) @ placed[robot.links.index(name)], shifted))
    pixel = np.rint(project(np.concatenate(near), view.intrinsics)).astype(int)
    pixel = pixel[((pixel >= 0) & (pixel < [160, 120])).all(axis=1)]
    assert len(pixel) > 1000
    assert masked[pixel[:, 1], pixel[:, 0]].mean() > 0.998


def test_cloth_before_the_robot_stays_and_behind_it_goes():
    robot = one_box((-0.1, -0.1, 0.8), (0.1, 0.1, 0.9))
    mask = RobotMask(robot, robot_margin_m=0.01)
    for depth, gone in ((0.7, False), (0.795, True), (0.85, True), (1.5, True)):
        found = spoilt_pixels(np.full((30, 40), depth), AHEAD, mask, poses(robot), imager_offsets_m=())
        assert found.robot[15, 20] == gone
        assert not found.robot[0, 0]
        assert not found.flying.any()


def test_shadow_is_what_the_second_eye_cannot_see():
    robot = one_box((-0.1, -0.4, 0.5), (0.1, 0.4, 0.52))
    mask = RobotMask(robot, robot_margin_m=0.0)
    found = spoilt_pixels(np.full((30, 40), 1.0), AHEAD, mask, poses(robot), imager_offsets_m=(0.05,))
    x = AHEAD.directions[15, :, 0]  # on the wall at 1 m
    # the eye at 0.05 m sees the wall left of where its ray past the box's left edge ends
    np.testing.assert_array_equal(found.shadow[15], (x >= 0.05 + (-0.1 - 0.05) / 0.5) & (x < -0.1 / 0.5))
    assert found.shadow[15].any()
    assert not (found.shadow & found.robot).any()


def test_pixels_outside_the_workspace_and_without_depth_are_in_no_set():
    robot = one_box((-0.1, -0.1, 0.8), (0.1, 0.1, 0.9))
    within = np.zeros((30, 40), dtype=bool)
    within[:, 20:] = True
    depth = np.full((30, 40), 1.0)
    depth[13:16] = 0.0
    found = spoilt_pixels(depth, AHEAD, RobotMask(robot), poses(robot), within=within)
    assert found.robot[:, 20:].any()
    assert not found.any[:, :20].any()
    assert not found.any[13:16].any()


def test_flying_pixels_lie_between_two_surfaces():
    depth = np.full((12, 12), 1.0)
    depth[:, 6:] = 1.5
    depth[:, 5] = 1.2 + 0.02 * np.arange(12)  # a mixed column
    found = flying_pixels(depth, 0.01)
    np.testing.assert_array_equal(found[1:-1], np.tile(np.arange(12) == 5, (10, 1)))
    slanted = 1.0 + 0.004 * np.arange(12)[None, :] * np.ones((12, 1))
    assert not flying_pixels(slanted, 0.01)[1:-1].any()
    assert not flying_pixels(np.zeros((4, 4)), 0.01).any()


def log(times: np.ndarray, joints: np.ndarray, gripper: np.ndarray) -> RobotLog:
    count = len(times)
    return RobotLog(times, joints, gripper, np.zeros((count, 3)), np.zeros((count, 4)), np.zeros((count, 6)))


def test_joints_between_rows_and_across_the_turn():
    angles = np.array([6.2, 6.28, 6.36, 6.44]) % (2 * np.pi)
    rows = log(np.arange(4) / 10, angles[:, None], np.array([0.0, np.nan, 1.0, 1.0]))
    joints, gripper = joints_at(rows, np.array([0.05, 0.15, 0.35]))
    np.testing.assert_allclose(joints[:, 0], [6.24, 6.32, 6.44], atol=1e-12)
    np.testing.assert_allclose(gripper, [0.25, 0.75, 1.0])
    late, _ = joints_at(rows, np.array([0.05]), clock_offset_s=0.05)
    np.testing.assert_allclose(late, [[6.28]])


def test_a_log_shorter_than_the_video_is_refused():
    rows = log(np.arange(4) / 10, np.zeros((4, 7)), np.zeros(4))
    with pytest.raises(EpisodeError, match=r"covers 0\.00 to 0\.30 s, the images 0\.00 to 1\.00 s"):
        joints_at(rows, np.array([0.0, 1.0]))
    with pytest.raises(EpisodeError, match="empty"):
        joints_at(log(np.zeros(0), np.zeros((0, 7)), np.zeros(0)), np.array([0.0]))
