"""A calibration states its error on poses it has not seen, names what was entered wrongly, and is then not written."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from diffcloud.errors import CalibrationError
from diffcloud.io.calibrations import read_calibration
from diffcloud.io.images import write_depth
from diffcloud.sensing.calibration.chain import Estimate
from diffcloud.sensing.calibration.charuco import CameraViews, View
from diffcloud.sensing.calibration.checks import CameraEvidence, judge_hand_eye
from diffcloud.sensing.calibration.hand_eye import calibrate_hand_eye
from diffcloud.sensing.cameras import inverse, project, transform
from tests.cli.invoke import invoke
from tests.hardware.rig_files import write_rig
from tests.sensing.charuco_scene import BOARD, CAMERAS, GRIPPER_BOARD, INTRINSICS, gripper_poses
from tests.sensing.test_calibration import write_board_episode

TOOL = ["tool_qw", "tool_qx", "tool_qy", "tool_qz"]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Fifteen poses before two cameras, everything right."""
    rng = np.random.default_rng(0)
    return write_board_episode(tmp_path_factory.mktemp("board") / "e", gripper_poses(15, rng), rng)


@pytest.fixture
def episode(recorded, tmp_path):
    return shutil.copytree(recorded, tmp_path / "e")


def calibrated(tmp_path, *options, code=0, square=40):
    rig = write_rig(tmp_path, board={"square_m": square / 1000, "marker_m": 0.75 * square / 1000})
    return invoke("data", "calibrate", tmp_path / "e", "--rig", rig, "--out", tmp_path / "c.json", *options, code=code)


def edit_camera(episode, name, change):
    path = episode / "cameras" / name / "camera.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def edit_log(episode, change):
    table = pd.read_csv(episode / "robot.csv")
    change(table)
    table.to_csv(episode / "robot.csv", index=False)


def keep_poses(episode, count):
    """The first few poses alone."""
    path = episode / "robot.csv"
    path.write_text("\n".join(path.read_text().splitlines()[: 1 + 2 * count]) + "\n")


class TestWrittenOrNot:
    def test_a_good_calibration_is_written_with_its_held_out_error(self, episode, tmp_path):
        done = calibrated(tmp_path)
        written = read_calibration(tmp_path / "c.json")
        for name in CAMERAS:
            residuals = written.camera(f"serial-{name}").residuals
            assert residuals["held_out_poses"] == residuals["poses"] == 15
            assert residuals["rms_fit_mm"] < residuals["rms_mm"] < 2.0
            assert residuals["focal_scale"] == pytest.approx(1, abs=0.01)
        assert done.result["square_by_arm_m"] == pytest.approx(0.04, abs=1e-4)
        assert done.result["forced"] is False
        assert done.result["objections"] == done.result["warnings"] == []
        assert written.objections == ()

    def test_five_poses_are_refused(self, episode, tmp_path):
        keep_poses(episode, 5)
        bad = calibrated(tmp_path, "--picture", tmp_path / "p.png", code=1)
        assert "The calibration is not written" in bad.errors
        assert "Camera side has 5 poses that could be held out" in bad.errors
        assert not (tmp_path / "c.json").exists()
        assert (tmp_path / "p.png").exists()  # what there is to see helps to find out why

    def test_force_is_recorded_in_the_file(self, episode, tmp_path):
        keep_poses(episode, 5)
        done = calibrated(tmp_path, "--force")
        assert done.result["forced"] is True
        assert json.loads((tmp_path / "c.json").read_text())["forced"] is True
        assert "Camera side has 5 poses" in " ".join(read_calibration(tmp_path / "c.json").objections)
        assert "Camera side has 5 poses" in done.errors

    def test_more_than_ten_millimetres_off_is_refused(self, episode, tmp_path):
        """An arm that says another place than where it is, by 15 mm at each pose."""
        rng = np.random.default_rng(1)
        off = np.repeat(rng.normal(size=(15, 3)) * 0.015, 2, axis=0)

        def change(table):
            table[["tool_x", "tool_y", "tool_z"]] += off

        edit_log(episode, change)
        bad = calibrated(tmp_path, code=1)
        assert "The error on held-out poses is" in bad.errors
        assert "mm (camera side); at most 10 mm are allowed" in bad.errors
        assert not (tmp_path / "c.json").exists()


