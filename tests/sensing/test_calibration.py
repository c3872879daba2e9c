"""Cameras are found where they stand: projections, checkerboard registration, ChArUco hand-eye calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from diffcloud.errors import CalibrationError
from diffcloud.io.calibrations import read_calibration
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.images import read_color
from diffcloud.io.raw_episodes import CameraInfo, RawEpisodeWriter, RobotLog, RobotSample, read_raw_episode
from diffcloud.sensing.calibration.charuco import CameraViews, CharucoBoard, View
from diffcloud.sensing.calibration.checkerboard import onto_plane, register_checkerboard, rigid_motion
from diffcloud.sensing.calibration.hand_eye import calibrate_hand_eye, find_views, still_pose
from diffcloud.sensing.cameras import depth_points, inverse, project, rays, transform
from tests.cli.invoke import invoke
from tests.hardware.rig_files import write_rig
from tests.sensing.charuco_scene import BOARD, CAMERAS, GRIPPER_BOARD, INTRINSICS, board_depth, gripper_poses, render

LENS = (0.12, -0.25, 0.001, -0.0007, 0.08)


def apart(found, true):
    """Millimetres and degrees between two poses."""
    turn = Rotation.from_matrix(found[:3, :3] @ true[:3, :3].T).magnitude()
    return 1000 * np.linalg.norm(found[:3, 3] - true[:3, 3]), np.rad2deg(turn)


KINECT = (0.5, -2.6, 5e-4, -3e-4, 1.5, 0.38, -2.4, 1.4)
"""Rational: the coefficients of an Azure Kinect's depth camera, in their size."""


@pytest.mark.parametrize(
    "lens", [KINECT, (*KINECT, 0.01, -0.002, 0.003, 0.001), (*KINECT, 0.01, -0.002, 0.003, 0.001, 0.02, -0.03)]
)
def test_opencv_agrees_about_all_coefficients(lens, rng):
    import cv2

    camera = Intrinsics(640, 576, 504.0, 504.0, 320.0, 290.0, "brown_conrady", lens)
    points = rng.uniform([-0.5, -0.5, 0.8], [0.5, 0.5, 1.5], (50, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, np.array(lens))
    np.testing.assert_allclose(project(points, camera), expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(rays(expected[:, 0], camera) * points[:, 2:], points, atol=1e-8)


@pytest.mark.parametrize("lens", [(), (0.05, -0.02, 0.01, -0.003), (-0.03, 0.002, 0.0, 0.0)])
def test_opencv_agrees_about_fisheyes(lens, rng):
    import cv2

    camera = Intrinsics(640, 576, 250.0, 251.0, 320.0, 290.0, "equidistant", lens)
    points = np.concatenate([rng.uniform([-2, -2, 0.8], [2, 2, 1.5], (50, 3)), [[0, 0, 1]]])
    held = np.array(lens or (0.0,) * 4)
    expected, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), camera.matrix, held)
    np.testing.assert_allclose(project(points, camera), expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(rays(project(points, camera), camera) * points[:, 2:], points, atol=1e-8)


@pytest.mark.parametrize("model", ["none", "brown_conrady", "inverse_brown_conrady"])
class TestProjection:
    def intrinsics(self, model):
        return Intrinsics(640, 480, 614.9, 615.0, 314.0, 239.6, model, () if model == "none" else LENS)

    def test_back_projection_is_the_inverse(self, model, rng):
        camera = self.intrinsics(model)
        pixels = rng.uniform([0, 0], [640, 480], (200, 2))
        points = rays(pixels, camera) * rng.uniform(0.3, 2.0, (200, 1))
        np.testing.assert_allclose(project(points, camera), pixels, atol=1e-8)

    def test_opencv_agrees(self, model, rng):
        import cv2

        camera = self.intrinsics(model)
        points = rng.uniform([-0.4, -0.3, 0.8], [0.4, 0.3, 1.5], (50, 3))
        if model == "inverse_brown_conrady":  # OpenCV's forward polynomial is this model's way back
            ideal = project(points, camera)
            forward = Intrinsics(640, 480, 614.9, 615.0, 314.0, 239.6, "brown_conrady", LENS)
            again = project(rays(ideal, replace(camera, distortion="none", coefficients=())), forward)
            np.testing.assert_allclose(
                rays(again, forward), rays(ideal, replace(forward, distortion="none", coefficients=()))
            )
            return
        expected, _ = cv2.projectPoints(
            points, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.coefficients or [0.0] * 5)
        )
        np.testing.assert_allclose(project(points, camera), expected[:, 0], atol=1e-9)


