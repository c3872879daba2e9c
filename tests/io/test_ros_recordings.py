"""ROS recordings with the habits of other laboratories: imported right, or refused or warned about by name."""

from __future__ import annotations

import shutil
import struct
from contextlib import suppress
from importlib.resources import files
from types import SimpleNamespace

import numpy as np
import pytest

from diffcloud.errors import EpisodeError
from diffcloud.io.raw_episodes import read_raw_episode
from diffcloud.io.ros.files import opened
from diffcloud.io.ros.messages import color_image
from diffcloud.io.rvl import decode_rvl
from diffcloud.sensing.robot import gen3
from tests.cli.invoke import invoke
from tests.io.ros_bag import FRAMES, START, Bag, Habits, bag, rvl
from tests.sensing.table_scene import HOME_RAD, INTRINSICS, poses, table_depth

KINDS = pytest.mark.parametrize("kind", ["rosbag1", "rosbag2"])


def imported(tmp_path, *sources, options=(), code=0):
    return invoke("data", "import", *sources, "--out", tmp_path / "e", *options, code=code)


def depth_m(tmp_path, name, index):
    camera = read_raw_episode(tmp_path / "e").cameras[name]
    return camera.depth(index) * camera.info.depth_scale_m


def has_color(tmp_path, name):
    camera = read_raw_episode(tmp_path / "e").cameras[name]
    return [camera.color(index) is not None for index in range(len(camera.frames))]


class TestCompressedDepth:
    @KINDS
    def test_floats_are_stored_as_inverse_depth(self, tmp_path, kind):
        path = bag(tmp_path, kind, encoding="32FC1; compressedDepth png", unaligned=False)
        imported(tmp_path, path)
        for name, pose in poses().items():
            found, true = depth_m(tmp_path, name, 2), table_depth(pose) / 1000
            # one step of the quantisation, and half a step of the episode's unit
            np.testing.assert_allclose(found.ravel()[1:], true.ravel()[1:], atol=true.max() ** 2 / 10100 + 1.3e-4)

    def test_beyond_the_range_is_no_measurement(self, tmp_path, monkeypatch):
        far = table_depth(poses()["side"])
        far[:40] = 12_000  # the transport's range ends at ten metres
        monkeypatch.setattr("tests.io.ros_bag.table_depth", lambda pose: far.copy())
        imported(tmp_path, bag(tmp_path, "rosbag2", encoding="32FC1; compressedDepth png", unaligned=False))
        found = depth_m(tmp_path, "side", 1)
        assert (found[1:40] == 0).all()
        np.testing.assert_allclose(found[40:], far[40:] / 1000, atol=2e-3)

    @pytest.mark.parametrize(
        "stated", ["16UC1; compressedDepth png", "16UC1; compressedDepth", "16UC1; compressedDepth rvl"]
    )
    def test_integers_are_millimetres(self, tmp_path, stated):
        imported(tmp_path, bag(tmp_path, "rosbag2", encoding=stated, unaligned=False))
        expected = table_depth(poses()["side"])
        expected[0, 0] = 1002
        np.testing.assert_allclose(depth_m(tmp_path, "side", 2), expected / 1000)

    @pytest.mark.parametrize(
        ("stated", "message"),
        [
            ("32FC1; compressedDepth zstd", "compressed by 'zstd'"),
            ("; compressedDepth", "must state its encoding"),
            ("32FC1; png compressed", "loses floats"),
        ],
    )
    def test_what_is_not_read_is_refused_by_name(self, tmp_path, stated, message):
        path = bag(tmp_path, "rosbag2", encoding=stated, unaligned=False)
        assert message in imported(tmp_path, path, code=1).errors
        assert not (tmp_path / "e").exists()