class TestSuspects:
    """Each of them wrong alone, by the recording's own images."""

    def test_square_size(self, episode, tmp_path):
        bad = calibrated(tmp_path, square=44, code=1)
        assert "Suspected is the board's square size" in bad.errors
        assert "its squares are 40.0 mm, entered are 44.0 mm, and depth agrees with the arm" in bad.errors
        assert bad.errors.count("Suspected") == 1
        assert not (tmp_path / "c.json").exists()

    def test_square_size_without_depth(self, episode, tmp_path):
        for path in episode.glob("cameras/*/depth/*.png"):
            write_depth(path, np.zeros((480, 640), np.uint16))
        bad = calibrated(tmp_path, square=44, code=1)
        assert "the board's square size, or the scale of the arm's positions" in bad.errors

    @pytest.mark.parametrize("name", ["overhead", "side"])
    def test_depth_scale_of_one_camera(self, episode, tmp_path, name):
        """It leaves the camera's place right, so the calibration is written."""
        edit_camera(episode, name, lambda data: data.update(depth_scale_m=0.00095))
        done = calibrated(tmp_path)
        (message,) = done.result["warnings"]
        assert message.startswith(
            f"Camera {name} measures depth -5.0 % off the board's geometry. Suspected is its depth scale"
        )
        assert done.result["forced"] is False

    @pytest.mark.parametrize("factor", [0.95, 1.06])
    @pytest.mark.parametrize("name", ["overhead", "side"])
    def test_focal_length_of_one_camera(self, episode, tmp_path, name, factor):
        def change(data):
            data["intrinsics"]["fx"] *= factor
            data["intrinsics"]["fy"] *= factor

        edit_camera(episode, name, change)
        bad = calibrated(tmp_path, code=1)
        true = INTRINSICS[name].fx
        assert f"Suspected is the focal length of camera {name}" in bad.errors
        assert f"px, entered are {factor * true:.0f} px" in bad.errors
        assert bad.errors.count("Suspected") == 1
        forced = calibrated(tmp_path, "--force")
        assert forced.result["cameras"][name]["focal_scale"] == pytest.approx(1 / factor, abs=0.01)

    def test_arm_in_millimetres(self, episode, tmp_path):
        def change(table):
            table[["tool_x", "tool_y", "tool_z"]] *= 1000

        edit_log(episode, change)
        for options in ((), ("--force",)):
            bad = calibrated(tmp_path, *options, code=1)
            assert "they look like millimetres: divide by 1000" in bad.errors
        assert not (tmp_path / "c.json").exists()

    def test_scale_of_the_arm(self, episode, tmp_path):
        """Positions in another unit that is nearly right."""

        def change(table):
            table[["tool_x", "tool_y", "tool_z"]] *= 1.05

        edit_log(episode, change)
        bad = calibrated(tmp_path, code=1)
        assert "Suspected is the scale of the arm's positions" in bad.errors
        assert "its squares are 42.0 mm, entered are 40.0 mm, and depth agrees with what was entered" in bad.errors

    def test_quaternion_in_another_order(self, episode, tmp_path):
        def change(table):
            table[TOOL] = np.roll(table[TOOL].to_numpy(), -1, axis=1)

        edit_log(episode, change)
        bad = calibrated(tmp_path, code=1)
        assert "the same numbers as x, y, z, w: robot.csv takes the tool in the base frame, and tool_qw first" in bad.errors

    def test_angles_in_degrees_taken_for_radians(self, episode, tmp_path):
        def change(table):
            turns = Rotation.from_quat(np.roll(table[TOOL].to_numpy(), -1, axis=1)).as_euler("xyz", degrees=True)
            table[TOOL] = np.roll(Rotation.from_euler("xyz", turns).as_quat(), 1, axis=1)

        edit_log(episode, change)
        assert "angles in degrees were taken for radians" in calibrated(tmp_path, code=1).errors

    def test_angles_in_degrees_in_place_of_a_quaternion(self, episode, tmp_path):
        def change(table):
            table[TOOL] = np.column_stack([np.zeros(30), np.linspace(-180, 180, 90).reshape(30, 3)])

        edit_log(episode, change)
        bad = calibrated(tmp_path, code=1)
        assert "a unit quaternion (w, x, y, z), not angles in degrees" in bad.errors

    def test_a_log_without_tool_poses(self, episode, tmp_path):
        def change(table):
            table[["tool_x", *TOOL]] = np.nan

        edit_log(episode, change)
        assert "robot.csv has no poses of the tool" in calibrated(tmp_path, code=1).errors

    def test_a_camera_without_colour(self, episode, tmp_path):
        shutil.rmtree(episode / "cameras" / "side" / "color")
        assert "Camera side has no colour images" in calibrated(tmp_path, code=1).errors


