"""ROS recordings in which several topics, or several nodes on one topic, send what the import needs; and clocks."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from diffcloud.io.raw_episodes import read_raw_episode
from tests.cli.invoke import invoke
from tests.io.ros_bag import ARM, FRAMES, START, Bag, Habits
from tests.sensing.table_scene import HOME_RAD, INTRINSICS, poses

ROWS = 2 * FRAMES + 4
ALL = (*ARM, "finger_joint")


class Rivals(Bag):
    """The arm moves at 0.2 rad/s, 0.05 s a message; another node sends on the same or another topic."""

    def __init__(self, path, kind, *, topic="/joint_states", sender="/driver", late_s=0.004, other=None, names=ALL,
                 frame="", habits=None):  # fmt: skip
        super().__init__(path, kind, habits or Habits(unaligned=False))
        self._other, self._topic, self._sender, self._late, self._names, self._frame = (
            other,
            topic,
            sender,
            late_s,
            names,
            frame,
        )

    def driven(self, t):
        return dict(zip(ALL, [angle + 0.2 * (t - START) for angle in HOME_RAD] + [0.4], strict=True))

    def _joints(self, t, values):
        del values
        self._state("/joint_states", "/driver", t, self.driven(t), "")
        if self._other is not None:
            sent = self._other(t, self.driven(t))
            self._state(self._topic, self._sender, t + self._late, {name: sent[name] for name in self._names}, self._frame)

    def _state(self, topic, sender, t, values, frame):
        key = (topic, sender)
        kind = "sensor_msgs/msg/JointState"
        if self._ros1 and key not in self._connections:
            self._connections[key] = self._writer.add_connection(topic, kind, typestore=self._store, callerid=sender)
        shared = self._connections.get(topic)
        if self._ros1:
            self._connections[topic] = self._connections[key]
        empty = np.zeros(0)
        self._send(topic, t, kind, frame=frame, name=list(values), position=np.array(list(values.values())),
                   velocity=empty, effort=empty)  # fmt: skip
        if self._ros1 and shared is not None:
            self._connections[topic] = shared


def zeros(t, driven):
    return dict.fromkeys(driven, 0.0)


def desired(t, driven):
    return {name: angle + 0.15 for name, angle in driven.items()}


def imported(tmp_path, *options, code=0):
    shutil.rmtree(tmp_path / "e", ignore_errors=True)
    path = next(path for path in (tmp_path / "bag.bag", tmp_path / "bag") if path.exists())
    return invoke("data", "import", path, "--out", tmp_path / "e", *options, code=code)


def written(tmp_path, kind="rosbag2", **habits):
    bag = Rivals(tmp_path / ("bag.bag" if kind == "rosbag1" else "bag"), kind, **habits)
    bag.write()
    return bag


def check_driven(tmp_path, offset=0.0):
    log = read_raw_episode(tmp_path / "e").robot
    assert len(log.times) == ROWS
    # the first image comes 0.05 s after the first message
    np.testing.assert_allclose(log.joints_rad[:, 3], HOME_RAD[3] + 0.2 * (log.times) + offset, atol=1e-5)


@pytest.mark.parametrize("kind", ["rosbag1", "rosbag2"])
class TestJointStates:
    def test_zeros_between_the_drivers_angles(self, tmp_path, kind):
        written(tmp_path, kind, sender="/joint_state_publisher", other=zeros)
        said = imported(tmp_path, code=1).errors
        assert "Several publishers send the same joints at the same time: /joint_states#1 (14 messages of" in said
        assert "moving); /joint_states#2 (14 messages of" in said
        assert "standing still). Name the one that measured the arm with --topic" in said
        assert not (tmp_path / "e").exists()
        for topic in ("/joint_states", "/joint_states#1"):
            done = imported(tmp_path, "--topic", topic)
            check_driven(tmp_path)
            assert "/joint_states#2: 14 joint states of another publisher were left out." in done.result["warnings"]
        imported(tmp_path, "--topic", "/joint_states#2")
        assert not read_raw_episode(tmp_path / "e").robot.joints_rad.any()
        assert "There is no /joint_states#3" in imported(tmp_path, "--topic", "/joint_states#3", code=1).errors

    def test_two_that_move_on_one_topic_are_never_guessed(self, tmp_path, kind):
        written(tmp_path, kind, sender="/controller", other=desired)
        assert "/joint_states#2" in imported(tmp_path, "--topic", "/joint_states", code=1).errors
        for number, offset in ((1, 0.0), (2, 0.15)):
            imported(tmp_path, "--topic", f"/joint_states#{number}")
            log = read_raw_episode(tmp_path / "e").robot
            late = 0.004 * (number - 1)
            np.testing.assert_allclose(log.joints_rad[:, 3], HOME_RAD[3] + 0.2 * (log.times - late) + offset, atol=1e-5)

    def test_desired_angles_on_a_topic_of_their_own(self, tmp_path, kind):
        written(tmp_path, kind, topic="/controller/joint_states_desired", other=desired, names=ARM)
        said = imported(tmp_path, code=1).errors
        assert "/joint_states (14 messages" in said
        assert "/controller/joint_states_desired (14 messages" in said
        done = imported(tmp_path, "--topic", "/joint_states")
        check_driven(tmp_path)
        assert done.result["warnings"] == []
        said = imported(tmp_path, "--topic", "/nowhere", code=1).errors
        assert "has no topic /nowhere, which --topic names; its topics are /controller/joint_states_desired" in said

    def test_other_names_and_frames_tell_publishers_apart(self, tmp_path, kind):
        written(tmp_path, kind, other=desired, names=ARM[::-1], frame="goal")
        assert "/joint_states#2 (14 messages" in imported(tmp_path, code=1).errors
        imported(tmp_path, "--topic", "/joint_states#1")
        check_driven(tmp_path)

    def test_joints_that_turn_over_or_jump_once_are_one_publisher(self, tmp_path, kind):
        """From pi to -pi is no jump; one faulty message is no other publisher."""

        class Turning(Rivals):
            def driven(self, t):
                turned = {name: (angle + 3 + np.pi) % (2 * np.pi) - np.pi for name, angle in super().driven(t).items()}
                return turned if abs(t - START - 0.2) > 1e-3 else dict.fromkeys(turned, 1.0)

        Turning(tmp_path / ("bag.bag" if kind == "rosbag1" else "bag"), kind).write()
        assert imported(tmp_path).result["robot_rows"] == ROWS


class Others(Bag):
    """Sends one more image, camera_info or transform a frame."""

    def __init__(self, path, *, more, **habits):
        super().__init__(path, "rosbag2", Habits(unaligned=False, **habits))
        self._more = more

    def _camera(self, name, pose, arrival, number):
        if name == "side":
            super()._camera(name, pose, arrival, number)
            self._more(self, arrival, number)


def depth_image(topic, frame="side_optical", value=500):
    pixels = np.full((INTRINSICS.height, INTRINSICS.width), value, np.uint16)
    return lambda bag, t, number: bag._image(topic, t, t, frame, pixels, "16UC1")


class TestOtherTopics:
    def test_two_depth_topics_of_one_camera(self, tmp_path):
        more = depth_image("/side/depth/image")
        Others(tmp_path / "bag", depth="depth/image_raw", more=more).write()
        said = imported(tmp_path, code=1).errors
        assert "has several depth topics of one camera: /side/depth/image and /side/depth/image_raw" in said
        imported(tmp_path, "--topic", "/side/depth/image")
        assert (read_raw_episode(tmp_path / "e").cameras["side"].depth(1) == 500).all()
        imported(tmp_path, "--topic", "/side/depth/image_raw")
        assert read_raw_episode(tmp_path / "e").cameras["side"].depth(1)[0, 0] == 1001

    def test_camera_info_that_lies_elsewhere(self, tmp_path):
        more = depth_image("/lab/depth/image")
        Others(tmp_path / "bag", more=more).write()
        named = ("--topic", "/lab/depth/image")
        said = imported(tmp_path, *named, code=1).errors
        assert "no camera_info beside /lab/depth/image" in said
        assert "If one of /side/aligned_depth_to_color/camera_info belongs to it, name it with --topic" in said
        imported(tmp_path, *named, "--topic", "/side/aligned_depth_to_color/camera_info")
        (camera,) = read_raw_episode(tmp_path / "e").cameras.values()
        assert camera.info.intrinsics == INTRINSICS

    def test_two_cameras_on_one_topic(self, tmp_path):
        more = depth_image("/side/aligned_depth_to_color/image_raw", frame="front")
        Others(tmp_path / "bag", more=more).write()
        assert "has images of two cameras, in the frames 'side_optical' and 'front'" in imported(tmp_path, code=1).errors

    def test_two_topics_of_transforms_that_disagree(self, tmp_path):
        def more(bag, t, number):
            sent = bag._send
            bag._send = lambda topic, *rest, **fields: sent(f"/other{topic}", *rest, **fields)
            bag._tf(t + 1)  # the tool has risen by 10 cm
            bag._send = sent

        Others(tmp_path / "bag", more=more).write()
        said = imported(tmp_path, code=1).errors
        assert "several topics of transforms place 'tool_frame' differently: /other/tf, /tf. Name those" in said
        imported(tmp_path, "--topic", "/tf")
        log = read_raw_episode(tmp_path / "e").robot
        np.testing.assert_allclose(log.tool_position_m[:, 2], 0.4337 + 0.1 * log.times, atol=1e-6)


class Clock(Bag):
    """Stamps by a function of (time since the start, what is stamped); messages arrive as in other recordings."""

    def __init__(self, path, stamp):
        super().__init__(path, "rosbag2", Habits(unaligned=False))
        self._stamp = stamp

    def _joints(self, t, values):
        self._what = "joints"
        super()._joints(t, values)

    def _tf(self, t):
        self._what = "tf"
        super()._tf(t)

    def _camera(self, name, pose, arrival, number):
        self._what = "images"
        super()._camera(name, pose, arrival, number)

    def _header(self, t, frame):
        return super()._header(max(0.0, self._stamp(round(t - START, 6), self._what)), frame)


class TestClocks:
    @pytest.mark.parametrize(
        ("stamp", "warned"),
        [
            (lambda t, what: t, None),
            (lambda t, what: 0.0, "are stamped 0; the times at which they were received are taken. Motion is late"),
            (lambda t, what: 0.0 if what == "joints" else START + t, "/joint_states: 14 of 14 messages are stamped 0"),
            (lambda t, what: 0.0 if what == "joints" else t + 5, "moved to the clock of the stamped messages"),
            (lambda t, what: 0.0 if t < 0.1 else START + t, "1 of 5 messages are stamped 0"),
        ],
    )
    def test_frames_and_joints_keep_their_times(self, tmp_path, stamp, warned):
        Clock(tmp_path / "bag", stamp).write()
        warnings = " ".join(imported(tmp_path).result["warnings"])
        assert warned in warnings if warned else "stamped" not in warnings
        episode = read_raw_episode(tmp_path / "e")
        for name in poses():
            np.testing.assert_allclose(episode.cameras[name].times, np.arange(FRAMES) / 10, atol=0.003)
        times = episode.robot.times
        assert 11 <= len(times) <= ROWS
        np.testing.assert_allclose(times[-5:], 0.05 * np.arange(ROWS)[-5:] - 0.05, atol=0.003)

    def test_joints_on_another_clock_are_refused(self, tmp_path):
        Clock(tmp_path / "bag", lambda t, what: START + t if what == "joints" else t + 5).write()
        said = imported(tmp_path, code=1).errors
        assert "one is simulated time, the other time since 1970" in said

    def test_simulated_time_that_was_reset_is_refused(self, tmp_path):
        Clock(tmp_path / "bag", lambda t, what: t + 20 if t < 0.25 else t - 0.25).write()
        assert "The clock was set back while recording" in imported(tmp_path, code=1).errors