class TestDamage:
    def test_that_is_met_while_reading_is_named(self, tmp_path):
        path = bag(tmp_path, "rosbag1")
        with (
            pytest.raises(EpisodeError, match=rf"{path.name} cannot be read to its end \(ValueError: broken\)"),
            opened([path]),
        ):
            raise ValueError("broken")
        with pytest.raises(EpisodeError, match=r"^an error of its own$"), opened([path]):
            raise EpisodeError("an error of its own")

    def test_rows_that_are_too_short_for_their_colours(self):
        message = SimpleNamespace(encoding="rgb8", is_bigendian=0, width=4, height=2, step=4, data=bytes(8))
        with pytest.raises(EpisodeError, match="An image of 4 x 2 has 8 bytes; the recording is damaged"):
            color_image(message, "/camera")


class TestRvl:
    @pytest.mark.parametrize("share", [0.0, 0.3, 0.95, 1.0])
    def test_what_was_coded_comes_back(self, rng, share):
        depth = rng.integers(1, 65536, (31, 47)).astype(np.uint16)
        depth[rng.random(depth.shape) < share] = 0
        np.testing.assert_array_equal(decode_rvl(rvl(depth), "a"), depth)

    def test_damage_is_named(self, rng):
        good = rvl(rng.integers(0, 3000, (20, 30)).astype(np.uint16))
        huge, negative = struct.pack("<ii", 10**6, 10**6), struct.pack("<ii", -1, 5)
        for data in (b"", good[:8], good[:40], good[:-8], huge + good[8:], negative + good[8:]):
            with pytest.raises(EpisodeError, match=r"RVL image of a .*damaged"):
                decode_rvl(data, "a")

    def test_any_flipped_bytes_give_an_image_or_a_clear_error(self, rng):
        good = rvl(rng.integers(0, 3000, (20, 30)).astype(np.uint16))
        for _ in range(300):
            data = bytearray(good)
            data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
            with suppress(EpisodeError):
                assert decode_rvl(bytes(data), "a").dtype == np.uint16


class TestNames:
    @pytest.mark.parametrize(
        ("folder", "depth"),
        [
            ("/cameras/{name}", "aligned_depth_to_color/image_raw"),
            ("/lab/left/{name}", "aligned_depth_to_color/image_raw"),
            ("/{name}/camera", "aligned_depth_to_color/image_raw"),
            ("/lab/{name}/camera", "depth_registered/image"),
        ],
    )
    def test_cameras_that_share_a_namespace_stay_apart(self, tmp_path, folder, depth):
        done = imported(tmp_path, bag(tmp_path, "rosbag2", folder=folder, depth=depth))
        assert done.result["frames"] == {"overhead": FRAMES, "side": FRAMES}
        assert done.result["warnings"] == []
        for name, pose in poses().items():
            np.testing.assert_allclose(depth_m(tmp_path, name, 1).ravel()[1:], table_depth(pose).ravel()[1:] / 1000)
            camera = read_raw_episode(tmp_path / "e").cameras[name]
            np.testing.assert_allclose(camera.info.T_world_camera, pose, atol=1e-9)
            assert has_color(tmp_path, name) == [True] * FRAMES

    def test_cameras_that_are_named_beside_the_word_depth(self, tmp_path):
        """/lab/overhead_depth/image and /lab/side_depth/image."""
        done = imported(tmp_path, bag(tmp_path, "rosbag2", folder="/lab/{name}_depth", depth="image", unaligned=False))
        assert done.result["frames"] == {"overhead": FRAMES, "side": FRAMES}

    def test_intrinsics_that_two_cameras_would_share_are_refused(self, tmp_path):
        class OneInfo(Bag):
            def _info(self, topic, *rest):
                super()._info("/lab/camera_info", *rest)

        habits = Habits(folder="/lab/{name}", depth="depth/image", unaligned=False)
        OneInfo(tmp_path / "bag", "rosbag2", habits).write()
        bad = imported(tmp_path, tmp_path / "bag", code=1)
        assert "one camera_info, /lab/camera_info, for two cameras" in bad.errors


UNALIGNED = {"depth": "depth/image_rect_raw", "unaligned": False}