def views_of(poses, rng, *, arm=(0.001, 0.2), depth=None, cameras=CAMERAS):
    """Corners with a pixel's sixth of noise and depth of 0.3 %, of an arm that is off by `arm` (m, degrees) at each pose.

    Args:
        depth: factor on the measured depth by camera.
    """
    true = poses.copy()
    true[:, :3, 3] += arm[0] * rng.normal(size=(len(poses), 3))
    true[:, :3, :3] = (
        Rotation.from_rotvec(np.deg2rad(arm[1]) * rng.normal(size=(len(poses), 3))).as_matrix() @ true[:, :3, :3]
    )
    found = {}
    for name, camera in cameras.items():
        views = []
        for index, pose in enumerate(true):
            local = transform(inverse(camera) @ pose @ GRIPPER_BOARD, BOARD.corners())
            pixels = project(local, INTRINSICS[name]) + 0.15 * rng.normal(size=(len(local), 2))
            measured = local[:, 2] * (depth or {}).get(name, 1.0) * (1 + 0.003 * rng.normal(size=len(local)))
            views.append(View(index, np.arange(len(local)), pixels, measured))
        found[name] = CameraViews(INTRINSICS[name], tuple(views))
    return found


class TestHeldOut:
    @pytest.mark.parametrize("count", [6, 10])
    def test_it_is_the_error_of_a_calibration_without_those_poses(self, rng, count):
        """Against calibrations that are made without them from the outset: one by one, or every fifth."""
        poses = gripper_poses(count, rng)
        views = views_of(poses, rng, cameras={"side": CAMERAS["side"]})
        stated = calibrate_hand_eye(views, poses, BOARD).residuals
        folds = 5 if count >= 10 else count
        squared = []
        for fold in range(folds):
            rest = {
                name: CameraViews(held.intrinsics, tuple(view for view in held.views if view.pose % folds != fold))
                for name, held in views.items()
            }
            found = calibrate_hand_eye(rest, poses, BOARD)
            for name, held in views.items():
                for view in held.views[fold::folds]:
                    chain = inverse(found.T_world_camera[name]) @ poses[view.pose] @ found.T_gripper_board
                    again = project(transform(chain, BOARD.corners()[view.numbers]), held.intrinsics)
                    squared.append(((again - view.pixels) ** 2).sum(axis=1))
        assert stated["side"]["held_out_poses"] == count
        assert stated["side"]["rms_px"] == pytest.approx(np.sqrt(np.mean(squared)), rel=1e-3)
        assert stated["side"]["rms_fit_px"] < stated["side"]["rms_px"]

    def test_a_pose_that_is_visited_again_is_no_new_pose(self, rng):
        """Five poses, visited three times: what is left out would stay known by the other visits."""
        poses = np.tile(gripper_poses(5, rng), (3, 1, 1))
        found = calibrate_hand_eye(views_of(poses, rng), poses, BOARD)
        assert found.residuals["side"]["poses"] == found.residuals["side"]["held_out_poses"] == 5
        assert any("Camera side has 5 poses that could be held out" in text for text in found.objections)

    def test_poses_of_another_camera_at_the_same_halt_are_left_out_with_it(self, rng):
        """As find_views numbers them: each camera's images have poses of their own."""
        poses = gripper_poses(11, rng)
        views = views_of(poses, rng)
        side = tuple(View(view.pose + 11, view.numbers, view.pixels, view.depth_m) for view in views["side"].views)
        apart = {**views, "side": CameraViews(views["side"].intrinsics, side)}
        together = calibrate_hand_eye(views, poses, BOARD).residuals
        numbered = calibrate_hand_eye(apart, np.tile(poses, (2, 1, 1)), BOARD).residuals
        for name in CAMERAS:
            assert numbered[name]["rms_px"] == pytest.approx(together[name]["rms_px"], rel=1e-6)