def test_depth_becomes_points(rng):
    camera = Intrinsics(40, 30, 50.0, 50.0, 19.5, 14.5)
    depth = np.zeros((30, 40), np.uint16)
    depth[7, 11] = 800
    points, pixels = depth_points(depth, camera, 0.001)
    assert pixels.tolist() == [[11, 7]]
    np.testing.assert_allclose(points, [[(11 - 19.5) / 50 * 0.8, (7 - 14.5) / 50 * 0.8, 0.8]])


class TestRegistration:
    GRID = np.stack(np.meshgrid(np.arange(5) * 0.055, np.arange(5) * 0.055), -1).reshape(-1, 2)

    def corners(self):
        robot = np.column_stack([np.add(self.GRID, [0.54, -0.11]), np.full(25, 0.055)])
        return transform(inverse(CAMERAS["overhead"]), robot), robot

    def test_exact_corners_give_the_exact_pose(self):
        found = register_checkerboard(*self.corners())
        np.testing.assert_allclose(found.T_world_camera, CAMERAS["overhead"], atol=1e-12)
        assert found.rms_m < 1e-12
        assert found.scale == pytest.approx(1.0)

    def test_a_depth_scale_error_is_reported(self):
        camera, robot = self.corners()
        assert register_checkerboard(1.04 * camera, robot).scale == pytest.approx(1 / 1.04)

    def test_the_plane_is_least_squares_in_z(self, rng):
        """Against a plain search: no nearby plane has smaller vertical residuals."""
        points = rng.normal(size=(30, 3))
        best = ((onto_plane(points) - points)[:, 2] ** 2).sum()
        a, b, c = np.linalg.lstsq(np.column_stack([points[:, :2], np.ones(30)]), onto_plane(points)[:, 2], rcond=None)[0]
        for step in 1e-3 * np.concatenate([np.eye(3), -np.eye(3)]):
            z = points[:, 0] * (a + step[0]) + points[:, 1] * (b + step[1]) + c + step[2]
            assert ((z - points[:, 2]) ** 2).sum() > best

    def test_the_motion_is_the_nearest_and_right_handed(self, rng):
        points = rng.normal(size=(20, 3))
        noisy = transform(CAMERAS["side"], points) + 0.05 * rng.normal(size=(20, 3))
        matrix = rigid_motion(points, noisy)
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
        best = ((transform(matrix, points) - noisy) ** 2).sum()
        for _ in range(20):
            other = matrix.copy()
            other[:3, :3] = Rotation.from_rotvec(0.01 * rng.normal(size=3)).as_matrix() @ matrix[:3, :3]
            other[:3, 3] = (noisy - points @ other[:3, :3].T).mean(axis=0)
            assert ((transform(other, points) - noisy) ** 2).sum() > best

    @pytest.mark.parametrize(
        ("camera", "message"),
        [
            (np.zeros((3, 3)), "same corners"),
            (np.full((25, 3), np.nan), "NaN"),
            (np.outer(np.arange(25), [0.01, 0.02, 0.03]), "on a line"),
            (np.full((25, 3), 900.0), "millimetres"),
        ],
    )
    def test_bad_corners(self, camera, message):
        with pytest.raises(CalibrationError, match=message):
            register_checkerboard(camera, self.corners()[1])

    def test_the_published_calibration(self, release, tmp_path):
        folders = [release.parent / f"calib_{name}" for name in ("overhead", "side")]
        if not all(folder.is_dir() for folder in folders):
            pytest.skip("the published calibration points (calib_overhead/, calib_side/) are not beside DIFFCLOUD_RELEASE")
        done = invoke("data", "calibrate", "--method", "checkerboard", *folders, "--out", tmp_path / "c.json")
        written = read_calibration(tmp_path / "c.json")
        for folder, name in zip(folders, ("overhead", "side"), strict=True):
            published = np.load(folder / "tcr.npy")
            found = written.camera(name)
            assert np.abs(found.T_world_camera[:3] - published).max() < 1e-6
            assert 3.5 < done.result["cameras"][name]["rms_mm"] < 5.0
            assert done.result["cameras"][name]["largest_mm"] < 10
            assert 1.02 < done.result["cameras"][name]["depth_scale"] < 1.07
        # both see it alike, 3.4 %: one board is likelier than two depth scales
        assert "Camera side sees the board 3.4 % too large" in done.errors
        assert (
            "the board's squares, as all cameras see them alike: 56.8 mm where the robot's corners are 55.0" in done.errors
        )