class TestColor:
    @pytest.mark.parametrize(
        ("habits", "reason"),
        [
            ({"depth_frame": "{name}_depth_optical"}, "is seen from the tf frame 'side_optical', depth from"),
            ({"color_info": 1.6 * INTRINSICS.fx}, "has f 246.4, c (79.5, 59.5), depth f 154.0"),
            ({}, "has no camera_info"),
        ],
    )
    def test_unaligned_colour_is_left_out(self, tmp_path, habits, reason):
        done = imported(tmp_path, bag(tmp_path, "rosbag2", **UNALIGNED, **habits))
        assert has_color(tmp_path, "side") == [False] * FRAMES
        (message,) = [text for text in done.result["warnings"] if "Camera side: colour is left out" in text]
        assert reason in message
        assert "align_depth.enable:=true" in message
        assert message in done.errors

    def test_one_optical_frame_and_equal_intrinsics_are_aligned(self, tmp_path):
        done = imported(tmp_path, bag(tmp_path, "rosbag1", **UNALIGNED, color_info=INTRINSICS.fx))
        assert has_color(tmp_path, "side") == [True] * FRAMES
        assert done.result["warnings"] == []

    def test_the_tolerance_follows_the_frame_rate(self, tmp_path):
        """At 10 Hz colour may come 30 ms after depth: no nearer image exists. The 20 ms of before dropped it."""
        done = imported(tmp_path, bag(tmp_path, "rosbag2", color_late_s=lambda number: 0.03))
        assert has_color(tmp_path, "side") == [True] * FRAMES
        assert done.result["warnings"] == []

    def test_lost_colour_is_counted(self, tmp_path):
        late = bag(tmp_path, "rosbag2", color_late_s=lambda number: 0.001 if number < 3 else 5.0)
        done = imported(tmp_path, late)
        assert has_color(tmp_path, "side") == [True] * 3 + [False] * 2
        (message,) = [text for text in done.result["warnings"] if text.startswith("Camera side")]
        assert "2 of 5 frames have no colour" in message
        assert "149 ms away (median), and 50 ms are allowed" in message

    def test_a_frame_gets_the_nearest_image_even_if_it_arrives_frames_later(self, tmp_path):
        """The image of 0.0 s arrives with the depth of 0.2 s."""
        stamps = {0: 0.101, 1: 0.201, 2: 0.001, 3: 0.301, 4: 0.401}
        imported(tmp_path, bag(tmp_path, "rosbag2", color_late_s=lambda number: stamps[number] - number / 10))
        camera = read_raw_episode(tmp_path / "e").cameras["side"]
        assert [int(camera.color(index)[0, 0, 0]) for index in range(FRAMES)] == [32, 30, 31, 33, 34]


class TestSplitRecordings:
    HALVES = (range(7), range(7, 2 * FRAMES + 4))

    def numbered(self, tmp_path, kind, names, halves=HALVES):
        """Files of one folder without metadata.yaml."""
        for name, steps in zip(names, halves, strict=True):
            if kind == "rosbag1":
                Bag(tmp_path / f"{name}.bag", kind, Habits(), steps).write()
            else:
                Bag(tmp_path / "made", kind, Habits(), steps).write()
                (source,) = [path for path in (tmp_path / "made").iterdir() if path.name != "metadata.yaml"]
                shutil.move(source, tmp_path / f"{name}{source.suffix}")
                shutil.rmtree(tmp_path / "made")
        return sorted(path for path in tmp_path.iterdir() if path.suffix in (".bag", ".db3", ".mcap"))

    @pytest.mark.parametrize(
        ("kind", "names"),
        [
            ("rosbag1", ("lift_0", "lift_1")),
            ("rosbag1", ("lab_2024-03-01-10-00-00_0", "lab_2024-03-01-10-05-00_1")),
            ("rosbag2", ("lift_0", "lift_1")),
            ("mcap", ("lift_0", "lift_1")),
        ],
    )
    def test_one_part_is_refused_and_all_are_one_recording(self, tmp_path, kind, names):
        parts = self.numbered(tmp_path, kind, names)
        for part in parts:
            bad = imported(tmp_path, part, code=1)
            assert "one of the 2 parts of a split recording" in bad.errors
            assert all(other.name in bad.errors for other in parts)
        done = imported(tmp_path, *parts)
        assert done.result["frames"] == {"overhead": FRAMES, "side": FRAMES}

    def test_takes_that_are_numbered_are_no_parts(self, tmp_path):
        """Two recordings half a minute apart."""
        takes = self.numbered(tmp_path, "rosbag1", ("lift_0", "lift_1"), (range(7), range(601, 608)))
        assert imported(tmp_path, takes[0]).result["frames"] == {"overhead": 3, "side": 3}

    def test_a_part_that_metadata_lists(self, tmp_path):
        parts = self.numbered(tmp_path, "rosbag2", ("run_0", "run_1"))
        Bag(tmp_path / "run", "rosbag2", Habits()).write()
        (whole,) = (tmp_path / "run").glob("*.db3")
        whole.unlink()
        for part in parts:
            shutil.move(part, tmp_path / "run" / part.name)
        listed = (tmp_path / "run" / "metadata.yaml").read_text()
        listed = listed.replace(f"- {whole.name}", "- run_0.db3\n  - run_1.db3")
        (tmp_path / "run" / "metadata.yaml").write_text(listed)
        bad = imported(tmp_path, tmp_path / "run" / "run_1.db3", code=1)
        assert f"give the folder {tmp_path / 'run'} to import all of it" in bad.errors
        assert imported(tmp_path, tmp_path / "run").result["frames"] == {"overhead": FRAMES, "side": FRAMES}

    def test_a_part_that_cannot_be_read_is_named(self, tmp_path):
        parts = self.numbered(tmp_path, "rosbag2", ("lift_0", "lift_1"))
        parts[1].write_bytes(b"SQLite format 3\x00 torn")
        done = imported(tmp_path, parts[0])
        assert any("lift_1.db3 cannot be read" in message for message in done.result["warnings"])


