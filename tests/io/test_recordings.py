"""Recordings of other tools become raw episodes: ROS bags of both kinds, MCAP, RealSense files, folders of PNG."""

from __future__ import annotations

import json
import shutil
import time

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from diffcloud.io.raw_episodes import read_raw_episode
from diffcloud.sensing.cameras import inverse
from diffcloud.sensing.validation import validate_raw_episode
from tests.pipeline.invoke import invoke
from tests.sensing.table_scene import HOME_RAD, INTRINSICS, poses, table_depth, write_table_episode

START = 1_700_000_000.0
FRAMES = 5
TOOL = np.array([0.5767, 0.0013, 0.4337])


class Bag:
    """Writes the table scene as ROS messages, of either generation."""

    def __init__(self, path, kind, *, encoding="16UC1", joints=True):
        self._ros1 = kind == "rosbag1"
        self._store = get_typestore(Stores.ROS1_NOETIC if self._ros1 else Stores.ROS2_HUMBLE)
        if self._ros1:  # the store lacks it, bags bring it along
            definition = "geometry_msgs/TransformStamped[] transforms"
            self._store.register(get_types_from_msg(definition, "tf2_msgs/msg/TFMessage"))
        self._encoding, self._joints = encoding, joints
        if self._ros1:
            self._writer = Writer1(path)
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self._writer = Writer2(path, version=9, storage_plugin=plugin)
        self._connections = {}

    def write(self):
        with self._writer:
            for step in range(2 * FRAMES + 4):
                t = START + step / 20 - 0.05
                self._tf(t)
                if self._joints:
                    names = [f"joint_{index + 1}" for index in range(7)]
                    names, values = ["finger_joint", *names[::-1]], [0.4, *HOME_RAD[::-1]]
                    self._send("/joint_states", t, "sensor_msgs/msg/JointState", name=names,
                               position=np.array(values), velocity=np.zeros(0), effort=np.zeros(0))  # fmt: skip
                if step % 2 == 1 and step // 2 < FRAMES:
                    for name, pose in poses().items():
                        self._camera(name, pose, t, step // 2)

    def _camera(self, name, pose, t, number):
        frame = f"{name}_optical"
        matrix = INTRINSICS.matrix.ravel()
        upper = {"D": np.zeros(5), "K": matrix, "R": np.eye(3).ravel(), "P": np.zeros(12)}
        lens = upper if self._ros1 else {key.lower(): value for key, value in upper.items()}
        region = self._type("sensor_msgs/msg/RegionOfInterest")(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        prefix = f"/{name}/aligned_depth_to_color"
        size = {"height": INTRINSICS.height, "width": INTRINSICS.width}
        rest = {**size, **lens, "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0, "roi": region}
        self._send(f"{prefix}/camera_info", t, "sensor_msgs/msg/CameraInfo", frame=frame, **rest)
        depth = table_depth(pose)
        depth[0, 0] = 1000 + number
        data = depth if self._encoding == "16UC1" else np.where(depth > 0, depth / 1000, np.nan).astype(np.float32)
        color = np.full((*depth.shape, 3), [10, 20, 30 + number], np.uint8)
        self._image(f"/{name}/color/image_raw", t - 0.002, frame, color, "bgr8")
        self._image(f"{prefix}/image_raw", t, frame, data, self._encoding)
        self._image(f"/{name}/depth/image_rect_raw", t, frame, data, self._encoding)  # not aligned: to be left alone

    def _image(self, topic, t, frame, pixels, encoding):
        size = {"height": pixels.shape[0], "width": pixels.shape[1], "step": pixels[0].nbytes, "is_bigendian": 0}
        data = np.frombuffer(pixels.tobytes(), np.uint8)
        self._send(topic, t, "sensor_msgs/msg/Image", frame=frame, encoding=encoding, data=data, **size)

    def _tf(self, t):
        places = {f"{name}_link": pose @ inverse(self.optical) for name, pose in poses().items()}
        edges = [("base_link", child, place) for child, place in places.items()]
        edges += [(f"{name}_link", f"{name}_optical", self.optical) for name in poses()]
        tool = np.eye(4)
        tool[:3, 3] = np.add(TOOL, [0, 0, 0.1 * (t - START)])
        edges.append(("base_link", "tool_frame", tool))
        moves = []
        for parent, child, place in edges:
            x, y, z, w = Rotation.from_matrix(place[:3, :3]).as_quat()
            turn = self._type("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)
            shift = self._type("geometry_msgs/msg/Vector3")(*place[:3, 3])
            move = self._type("geometry_msgs/msg/Transform")(translation=shift, rotation=turn)
            kind = self._type("geometry_msgs/msg/TransformStamped")
            moves.append(kind(header=self._header(t, parent), child_frame_id=child, transform=move))
        self._send("/tf", t, "tf2_msgs/msg/TFMessage", header=False, transforms=moves)

    optical = np.array([[0, 0, 1, 0.01], [-1, 0, 0, 0.02], [0, -1, 0, 0], [0, 0, 0, 1.0]])

    def _type(self, name):
        return self._store.types[name]

    def _header(self, t, frame):
        stamp = self._type("builtin_interfaces/msg/Time")(sec=int(t), nanosec=round(t % 1 * 1e9))
        sequence = {"seq": 0} if self._ros1 else {}
        return self._type("std_msgs/msg/Header")(stamp=stamp, frame_id=frame, **sequence)

    def _send(self, topic, t, kind, *, frame="", header=True, **fields):
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        if header:
            fields["header"] = self._header(t, frame)
        message = self._type(kind)(**fields)
        raw = self._store.serialize_ros1(message, kind) if self._ros1 else self._store.serialize_cdr(message, kind)
        self._writer.write(self._connections[topic], round(t * 1e9), raw)


def bag(tmp_path, kind, **options):
    path = tmp_path / ("bag.bag" if kind == "rosbag1" else "bag")
    Bag(path, kind, **options).write()
    if kind == "mcap":  # a lone file, as MCAP is mostly handed around
        shutil.move(path / "bag.mcap", tmp_path / "lone.mcap")
        return tmp_path / "lone.mcap"
    return path


@pytest.mark.parametrize("kind", ["rosbag1", "rosbag2", "mcap"])
def test_ros_recordings(tmp_path, kind):
    done = invoke("import", "recording", bag(tmp_path, kind), "--out", tmp_path / "e", "--fabric", "tan")
    assert done.result["frames"] == {"overhead": FRAMES, "side": FRAMES}
    episode = read_raw_episode(tmp_path / "e")
    assert episode.description["rate_hz"] == pytest.approx(10, abs=0.01)
    for name, pose in poses().items():
        camera = episode.cameras[name]
        np.testing.assert_allclose(camera.info.T_world_camera, pose, atol=1e-9)
        assert camera.info.intrinsics == INTRINSICS
        np.testing.assert_allclose(camera.times, np.arange(FRAMES) / 10, atol=1e-6)
        for index in range(FRAMES):
            expected = table_depth(pose)
            expected[0, 0] = 1000 + index
            np.testing.assert_array_equal(camera.depth(index), expected)
            assert (camera.color(index) == [30 + index, 20, 10]).all()
    log = episode.robot
    np.testing.assert_allclose(log.joints_rad, np.tile(HOME_RAD, (len(log.times), 1)), atol=1e-7)
    np.testing.assert_allclose(log.gripper, 0.5)
    expected = TOOL[2] + 0.1 * log.times
    np.testing.assert_allclose(log.tool_position_m[:, 2], expected, atol=1e-6)
    assert [finding for finding in validate_raw_episode(tmp_path / "e") if finding.severity == "fault"] == []


def test_depth_in_metres(tmp_path):
    invoke("import", "recording", bag(tmp_path, "rosbag2", encoding="32FC1"), "--out", tmp_path / "e")
    camera = read_raw_episode(tmp_path / "e").cameras["side"]
    metres = camera.depth(2) * camera.info.depth_scale_m
    expected = table_depth(poses()["side"]) / 1000
    np.testing.assert_allclose(metres.ravel()[1:], expected.ravel()[1:], atol=1.3e-4)


def test_ros_recordings_that_lack_something(tmp_path):
    path = bag(tmp_path, "rosbag2")
    bad = invoke("import", "recording", path, "--out", tmp_path / "e", "--joint", "elbow", code=1)
    assert "['elbow'] not among them. Name the arm's joints" in bad.errors
    done = invoke("import", "recording", path, "--out", tmp_path / "f", "--tool-frame", "nowhere", "--world-frame", "map")
    assert done.result["robot_rows"] > 0
    episode = read_raw_episode(tmp_path / "f")
    assert np.isnan(episode.robot.tool_position_m).all()
    assert episode.cameras["side"].info.T_world_camera is None
    (tmp_path / "x.mcap").write_bytes(b"\x89MCAP0\r\nrest")
    assert (
        "not a readable ROS recording"
        in invoke("import", "recording", tmp_path / "x.mcap", "--out", tmp_path / "g", code=1).errors
    )
    (tmp_path / "x.txt").write_text("")
    assert (
        "unknown kind of recording"
        in invoke("import", "recording", tmp_path / "x.txt", "--out", tmp_path / "g", code=1).errors
    )


def as_folders(tmp_path):
    """The table scene as folders of PNG, one with this project's JSON and one with Open3D's."""
    episode = write_table_episode(tmp_path / "made", frames=4)
    for name in poses():
        shutil.copytree(episode / "cameras" / name, tmp_path / name)
    matrix = INTRINSICS.matrix.T.ravel().tolist()
    open3d = {"width": 160, "height": 120, "intrinsic_matrix": matrix, "depth_scale": 1000.0, "serial_number": "77"}
    (tmp_path / "side" / "camera.json").write_text(json.dumps(open3d))
    return [tmp_path / "overhead", tmp_path / "side"], episode / "robot.csv"


def test_folders_of_png(tmp_path):
    folders, log = as_folders(tmp_path)
    (folders[1] / "timestamps.csv").unlink()
    missing = invoke("import", "recording", *folders, "--out", tmp_path / "e", code=1)
    assert "give the frame rate with --rate-hz" in missing.errors
    done = invoke("import", "recording", *folders, "--out", tmp_path / "e", "--rate-hz", 10, "--joint-log", log)
    assert done.result["frames"] == {"overhead": 4, "side": 4}
    episode = read_raw_episode(tmp_path / "e")
    assert episode.cameras["side"].info.serial == "77"
    assert episode.cameras["side"].info.intrinsics == INTRINSICS
    np.testing.assert_array_equal(episode.cameras["side"].depth(3), table_depth(poses()["side"]))
    assert len(episode.robot.times) == 10


def test_folders_that_are_damaged(tmp_path):
    folders, log = as_folders(tmp_path)
    (folders[0] / "depth" / "000001.png").unlink()
    assert "frames [1] are missing" in invoke("import", "recording", folders[0], "--out", tmp_path / "e", code=1).errors
    (folders[1] / "depth" / "000001.png").write_bytes(b"\xff\xd8\xff\xe0")
    assert "is a JPEG" in invoke("import", "recording", folders[1], "--out", tmp_path / "f", code=1).errors
    (folders[1] / "camera.json").unlink()
    assert "intrinsics must be stated" in invoke("import", "recording", folders[1], "--out", tmp_path / "g", code=1).errors
    shifted = log.read_text().splitlines()
    rows = [shifted[0], *(f"{START + index},{line.split(',', 1)[1]}" for index, line in enumerate(shifted[1:]))]
    (tmp_path / "epoch.csv").write_text("\n".join(rows) + "\n")
    (folders[0] / "depth" / "000001.png").write_bytes((folders[0] / "depth" / "000002.png").read_bytes())
    bad = invoke("import", "recording", folders[0], "--out", tmp_path / "h", "--joint-log", tmp_path / "epoch.csv", code=1)
    assert "different clocks" in bad.errors


def test_realsense_recordings_of_two_cameras_with_a_joint_log(tmp_path):
    pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed (pip install diffcloud[hardware])")
    from diffcloud.hardware.realsense import RealSenseCamera, import_realsense
    from tests.hardware.software_cameras import FPS, HEIGHT, WIDTH, Cameras, numbered_depth

    cameras = Cameras(import_realsense())
    opened = [
        RealSenseCamera(
            name, serial, context=cameras.context, width=WIDTH, height=HEIGHT, fps=FPS, record_to=tmp_path / f"{name}.db3"
        )
        for name, serial in zip(("overhead", "side"), cameras.SERIALS, strict=True)
    ]
    start = time.time()
    for camera in opened:
        camera.open()
    for number in range(1, 9):
        for camera in cameras.cameras:
            camera.push_numbered(number, 1000 * (start + number / FPS))
        for camera in opened:
            camera.read(2.0)
    for camera in opened:
        camera.close()
    rows = [f"{start + index / 50}," + ",".join(["0.1"] * 7) for index in range(20)]
    (tmp_path / "log.csv").write_text(
        "\n".join(["t_s," + ",".join(f"joint_{index}" for index in range(1, 8)), *rows]) + "\n"
    )
    done = invoke(
        "import", "recording", tmp_path / "overhead.db3", f"side={tmp_path / 'side.db3'}", "--out", tmp_path / "e",
        "--joint-log", tmp_path / "log.csv",
    )  # fmt: skip
    assert done.result["frames"] == {"overhead": 8, "side": 8}
    episode = read_raw_episode(tmp_path / "e")
    np.testing.assert_array_equal(episode.cameras["side"].depth(4), numbered_depth(5, 1))
    np.testing.assert_allclose(np.diff(episode.cameras["side"].times), 1 / FPS, atol=1e-3)
    assert episode.robot.times[0] == pytest.approx(-1 / FPS, abs=1e-3)
    faults = {finding.code for finding in validate_raw_episode(tmp_path / "e") if finding.severity == "fault"}
    assert not faults & {"short_robot_log", "clock_gap", "clock_backwards"}