def views_of(poses, rng, *, noise_px=0.1, gripper_noise=0.0, cameras=CAMERAS):
    """Exact corners with noise, without images; and the poses the robot believes."""
    corners = BOARD.corners()
    true = poses.copy()
    if gripper_noise:
        for pose in true:
            pose[:3, 3] += gripper_noise * rng.normal(size=3)
    found = {}
    for name, camera in cameras.items():
        views = []
        for index, pose in enumerate(true):
            pixels = project(transform(inverse(camera) @ pose @ GRIPPER_BOARD, corners), INTRINSICS[name])
            views.append(View(index, np.arange(len(corners)), pixels + noise_px * rng.normal(size=pixels.shape)))
        found[name] = CameraViews(INTRINSICS[name], tuple(views))
    return found


class TestHandEye:
    def test_without_noise_it_is_exact(self, rng):
        poses = gripper_poses(8, rng)
        found = calibrate_hand_eye(views_of(poses, rng, noise_px=0.0), poses, BOARD)
        for name, true in CAMERAS.items():
            np.testing.assert_allclose(found.T_world_camera[name], true, atol=1e-7)
            assert found.residuals[name]["rms_px"] < 1e-5
        np.testing.assert_allclose(found.T_gripper_board, GRIPPER_BOARD, atol=1e-7)
        assert "15 or more are advised" in found.warnings[0]

    def test_one_camera_is_enough(self, rng):
        poses = gripper_poses(10, rng)
        one = {"side": CAMERAS["side"]}
        found = calibrate_hand_eye(views_of(poses, rng, noise_px=0.05, cameras=one), poses, BOARD)
        millimetres, degrees = apart(found.T_world_camera["side"], CAMERAS["side"])
        assert millimetres < 1.0
        assert degrees < 0.1

    @pytest.mark.slow
    def test_the_covariance_tells_how_far_off_it_is(self, rng):
        """With an arm that is off by half a millimetre at each pose, over repeated calibrations."""
        squared = []
        for _ in range(12):
            poses = gripper_poses(18, rng)
            found = calibrate_hand_eye(views_of(poses, rng, gripper_noise=5e-4), poses, BOARD)
            for name, true in CAMERAS.items():
                matrix = found.T_world_camera[name]
                turn = Rotation.from_matrix(matrix[:3, :3] @ true[:3, :3].T).as_rotvec()
                off = np.concatenate([matrix[:3, 3] - true[:3, 3], turn])
                squared.append(off**2 / np.diag(found.covariance[name]))
        assert 0.5 < np.mean(squared) < 3.0  # 1 if it were exact; eighteen clusters are few

    def test_an_outlier_hardly_matters(self, rng):
        poses = gripper_poses(16, rng)
        views = views_of(poses, rng)
        wrong = views["side"].views[3].pixels.copy()
        wrong[5] += 60.0
        damaged = tuple(replace(view, pixels=wrong) if view.pose == 3 else view for view in views["side"].views)
        found = calibrate_hand_eye({**views, "side": CameraViews(INTRINSICS["side"], damaged)}, poses, BOARD)
        assert apart(found.T_world_camera["side"], CAMERAS["side"])[0] < 1.0

    def test_what_cannot_be_solved_is_refused(self, rng):
        poses = gripper_poses(12, rng)
        with pytest.raises(CalibrationError, match="saw the board at 3 still poses; at least 5"):
            calibrate_hand_eye(views_of(poses[:3], rng), poses, BOARD)
        flat = gripper_poses(12, rng, tilt_deg=0.0)
        with pytest.raises(CalibrationError, match="Tilt the board about two axes"):
            calibrate_hand_eye(views_of(flat, rng), flat, BOARD)
        with pytest.raises(CalibrationError, match="Unknown dictionary"):
            replace(BOARD, dictionary="DICT_9").opencv()
        with pytest.raises(CalibrationError, match="0 < marker < square"):
            replace(BOARD, marker_m=0.05)