class TestTransforms:
    @KINDS
    def test_cameras_beside_the_base_in_a_common_frame(self, tmp_path, kind):
        done = imported(tmp_path, bag(tmp_path, kind, root="world"))
        episode = read_raw_episode(tmp_path / "e")
        for name, pose in poses().items():
            np.testing.assert_allclose(episode.cameras[name].info.T_world_camera, pose, atol=1e-9)
        assert done.result["warnings"] == []

    def test_what_tf_does_not_connect_is_said(self, tmp_path):
        options = ("--world-frame", "map", "--tool-frame", "flange")
        done = imported(tmp_path, bag(tmp_path, "rosbag2"), options=options)
        texts = " ".join(done.result["warnings"])
        assert "Camera side: its place stays open, as tf does not connect 'side_optical' with 'map'" in texts
        assert "its frames are base_link, overhead_link" in texts
        assert "The tool's pose stays unknown: tf does not connect 'flange' with 'map'" in texts

    def test_a_camera_that_moves_has_no_place(self, tmp_path):
        """It is mounted on the tool, which rises by 10 cm a second."""
        done = imported(tmp_path, bag(tmp_path, "rosbag2", mount="tool_frame"))
        assert read_raw_episode(tmp_path / "e").cameras["side"].info.T_world_camera is None
        assert any("'side_optical' moves relative to 'base_link', by 65 mm" in text for text in done.result["warnings"])

    def test_a_frame_with_two_parents_is_not_believed(self, tmp_path):
        class Twice(Bag):
            def _header(self, t, frame):
                return super()._header(t, "elsewhere" if frame == "base_link" and t > self.later else frame)

            later = 1_700_000_000.3

        Twice(tmp_path / "bag", "rosbag2", Habits()).write()
        done = imported(tmp_path, tmp_path / "bag")
        assert read_raw_episode(tmp_path / "e").cameras["side"].info.T_world_camera is None
        assert any(
            "gives the frame 'side_link' two parents, 'base_link' and 'elsewhere'" in text
            for text in done.result["warnings"]
        )

    def test_what_is_no_place_is_left_out(self, tmp_path):
        """A zero quaternion, of a frame that nobody asks for and once of a camera's."""

        class Empty(Bag):
            def _type(self, name):
                made = super()._type(name)
                return made if name != "geometry_msgs/msg/Quaternion" else self._first_is_zero(made)

            def _first_is_zero(self, made):
                self.seen = getattr(self, "seen", 0) + 1
                return made if self.seen > 1 else lambda **_: made(x=0.0, y=0.0, z=0.0, w=0.0)

        Empty(tmp_path / "bag", "rosbag2", Habits()).write()
        done = imported(tmp_path, tmp_path / "bag")
        assert any(
            text.startswith("1 of 14 transforms of 'overhead_link' in tf are invalid") for text in done.result["warnings"]
        )
        for name, pose in poses().items():
            np.testing.assert_allclose(read_raw_episode(tmp_path / "e").cameras[name].info.T_world_camera, pose, atol=1e-9)