class TestWithAnArmThatIsOff:
    """By 1 mm and 0.2 degrees at each pose: what is wrong must stand out from that."""

    @pytest.mark.parametrize("seed", range(4))
    def test_what_is_right_is_not_suspected(self, seed):
        rng = np.random.default_rng(seed)
        poses = gripper_poses(15, rng)
        found = calibrate_hand_eye(views_of(poses, rng), poses, BOARD)
        assert found.objections == ()
        assert found.warnings == ()

    @pytest.mark.parametrize("seed", range(2))
    @pytest.mark.parametrize("cameras", [("overhead", "side"), ("side",)])
    def test_square_size(self, seed, cameras):
        """The board of 36 mm that was entered for 40 mm."""
        from dataclasses import replace

        rng = np.random.default_rng(seed)
        poses = gripper_poses(15, rng)
        views = views_of(poses, rng, cameras={name: CAMERAS[name] for name in cameras})
        found = calibrate_hand_eye(views, poses, replace(BOARD, square_m=0.04 / 0.9, marker_m=0.03))
        assert found.objections[0].startswith("Suspected is the board's square size")
        assert found.board_size.value == pytest.approx(0.9, abs=0.02)

    def test_depth_of_one_camera_leaves_two_suspects(self, rng):
        """The arm is too rough to tell its depth scale from its focal length; the other camera acquits the board."""
        poses = gripper_poses(15, rng)
        found = calibrate_hand_eye(views_of(poses, rng, depth={"side": 1.04}), poses, BOARD)
        (message,) = found.objections
        assert "Camera side measures depth +4.0 % off the board's geometry" in message
        assert "Suspected are its focal length and its depth scale" in message
        assert "square size" not in message

    def test_depth_of_all_cameras_that_the_arm_contradicts(self, rng):
        """Both measure 10 % too much, and by the arm the board is right: not the board."""
        poses = gripper_poses(15, rng)
        found = calibrate_hand_eye(views_of(poses, rng, depth=dict.fromkeys(CAMERAS, 1.10)), poses, BOARD)
        assert not any("square size" in text for text in (*found.objections, *found.warnings))
        assert sum("measures depth +10.0 %" in text for text in (*found.objections, *found.warnings)) == 2

    def test_positions_in_millimetres(self, rng):
        poses = gripper_poses(15, rng)
        views = views_of(poses, rng)
        poses[:, :3, 3] *= 1000
        with pytest.raises(CalibrationError, match="millimetres"):
            calibrate_hand_eye(views, poses, BOARD)


class TestWithAnArmThatDoesNotTell:
    """Poses so alike that the arm says neither how large the board is nor how long the focal lengths are."""

    def judged(self, **depth):
        rough = Estimate(1.0, 0.05)
        evidence = {name: CameraEvidence(15, 15, 0.1, 1.0, 0.1, 1.0, 615.0, rough, ratio) for name, ratio in depth.items()}
        return judge_hand_eye(evidence, rough, square_m=0.04)[1]

    def test_depth_of_all_cameras_alike_is_the_board(self):
        (message,) = self.judged(overhead=0.905, side=0.898)
        assert "as if its squares were 36.1 mm and not 40.0 mm. How the arm moved the board does not tell" in message

    def test_depth_of_the_only_camera_leaves_three_suspects(self):
        (message,) = self.judged(side=0.9)
        assert "Suspected are its focal length, the board's square size and its depth scale" in message


