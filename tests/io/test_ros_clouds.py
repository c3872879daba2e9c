"""ROS recordings of point clouds: every layout gives the same cloud, and what cannot be is refused by name."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from types import MappingProxyType, SimpleNamespace

import numpy as np
import pytest

from diffcloud.errors import EpisodeError
from diffcloud.io.episodes import read_episode
from diffcloud.io.ros.messages import MOST_POINTS, cloud_points
from diffcloud.sensing.robot import gen3
from tests.cli.invoke import invoke
from tests.io.ros_bag import ARM, START, Bag
from tests.io.ros_clouds import BASE_CAMERA, FRAMES, OPTICAL, PLAIN, CloudBag, Layout, cloud, tool_at
from tests.sensing.table_scene import HOME_RAD

XYZ = PLAIN.fields
LAYOUTS = {
    "packed": PLAIN,
    "pcl": Layout((*XYZ, ("rgb", 16, 7)), step=32),
    "doubles": Layout((("x", 0, 8), ("y", 8, 8), ("z", 16, 8)), step=24),
    "big endian": Layout(big=True),
    "organised": Layout(rows=5, padding=20, holes=(np.nan,), dense=False),
    "between": Layout((("ring", 0, 4), ("x", 2, 7), ("y", 6, 7), ("z", 10, 7), ("t", 15, 8), ("tag", 23, 2)), step=25),
    "mixed": Layout((("z", 0, 7), ("x", 4, 8), ("y", 12, 7)), step=20, big=True, rows=3, padding=3),
    "not finite": Layout(holes=(np.nan, np.inf, -np.inf), dense=True),
}


def by_tf(bag, t, position, frame="tool_frame"):
    pose = np.eye(4)
    pose[:3, 3] = position
    bag.transform("/tf", t, "base_link", frame, pose)


def by_pose(bag, t, position):
    bag.pose_stamped("/tool_pose", t, position)


def by_odometry(bag, t, position):
    bag.odometry("/tool_odom", t, position)


def by_transform(bag, t, position):
    pose = np.eye(4)
    pose[:3, 3] = position - [1.0, 0, 0]
    message = bag.stamped(t, "mocap", "marker", pose)
    fields = {"child_frame_id": message.child_frame_id, "transform": message.transform}
    bag._send("/mocap/tool", t, "geometry_msgs/msg/TransformStamped", frame="mocap", **fields)


def mocap(bag):
    pose = np.eye(4)
    pose[0, 3] = 1.0
    bag.transform("/tf_static", START, "base_link", "mocap", pose)


def recording(tmp_path, kind="rosbag2", *, clouds=None, empty=(), **habits):
    path = tmp_path / ("bag.bag" if kind == "rosbag1" else "bag")
    CloudBag(path, kind, clouds=clouds, empty=empty).write(**{"tool": by_tf, **habits})
    return path


def imported(tmp_path, *options, code=0):
    (tmp_path / "e.npz").unlink(missing_ok=True)
    source = next(path for path in (tmp_path / "bag.bag", tmp_path / "bag") if path.exists())
    done = invoke("data", "import", source, *options, "--out", tmp_path / "e.npz", code=code)
    if code:
        assert not (tmp_path / "e.npz").exists()
        return done.errors
    return read_episode(tmp_path / "e.npz"), done.result["warnings"]


def refused(tmp_path, *options):
    return imported(tmp_path, *options, code=1)


def check_track(episode, frames=range(FRAMES)):
    expected = [tool_at(number / 10) for number in frames]
    np.testing.assert_allclose(episode.gripper[:, 0], expected, atol=1e-9)
    np.testing.assert_allclose(episode.times, np.arange(len(frames)) / 10, atol=1e-6)


class TestLayouts:
    @pytest.mark.parametrize("kind", ["rosbag1", "rosbag2", "mcap"])
    def test_all_give_the_same_cloud(self, tmp_path, kind):
        for name, layout in LAYOUTS.items():
            folder = tmp_path / name
            folder.mkdir()
            recording(folder, kind, clouds={"/cloth/points": ("left_optical_frame", layout, 0.0)})
            episode, warnings = imported(folder)
            assert warnings == [], name
            for number in range(FRAMES):
                np.testing.assert_allclose(episode.frame(number), cloud(number), atol=1e-6, rtol=0, err_msg=name)
            check_track(episode)
            np.testing.assert_allclose(episode.viewpoints["cloth"], OPTICAL[:3, 3])

    @pytest.mark.parametrize(
        ("layout", "message"),
        [
            (replace(PLAIN, cut=5), "is damaged: 1 rows of 5700 bytes, 475 points of 12 bytes per row"),
            (replace(PLAIN, change={"point_step": 10}), "coordinates up to byte 12 of a point"),
            (replace(PLAIN, change={"row_step": 24}), "is damaged: 1 rows of 24 bytes"),
            (replace(PLAIN, change={"width": 2**32 - 1, "height": 2**32 - 1}), "A recording may have 100,000,000"),
            (Layout((("x", 0, 7), ("y", 4, 7), ("depth", 8, 7))), "have the fields x, y, depth. A cloud needs"),
            (
                Layout((("x", 0, 7), ("y", 4, 7), ("z", 8, 42))),
                "The field z of the clouds on /cloth/points is of the unknown",
            ),
            (Layout((("x", 0, 3), ("y", 2, 3), ("z", 4, 3)), step=6), "is int16, 1 per point. Coordinates are one float32"),
            (Layout((("x", 0, 7), ("y", 4, 7), ("z", 2**32 - 4, 7))), "coordinates up to byte 4294967296 of a point"),
        ],
    )
    def test_damage_is_named(self, tmp_path, layout, message):
        recording(tmp_path, clouds={"/cloth/points": ("left_optical_frame", layout, 0.0)})
        assert message in refused(tmp_path)

    def test_any_changed_sizes_give_a_cloud_or_a_clear_error(self, rng):
        names = ("height", "width", "point_step", "row_step")
        for _ in range(300):
            told = PLAIN.message(cloud(0)) | {name: int(rng.integers(0, 40)) for name in rng.choice(names, 2)}
            told["data"] = told["data"][: rng.integers(0, 200)]
            fields = [SimpleNamespace(name=one, offset=at, datatype=7, count=1) for one, at, _ in XYZ]
            with suppress(EpisodeError):
                assert cloud_points(SimpleNamespace(fields=fields, **told), "/a").shape[1] == 3

    def test_an_empty_message_is_an_empty_cloud(self):
        sizes = dict.fromkeys(("height", "width", "point_step", "row_step"), 0)
        assert cloud_points(SimpleNamespace(fields=[], data=np.zeros(0), **sizes), "/a").shape == (0, 3)

    def test_too_many_points_are_refused(self, tmp_path, monkeypatch):
        monkeypatch.setattr("diffcloud.io.ros.recording.MOST_POINTS", 1000)
        recording(tmp_path)
        assert "has more than 1,000 points in its clouds" in refused(tmp_path)
        assert MOST_POINTS * 12 < 2e9


class TestFrames:
    def test_missing_transforms_name_both_frames(self, tmp_path):
        recording(tmp_path, tf=False)
        said = refused(tmp_path)
        assert "tf does not connect 'left_optical_frame' with 'base_link'; its frames are base_link, tool_frame" in said
        assert "Record /tf and /tf_static too, or name the base by --world-frame" in said

    def test_without_base_link_the_common_root_is_the_base(self, tmp_path):
        """As where clouds and poses are stated in `world`, and there is no tf at all."""
        clouds = {"/points": ("world", PLAIN, 0.0)}
        posed = {"tf": False, "tool": lambda bag, t, place: bag.pose_stamped("/tool_pose", t, place, "/world")}
        recording(tmp_path, clouds=clouds, **posed)
        episode, warnings = imported(tmp_path)
        assert warnings == []
        check_track(episode)
        assert not episode.viewpoints
        recording(tmp_path / "other", clouds=clouds, tf=False, tool=by_pose)
        assert "/points: tf does not connect 'world' with 'base_link'" in refused(tmp_path / "other")

    def test_two_cameras_on_one_topic(self, tmp_path):
        def other(bag):
            bag.points("/cloth/points", "right_optical_frame", PLAIN, 0, START + 0.6)

        recording(tmp_path, also=other)
        said = refused(tmp_path)
        assert "has clouds of two cameras, in the frames 'left_optical_frame' and 'right_optical_frame'" in said

    def test_a_camera_that_moves(self, tmp_path):
        """Its pose is that at the time of each cloud; clouds without one are left out, and it has no fixed place."""

        def carried(bag, t, place):
            by_tf(bag, t, place)
            if t < START + 0.42:
                moved = OPTICAL.copy()
                moved[0, 3] += t - START
                bag.transform("/tf", t, "base_link", "hand_optical_frame", moved)

        recording(tmp_path, clouds={"/points": ("hand_optical_frame", PLAIN, 0.0)}, tool=carried)
        episode, warnings = imported(tmp_path)
        assert "1 of 6 clouds were left out: /points: tf moves 'hand_optical_frame' in 'base_link'" in warnings[0]
        assert episode.frame_count == 5
        assert not episode.viewpoints
        for number in range(5):  # the nearest transform is 20 ms away at most
            moved = np.add(cloud(number), [number / 10, 0, 0])
            np.testing.assert_allclose(episode.frame(number), moved, atol=0.0201)


class TestTwoCameras:
    CLOUDS = MappingProxyType(
        {
            "/left/points": ("left_optical_frame", PLAIN, 0.0),
            "/right/points": ("right_optical_frame", LAYOUTS["doubles"], 0.02),
        }
    )

    def test_are_never_guessed(self, tmp_path):
        recording(tmp_path, clouds=self.CLOUDS)
        said = refused(tmp_path)
        assert "has clouds on several topics: /left/points, /right/points. Name the one with the cloth by --topic" in said
        episode, _ = imported(tmp_path, "--topic", "/left/points")
        assert len(episode.frame(0)) == len(cloud(0))

    def test_that_are_named_make_one_cloud(self, tmp_path):
        """Clouds nearest in time belong together, and each point names its camera."""
        recording(tmp_path, clouds=self.CLOUDS, empty=(2,))
        episode, warnings = imported(tmp_path, "--topic", "/left/points", "--topic", "/right/points")
        assert [text[:53] for text in warnings] == ["1 of 6 clouds were left out: bag: no finite point on "] * 2
        assert episode.frame_count == FRAMES - 1
        count = len(cloud(0))
        for frame, number in enumerate((0, 1, 3, 4, 5)):
            np.testing.assert_allclose(episode.frame(frame), np.tile(cloud(number), (2, 1)), atol=1e-6)
        np.testing.assert_array_equal(episode.camera, np.tile(np.repeat([0, 1], count), FRAMES - 1))
        assert list(episode.clocks) == ["left", "right"]
        assert episode.clocks["right"].offset_s == pytest.approx(0.02, abs=1e-6)
        for name, pose in zip(("left", "right"), BASE_CAMERA.values(), strict=True):
            np.testing.assert_allclose(episode.viewpoints[name], pose[:3, 3])


class TestTool:
    @pytest.mark.parametrize("kind", ["rosbag1", "rosbag2"])
    @pytest.mark.parametrize("tool", [by_tf, by_pose, by_odometry, by_transform])
    def test_at_its_own_rate(self, tmp_path, kind, tool):
        recording(tmp_path, kind, tool=tool, also=mocap)
        episode, warnings = imported(tmp_path)
        assert warnings == []
        check_track(episode)

    def test_by_joint_states(self, tmp_path):
        def joints(bag, t, place):
            angles = np.array(HOME_RAD) + 0.1 * (t - START)
            bag._joints(t, dict(zip(ARM, angles, strict=True)))

        recording(tmp_path, tool=joints)
        episode, warnings = imported(tmp_path)
        assert "The tool's poses are computed from joint states" in warnings[0]
        place = gen3().tool_pose(np.array(HOME_RAD) + 0.1 * 0.1)[:3, 3]
        np.testing.assert_allclose(episode.gripper[1, 0], place, atol=1e-4)

    def test_candidates_are_listed(self, tmp_path):
        def both(bag, t, place):
            by_tf(bag, t, place + 1)
            by_pose(bag, t, place)
            by_odometry(bag, t, place + 2)

        recording(tmp_path, tool=both)
        said = refused(tmp_path)
        assert "candidates for the tool's pose: /tool_odom, /tool_pose, the frame 'tool_frame' in tf" in said
        assert "such as `--topic /tool_odom`, or `--topic /tf --topic /tf_static` for tf" in said
        check_track(imported(tmp_path, "--topic", "/tool_pose")[0])
        for options, off in ((("--topic", "/tf", "--topic", "/tf_static"), 1), (("--tool-frame", "tool_frame"), 1)):
            episode, _ = imported(tmp_path, *options)
            np.testing.assert_allclose(episode.gripper[2, 0], tool_at(0.2) + off)
        said = refused(tmp_path, "--topic", "/tool_pose", "--tool-frame", "tool_frame")
        assert "several candidates for the tool's pose: /tool_pose, the frame 'tool_frame' in tf" in said

    def test_that_is_unknown(self, tmp_path):
        recording(tmp_path, tool=None)
        episode, warnings = imported(tmp_path)
        assert episode.gripper is None
        assert "The tool's pose is unknown: there is no topic of poses, no frame 'tool_frame' in tf" in warnings[0]
        said = refused(tmp_path, "--tool-frame", "hand")
        assert "the frame 'hand' in tf: tf does not connect 'hand' with 'base_link'" in said

    def test_that_covers_a_part(self, tmp_path):
        recording(tmp_path, tool=lambda bag, t, place: by_pose(bag, t, place) if t > START + 0.13 else None)
        episode, warnings = imported(tmp_path)
        assert "2 of 6 clouds were left out: bag: the clouds are from 1700000000.00 to 1700000000.50 s" in warnings[0]
        check_track(episode, range(2, FRAMES))

    def test_on_another_clock(self, tmp_path):
        recording(tmp_path, tool=lambda bag, t, place: by_pose(bag, t - 1000, place))
        said = refused(tmp_path)
        assert "the tool's poses (/tool_pose) from 1699998999.90" in said
        assert "Record both at the same time, with one clock" in said

    def test_with_gaps_and_poses_that_are_not_finite(self, tmp_path):
        def gap(bag, t, place):
            if not 0.05 < t - START < 0.35:
                by_pose(bag, t, place)

        recording(tmp_path, tool=gap, also=lambda bag: by_pose(bag, START + 0.8, [np.nan] * 3))
        episode, warnings = imported(tmp_path)
        assert "/tool_pose: 1 of 13 poses are not finite, and left out" in warnings[0]
        assert "3 of 6 clouds lie in gaps of the tool's poses (/tool_pose), of up to 0.36 s" in warnings[1]
        assert episode.frame_count == FRAMES

    def test_two_on_one_topic(self, tmp_path):
        recording(tmp_path, tool=by_pose, also=lambda bag: bag.pose_stamped("/tool_pose", START + 1, np.ones(3), "map"))
        assert "/tool_pose has poses of several frames: a pose in 'base_link', a pose in 'map'" in refused(tmp_path)


class TestStamps:
    def test_out_of_order_are_sorted_and_repeats_left_out(self, tmp_path):
        recording(tmp_path, stamps=lambda number: (0, 2, 1, 3, 4, 4)[number] / 10)
        episode, warnings = imported(tmp_path)
        assert "1 of 6 clouds arrived out of order" in warnings[0]
        assert "1 clouds have the stamp of another" in warnings[1]
        np.testing.assert_allclose(episode.frame(1), cloud(2), atol=1e-6)
        np.testing.assert_allclose(episode.times, np.arange(5) / 10, atol=1e-6)

    def test_a_clock_that_was_set_back(self, tmp_path):
        recording(tmp_path, stamps=lambda number: number / 10 - (number > 3))
        assert "/cloth/points: message 5 is stamped 0.90 s before one that came earlier" in refused(tmp_path)

    def test_no_clouds_or_none_with_points(self, tmp_path):
        recording(tmp_path, empty=range(FRAMES))
        assert "No cloud can be used: bag: no finite point on /cloth/points. Record the topic again" in refused(tmp_path)

    def test_topics_without_a_message(self, tmp_path):
        """Announced, but never sent."""

        def announce(bag):
            for topic, kind in (("/tool_pose", "geometry_msgs/msg/PoseStamped"), ("/more", "sensor_msgs/msg/PointCloud2")):
                bag._writer.add_connection(topic, kind, typestore=bag._store)

        recording(tmp_path, also=announce)
        for topic in ("/tool_pose", "/more"):
            named = ("--topic", topic, "--topic", "/cloth/points")
            assert f"bag has no message on {topic}. Name another topic" in refused(tmp_path, *named)
        check_track(imported(tmp_path, "--topic", "/cloth/points")[0])


class Both(CloudBag):
    """Depth images and clouds."""

    write = Bag.write

    def _tf(self, t):
        super()._tf(t)
        self.points("/cloth/points", "base_link", PLAIN, 0, t)


def test_depth_images_are_preferred_unless_clouds_are_named(tmp_path):
    Both(tmp_path / "bag").write()
    done = invoke("data", "import", tmp_path / "bag", "--out", tmp_path / "raw")
    assert done.result["kind"] == "ros"
    assert any("the clouds on /cloth/points were not. If the clouds show only" in text for text in done.result["warnings"])
    episode, _ = imported(tmp_path, "--topic", "/cloth/points")
    np.testing.assert_allclose(episode.frame(3), cloud(0), atol=1e-6)
    depth = "/side/aligned_depth_to_color/image_raw"
    said = refused(tmp_path, "--topic", "/cloth/points", "--topic", depth)
    assert f"--topic names clouds (/cloth/points) and depth images ({depth}). A recording is read by one" in said


def test_a_part_of_a_split_recording_is_refused(tmp_path):
    for number in range(2):
        CloudBag(tmp_path / f"lift_{number}.bag", "rosbag1").write(tool=by_tf)
    said = invoke("data", "import", tmp_path / "lift_1.bag", "--out", tmp_path / "e.npz", code=1).errors
    assert "lift_1.bag is one of the 2 parts of a split recording" in said


def test_points_in_millimetres_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("tests.io.ros_clouds.cloud", lambda number: 1000 * cloud(number))
    recording(tmp_path, clouds={"/cloth/points": ("base_link", PLAIN, 0.0)}, tool=None)
    assert "points lie up to 800 m from the origin. Clouds are in metres" in refused(tmp_path)