class TestLenses:
    LENS = (0.1, -0.2, 0.001, 0.002, 0.05)

    def intrinsics(self, tmp_path, **habits):
        imported(tmp_path, bag(tmp_path, "rosbag2", lens=self.LENS, rectified_focal=58.0, unaligned=False, **habits))
        return read_raw_episode(tmp_path / "e").cameras["side"].info.intrinsics

    def test_images_as_they_are_have_K_and_D(self, tmp_path):
        held = self.intrinsics(tmp_path)
        assert (held.fx, held.coefficients) == (INTRINSICS.fx, self.LENS)

    @pytest.mark.parametrize(
        "topic", ["depth_registered/image_rect", "depth/image_rect_raw", "depth/rectified/image", "depth_rect/image"]
    )
    def test_rectified_images_have_P_alone(self, tmp_path, topic):
        held = self.intrinsics(tmp_path, depth=topic)
        assert (held.fx, held.distortion, held.coefficients) == (58.0, "none", ())

    RATIONAL = (0.5, -2.6, 5e-4, -3e-4, 1.5, 0.38, -2.4, 1.4)

    @pytest.mark.parametrize(
        ("model", "lens", "distortion", "kept"),
        [
            ("plumb_bob", RATIONAL, "brown_conrady", RATIONAL),
            ("rational_polynomial", RATIONAL, "brown_conrady", RATIONAL),
            ("rational_polynomial", (*LENS, 0.0, 0.0, 0.0), "brown_conrady", LENS),
            ("plumb_bob", LENS[:4], "brown_conrady", (*LENS[:4], 0.0)),
            ("rational_polynomial", (*RATIONAL, 0.1, 0.0, 0.0, 0.0), "brown_conrady", (*RATIONAL, 0.1, 0.0, 0.0, 0.0)),
            ("rational_polynomial", (*RATIONAL, *[0.0] * 5, 0.01), "brown_conrady", (*RATIONAL, *[0.0] * 5, 0.01)),
            ("rational_polynomial", (0.0,) * 8, "none", ()),
            ("equidistant", (0.1, 0.2, 0.0, 0.0), "equidistant", (0.1, 0.2, 0.0, 0.0)),
            ("fisheye", (0.1,), "equidistant", (0.1, 0.0, 0.0, 0.0)),
        ],
    )
    def test_no_coefficient_is_lost(self, tmp_path, model, lens, distortion, kept):
        imported(tmp_path, bag(tmp_path, "rosbag2", lens=lens, lens_model=model, unaligned=False))
        held = read_raw_episode(tmp_path / "e").cameras["side"].info.intrinsics
        assert (held.distortion, held.coefficients) == (distortion, kept)

    @pytest.mark.parametrize(
        ("habits", "message"),
        [
            ({"lens": (0.1,) * 15}, "has 5, 8, 12, 14 coefficients, got 15"),
            ({"lens": (0.1,) * 5, "lens_model": "equidistant"}, "has 4 coefficients, got 5"),
            ({"lens": (0.1,) * 5, "lens_model": "kannala"}, "'kannala'; allowed are plumb_bob, rational_polynomial"),
            ({"calibrated": False}, "has only zeros in K: this camera was never calibrated"),
        ],
    )
    def test_what_is_no_lens_is_refused_with_its_topic(self, tmp_path, habits, message):
        said = imported(tmp_path, bag(tmp_path, "rosbag2", unaligned=False, **habits), code=1).errors
        assert message in said
        assert "Camera overhead: its camera_info on /overhead/aligned_depth_to_color/camera_info" in said
        assert not (tmp_path / "e").exists()

    def test_without_P_they_have_K(self, tmp_path):
        path = bag(tmp_path, "rosbag2", lens=self.LENS, depth="depth_registered/image_rect", unaligned=False)
        imported(tmp_path, path)
        held = read_raw_episode(tmp_path / "e").cameras["side"].info.intrinsics
        assert (held.fx, held.distortion) == (INTRINSICS.fx, "none")