def write_board_episode(folder, poses, rng, *, depth_scale=1.0):
    """A raw episode that holds still for a second at each pose; rendered images."""
    infos = {name: CameraInfo(name, f"serial-{name}", INTRINSICS[name], 0.001) for name in CAMERAS}
    with RawEpisodeWriter(folder, infos, rate_hz=1.0, source="test", robot={}, durable=False) as writer:
        for index, pose in enumerate(poses):
            quaternion = np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)
            for t in (0.0, 0.5):
                writer.add_robot(RobotSample(index + t, np.zeros(7), 0.0, pose[:3, 3], quaternion))
            for name, camera in CAMERAS.items():
                chain = inverse(camera) @ pose @ GRIPPER_BOARD
                depth = board_depth(chain, INTRINSICS[name], depth_scale)
                writer.add_frame(name, index + 0.25, depth, render(chain, INTRINSICS[name], rng))
    return folder


def test_charuco_images_give_the_cameras_within_a_millimetre(tmp_path, rng):
    """The acceptance line: 1 mm and 0.1 degrees from synthetic images, with a depth scale that is 3 % off beside."""
    poses = gripper_poses(20, rng)
    folder = write_board_episode(tmp_path / "e", poses, rng, depth_scale=1.03)
    done = invoke(
        "data",
        "calibrate",
        folder,
        "--out",
        tmp_path / "c.json",
        "--picture",
        tmp_path / "p.png",
        "--rig",
        write_rig(tmp_path, board={"square_m": 0.04, "marker_m": 0.03}),
    )
    written = read_calibration(tmp_path / "c.json")
    for name, true in CAMERAS.items():
        entry = written.camera(f"serial-{name}")
        millimetres, degrees = apart(entry.T_world_camera, true)
        print(f"{name}: {millimetres:.3f} mm, {degrees:.4f} degrees; {dict(entry.residuals)}")
        assert millimetres < 1.0
        assert degrees < 0.1
        assert entry.residuals["rms_px"] < 0.3
        assert entry.residuals["rms_mm"] < 2.0
        assert entry.residuals["depth_scale"] == pytest.approx(1.03, abs=0.003)
        assert entry.covariance.shape == (6, 6)
        assert entry.name == name
    assert "measures depth +3.0 %" in done.errors
    picture = read_color(tmp_path / "p.png")
    assert picture.shape == (960, 1920, 3)
    assert (picture == [255, 0, 0]).all(axis=-1).sum() > 100


@pytest.mark.parametrize(("numbers", "seen"), [(range(0, 24, 4), 0), ([*range(0, 24, 4), 1], 7), ([0, 5, 10, 15, 3, 6], 6)])
def test_corners_on_one_line_are_no_view(monkeypatch, numbers, seen):
    """They leave open how the board is turned about that line."""
    import cv2

    class Detector:
        def __init__(self, board):
            pass

        def detectBoard(self, image):
            return np.zeros((len(numbers), 1, 2), np.float32), np.array(numbers).reshape(-1, 1), None, None

    monkeypatch.setattr(cv2.aruco, "CharucoDetector", Detector)
    found, pixels = BOARD.detect(np.zeros((4, 4, 3), np.uint8))
    assert len(found) == len(pixels) == seen