class TestCheckerboard:
    GRID = np.stack(np.meshgrid(np.arange(5) * 0.055, np.arange(5) * 0.055), -1).reshape(-1, 2)

    def folders(self, tmp_path, rng, *, seen=None, noise_m=0.001, corners=slice(None)):
        """Corners of a board that lies on the table, as folders of the published kind; `seen`: factors on what is seen."""
        found = []
        for name, pose in CAMERAS.items():
            robot = np.column_stack([np.add(self.GRID, [0.54, -0.11]), np.full(25, 0.055)])[corners]
            camera = (seen or {}).get(name, 1.0) * transform(inverse(pose), robot)
            folder = tmp_path / f"calib_{name}"
            folder.mkdir()
            np.save(folder / "robot_chessboard.npy", robot)
            np.save(folder / "cam_chessboard.npy", camera * (1 + noise_m * rng.normal(size=(len(camera), 1))))
            np.save(folder / "intrinsics.npy", np.array([615.0, 615.0, 320.0, 240.0]))
            found.append(folder)
        return found

    def registered(self, tmp_path, folders, *options, code=0):
        return invoke(
            "data", "calibrate", "--method", "checkerboard", *folders, "--out", tmp_path / "c.json", *options, code=code
        )

    def test_corners_are_held_out_in_strips(self, tmp_path, rng):
        done = self.registered(tmp_path, self.folders(tmp_path, rng))
        for entry in done.result["cameras"].values():
            assert entry["held_out_corners"] == 25
            assert entry["rms_mm"] < entry["held_out_mm"] < 3
        assert done.result["warnings"] == done.result["objections"] == []

    def test_serials_and_size_are_those_of_the_rig(self, tmp_path, rng):
        """A camera of the rig that has no folder is none of this calibration."""
        folders, written = self.folders(tmp_path, rng), tmp_path / "c.json"
        first, second = CAMERAS
        rig = write_rig(tmp_path, cameras={first: "11", second: "22", "top": "33"}, image_size=[848, 480])
        self.registered(tmp_path, folders, "--rig", rig)
        assert set(read_calibration(written).cameras) == {"11", "22"}
        assert read_calibration(written).camera("22").intrinsics.width == 848

    def test_options_of_the_other_method_are_refused(self, tmp_path, rng):
        said = self.registered(tmp_path, self.folders(tmp_path, rng), "--picture", "p.png", code=1).errors
        assert "--picture belongs to --method charuco, and this is --method checkerboard. Leave it out" in said

    def test_a_held_out_error_above_ten_millimetres_is_refused_unless_forced(self, tmp_path, rng):
        folders = self.folders(tmp_path, rng, noise_m=0.05)
        bad = self.registered(tmp_path, folders, code=1)
        assert "The error on held-out corners is" in bad.errors
        assert "mm (camera side); at most 10 mm are allowed" in bad.errors
        assert not (tmp_path / "c.json").exists()
        assert self.registered(tmp_path, folders, "--force").result["forced"] is True
        assert json.loads((tmp_path / "c.json").read_text())["forced"] is True

    def test_too_few_corners_to_hold_any_out(self, tmp_path, rng):
        bad = self.registered(tmp_path, self.folders(tmp_path, rng, corners=[0, 4, 20, 24, 12]), code=1)
        assert "Camera side has 5 corners, too few to hold any out" in bad.errors

    def test_all_cameras_alike_is_the_board(self, tmp_path, rng):
        folders = self.folders(tmp_path, rng, seen=dict.fromkeys(CAMERAS, 1.03), noise_m=0.0)
        done = self.registered(tmp_path, folders)
        assert "the board's squares, as all cameras see them alike" in done.errors
        assert all("3.0 % too large" in text for text in done.result["warnings"])

    def test_one_camera_is_that_camera(self, tmp_path, rng):
        done = self.registered(tmp_path, self.folders(tmp_path, rng, seen={"side": 0.97}, noise_m=0.0))
        (message,) = done.result["warnings"]
        assert "Camera side sees the board 3.0 % too small" in message
        assert "Suspected are its depth scale, its focal length." in message

    def test_a_size_that_moves_clouds_by_a_centimetre_is_refused(self, tmp_path, rng):
        """36 mm for 40 mm."""
        bad = self.registered(tmp_path, self.folders(tmp_path, rng, seen=dict.fromkeys(CAMERAS, 0.9), noise_m=0.0), code=1)
        assert (
            "the board's squares, as all cameras see them alike: 49.5 mm where the robot's corners are 55.0" in bad.errors
        )