class TestLinksInTf:
    """Of a recording without joint_states."""

    @KINDS
    def test_joints_and_gripper_are_read_from_them(self, tmp_path, kind):
        done = imported(tmp_path, bag(tmp_path, kind, arm=False, links=True))
        assert done.result["warnings"] == []
        log = read_raw_episode(tmp_path / "e").robot
        assert len(log.times) == 2 * FRAMES + 4
        expected = np.tile(HOME_RAD, (len(log.times), 1))
        expected[:, 2] += 0.5 * (log.times - START)
        turns = (log.joints_rad - expected) / (2 * np.pi)
        np.testing.assert_allclose(turns, turns.round(), atol=1e-6)
        np.testing.assert_allclose(log.gripper, 0.5, atol=1e-6)
        told = gen3().tool_pose(log.joints_rad)
        np.testing.assert_allclose(log.tool_position_m, told[:, :3, 3], atol=1e-6)

    def test_of_another_robot_there_is_no_log(self, tmp_path):
        other = files("diffcloud.hardware.examples") / "ur5e.urdf"
        path = bag(tmp_path, "rosbag2", arm=False, links=True)
        texts = " ".join(imported(tmp_path, path, options=("--urdf", other)).result["warnings"])
        assert "There are no joint_states, and tf does not give the joints either: in tf 'shoulder_link' lies" in texts
        assert read_raw_episode(tmp_path / "e").robot is None

    def test_links_that_lie_elsewhere_are_not_believed(self, tmp_path):
        bent = (files("diffcloud.sensing") / "gen3_robotiq_2f_85.urdf").read_text()
        (tmp_path / "bent.urdf").write_text(bent.replace('xyz="0 0 0.15643"', 'xyz="0 0 0.25643"'))
        path = bag(tmp_path, "rosbag2", arm=False, links=True)
        texts = " ".join(imported(tmp_path, path, options=("--urdf", tmp_path / "bent.urdf")).result["warnings"])
        assert "100 mm and 0.0 degrees away from where joint_1 of the robot's description can put it relative to" in texts