@pytest.mark.parametrize(
    ("factor", "message"), [(0.5, r"has a length of 0\.5 instead of 1"), (np.nan, "no poses of the tool")]
)
def test_orientations_that_are_none(factor, message):
    quaternions = factor * np.tile([1.0, 0, 0, 0], (3, 1))
    log = RobotLog(np.arange(3.0), np.zeros((3, 7)), np.zeros(3), np.zeros((3, 3)), quaternions, np.zeros((3, 6)))
    with pytest.raises(CalibrationError, match=message):
        find_views({}, log, BOARD)


def test_a_moving_gripper_gives_no_pose(tmp_path, rng):
    times = np.arange(11) / 10
    position = np.column_stack([np.where(times > 0.5, times - 0.5, 0), np.zeros(11), np.zeros(11)])
    still = np.tile([1.0, 0, 0, 0], (11, 1))
    log = RobotLog(times, np.zeros((11, 7)), np.zeros(11), position, still, np.zeros((11, 6)))
    assert still_pose(log, 0.25) is not None
    assert still_pose(log, 0.75) is None
    assert still_pose(log, 9.0) is None


@pytest.mark.parametrize("rows", [6, 8])
@pytest.mark.parametrize("legacy", [False, True])
def test_the_pattern_of_a_board_is_found_by_itself(tmp_path, rng, rows, legacy):
    """With an even number of rows, OpenCV before 4.6 and calib.io print another pattern. Corners stay where they are."""
    board = CharucoBoard(5, rows, 0.04, 0.03, legacy=legacy)
    poses = gripper_poses(5, rng)
    infos = {"side": CameraInfo("side", "1", INTRINSICS["side"], 0.001)}
    with RawEpisodeWriter(tmp_path / "e", infos, rate_hz=1, source="test", robot={}, durable=False) as writer:
        for index, pose in enumerate(poses):
            turned = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
            for t in (index, index + 0.9):
                writer.add_robot(RobotSample(t, np.zeros(7), 0.0, pose[:3, 3], turned))
            seen = inverse(CAMERAS["side"]) @ pose @ GRIPPER_BOARD
            picture = render(seen, INTRINSICS["side"], board=board)
            writer.add_frame("side", index + 0.5, board_depth(seen, INTRINSICS["side"]), picture)
    episode = read_raw_episode(tmp_path / "e")
    views, held = find_views(episode.cameras, episode.robot, CharucoBoard(5, rows, 0.04, 0.03))
    assert sum(len(view.numbers) for view in views["side"].views) > 10 * len(poses)
    for view in views["side"].views:
        points = transform(inverse(CAMERAS["side"]) @ held[view.pose] @ GRIPPER_BOARD, board.corners()[view.numbers])
        assert np.abs(project(points, INTRINSICS["side"]) - view.pixels).max() < 1.0


def test_a_board_that_is_not_there(tmp_path, rng):
    infos = {"side": CameraInfo("side", "1", INTRINSICS["side"], 0.001)}
    with RawEpisodeWriter(tmp_path / "e", infos, rate_hz=1, source="test", robot={}, durable=False) as writer:
        for t in (0.0, 1.0):
            writer.add_robot(RobotSample(t, np.zeros(7), 0.0, np.zeros(3), np.array([1.0, 0, 0, 0])))
        writer.add_frame("side", 0.5, np.ones((480, 640), np.uint16), np.full((480, 640, 3), 90, np.uint8))
    assert (
        "saw the board at 0 still poses"
        in invoke("data", "calibrate", tmp_path / "e", "--out", tmp_path / "c.json", code=1).errors
    )
    assert not (tmp_path / "c.json").exists()