class TestGripper:
    def gripper(self, tmp_path):
        return read_raw_episode(tmp_path / "e").robot.gripper

    def test_another_name_is_refused_with_those_there_are(self, tmp_path):
        path = bag(tmp_path, "rosbag2", joints={"robotiq_85_left_knuckle_joint": 0.4})
        bad = imported(tmp_path, path, code=1)
        assert "no 'finger_joint'" in bad.errors
        assert "besides the arm's joints there are robotiq_85_left_knuckle_joint" in bad.errors
        assert "--gripper-joint" in bad.errors
        done = imported(tmp_path, path, options=("--gripper-joint", "robotiq_85_left_knuckle_joint"))
        np.testing.assert_allclose(self.gripper(tmp_path), 0.5)
        assert (
            "taken to be open where robotiq_85_left_knuckle_joint is 0 and closed where it is 0.8"
            in done.result["warnings"][0]
        )

    def test_where_it_is_closed_may_be_given(self, tmp_path):
        path = bag(tmp_path, "rosbag2", joints={"claw": 0.03})
        done = imported(tmp_path, path, options=("--gripper-joint", "claw,0,0.04"))
        np.testing.assert_allclose(self.gripper(tmp_path), 0.75)
        assert done.result["warnings"] == []

    def test_one_that_is_closed_at_zero(self, tmp_path):
        path = bag(tmp_path, "rosbag2", joints={"finger": 0.03})
        imported(tmp_path, path, options=("--gripper-joint", "finger,0.04,0"))
        np.testing.assert_allclose(self.gripper(tmp_path), 0.25)

    @pytest.mark.parametrize(("open_", "closed"), [(0, 0), (0.8, 0.8), (0, "nan"), ("inf", 0)])
    def test_positions_that_tell_nothing_are_refused(self, tmp_path, open_, closed):
        path = bag(tmp_path, "rosbag2")
        done = imported(tmp_path, path, options=("--gripper-joint", f"finger_joint,{open_},{closed}"), code=1)
        assert "two different positions" in done.errors
        assert not (tmp_path / "e").exists()

    def test_a_name_that_was_given_must_be_there(self, tmp_path):
        bad = imported(tmp_path, bag(tmp_path, "rosbag2", joints={}), options=("--gripper-joint", "claw"), code=1)
        assert "no 'claw'" in bad.errors

    def test_an_arm_without_gripper(self, tmp_path):
        path = bag(tmp_path, "rosbag2", joints={})
        assert any("only the arm's joints" in text for text in imported(tmp_path, path).result["warnings"])
        shutil.rmtree(tmp_path / "e")
        assert imported(tmp_path, path, options=("--gripper-joint", "none")).result["warnings"] == []
        assert np.isnan(self.gripper(tmp_path)).all()

    @KINDS
    def test_messages_of_its_own_are_met(self, tmp_path, kind):
        """Its driver sends joint_states beside those of the arm's, a hundredth of a second later."""
        imported(tmp_path, bag(tmp_path, kind, joints={}, own_joints={"finger_joint": 0.4}))
        assert len(self.gripper(tmp_path)) == 2 * FRAMES + 4
        np.testing.assert_allclose(self.gripper(tmp_path), 0.5)


class TestOrder:
    @KINDS
    def test_images_that_arrive_out_of_order_are_sorted(self, tmp_path, kind):
        stamps = [0.0, 0.2, 0.1, 0.3, 0.4]
        done = imported(tmp_path, bag(tmp_path, kind, stamps_s=lambda number: stamps[number]))
        camera = read_raw_episode(tmp_path / "e").cameras["side"]
        np.testing.assert_allclose(camera.times, np.arange(FRAMES) / 10, atol=1e-6)
        assert [int(camera.depth(index)[0, 0]) for index in range(FRAMES)] == [1000, 1002, 1001, 1003, 1004]
        assert [int(camera.color(index)[0, 0, 0]) for index in range(FRAMES)] == [30, 32, 31, 33, 34]
        assert any("Camera side: 1 of 5 depth images arrived out of order" in text for text in done.result["warnings"])

    def test_a_clock_that_was_set_back_is_refused_with_the_place(self, tmp_path):
        stamps = [10.0, 10.1, 10.2, 0.3, 0.4]
        bad = imported(tmp_path, bag(tmp_path, "rosbag2", stamps_s=lambda number: stamps[number]), code=1)
        assert "/overhead/aligned_depth_to_color/image_raw: message 4 is stamped 9.90 s before" in bad.errors
        assert not (tmp_path / "e").exists()

    def test_joints_of_a_clock_that_was_set_back_are_refused(self, tmp_path):
        class SetBack(Bag):
            def _header(self, t, frame):
                return super()._header(t - 3 if frame == "" and t > 1_700_000_000.3 else t, frame)

        SetBack(tmp_path / "bag", "rosbag2", Habits()).write()
        bad = imported(tmp_path, tmp_path / "bag", code=1)
        assert "message 9 of joint_states with joint_1 is stamped 2.95 s before" in bad.errors

    def test_of_two_images_with_one_stamp_the_first_is_taken(self, tmp_path):
        stamps = [0.0, 0.1, 0.1, 0.3, 0.4]
        done = imported(tmp_path, bag(tmp_path, "rosbag2", stamps_s=lambda number: stamps[number]))
        camera = read_raw_episode(tmp_path / "e").cameras["side"]
        assert [int(camera.depth(index)[0, 0]) for index in range(4)] == [1000, 1001, 1003, 1004]
        assert any("1 of 5 depth images have the stamp of another" in text for text in done.result["warnings"])
