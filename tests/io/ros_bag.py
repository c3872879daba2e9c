"""The table scene as a ROS recording of either generation, with the habits that recordings differ in."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from diffcloud.sensing.cameras import inverse
from diffcloud.sensing.robot import gen3
from tests.sensing.table_scene import HOME_RAD, INTRINSICS, poses, table_depth

START = 1_700_000_000.0
FRAMES = 5
TOOL = np.array([0.5767, 0.0013, 0.4337])
OPTICAL = np.array([[0, 0, 1, 0.01], [-1, 0, 0, 0.02], [0, -1, 0, 0], [0, 0, 0, 1.0]])
ARM = tuple(f"joint_{index + 1}" for index in range(7))
WORLD_BASE = np.array([[0, -1, 0, 0.4], [1, 0, 0, -0.2], [0, 0, 1, 0.7], [0, 0, 0, 1.0]])


@dataclass(frozen=True)
class Habits:
    """How a laboratory records."""

    folder: str = "/{name}"
    """Of a camera's topics."""
    depth: str = "aligned_depth_to_color/image_raw"
    unaligned: bool = True
    """Also send depth/image_rect_raw, which is to be left alone."""
    encoding: str = "16UC1"
    """Of an Image; or the format of a CompressedImage, with a semicolon."""
    depth_frame: str = "{name}_optical"
    color_info: float | None = None
    """Focal length in the colour's own camera_info [px]; None: there is none."""
    lens: tuple[float, ...] = (0.0,) * 5
    """D of every camera_info."""
    lens_model: str = "plumb_bob"
    calibrated: bool = True
    """Whether K is not zero."""
    rectified_focal: float | None = None
    """Focal length in P [px]; None: P is zero."""
    color_late_s: Callable[[int], float] = lambda number: -0.002
    """Stamp of a frame's colour after that of its depth."""
    stamps_s: Callable[[int], float] = lambda number: number / 10
    """Stamp of a frame; it arrives at number / 10."""
    root: str = "base_link"
    """Where the cameras hang in tf; base_link hangs there too."""
    mount: str | None = None
    """What the cameras are mounted on, where it is not the root."""
    joints: dict[str, float] = field(default_factory=lambda: {"finger_joint": 0.4})
    """Joints that are sent with those of the arm."""
    own_joints: dict[str, float] = field(default_factory=dict)
    """Joints that another driver sends in messages of its own."""
    arm: bool = True
    links: bool = False
    """Send all links of the arm and its gripper in tf, whose third joint turns by 0.5 rad a second."""


class Bag:
    """Writes the scene.

    Args:
        kind: rosbag1, rosbag2 or mcap.
        steps: of half a frame's time; parts of a split recording have some of them.
    """

    def __init__(self, path: Path, kind: str, habits: Habits, steps: range = range(2 * FRAMES + 4)) -> None:
        self._ros1, self._habits, self._steps = kind == "rosbag1", habits, steps
        self._store = get_typestore(Stores.ROS1_NOETIC if self._ros1 else Stores.ROS2_HUMBLE)
        if self._ros1:  # the store lacks it, bags bring it along
            definition = "geometry_msgs/TransformStamped[] transforms"
            self._store.register(get_types_from_msg(definition, "tf2_msgs/msg/TFMessage"))
            self._writer = Writer1(path)
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self._writer = Writer2(path, version=9, storage_plugin=plugin)
        self._connections = {}

    def write(self):
        habits = self._habits
        with self._writer:
            for step in self._steps:
                t = START + step / 20 - 0.05
                self._tf(t)
                if habits.arm:
                    self._joints(t, {**habits.joints, **dict(zip(ARM[::-1], HOME_RAD[::-1], strict=True))})
                if habits.own_joints:
                    self._joints(t + 0.01, habits.own_joints)
                if step % 2 == 1 and step // 2 < FRAMES:
                    for name, pose in poses().items():
                        self._camera(name, pose, t, step // 2)

    def _joints(self, t, values):
        empty = np.zeros(0)
        self._send("/joint_states", t, "sensor_msgs/msg/JointState", name=list(values),
                   position=np.array(list(values.values())), velocity=empty, effort=empty)  # fmt: skip

    def _camera(self, name, pose, arrival, number):
        habits = self._habits
        folder, frame = habits.folder.format(name=name), habits.depth_frame.format(name=name)
        t = START + habits.stamps_s(number)
        topic = f"{folder}/{habits.depth}"
        self._info(f"{topic.rsplit('/', 1)[0]}/camera_info", t, arrival, frame, INTRINSICS.fx)
        depth = table_depth(pose)
        depth[0, 0] = 1000 + number
        late = t + habits.color_late_s(number)
        if habits.color_info is not None:
            self._info(f"{folder}/color/camera_info", late, arrival, f"{name}_optical", habits.color_info)
        color = np.full((*depth.shape, 3), [10, 20, 30 + number], np.uint8)
        self._image(f"{folder}/color/image_raw", late, arrival, f"{name}_optical", color, "bgr8")
        self._image(topic, t, arrival, frame, depth, habits.encoding)
        if habits.unaligned:
            self._image(f"{folder}/depth/image_rect_raw", t, arrival, frame, depth, "16UC1")

    def _info(self, topic, t, arrival, frame, focal):
        matrix = INTRINSICS.matrix
        matrix[0, 0] = matrix[1, 1] = focal
        matrix *= self._habits.calibrated
        rectified = np.zeros((3, 4))
        if self._habits.rectified_focal is not None:
            rectified[:, :3] = matrix
            rectified[0, 0] = rectified[1, 1] = self._habits.rectified_focal
        upper = {"D": np.array(self._habits.lens), "K": matrix.ravel(), "R": np.eye(3).ravel(), "P": rectified.ravel()}
        lens = upper if self._ros1 else {key.lower(): value for key, value in upper.items()}
        region = self._type("sensor_msgs/msg/RegionOfInterest")(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        size = {"height": INTRINSICS.height, "width": INTRINSICS.width}
        rest = {**size, **lens, "distortion_model": self._habits.lens_model, "binning_x": 0, "binning_y": 0, "roi": region}
        self._send(topic, t, "sensor_msgs/msg/CameraInfo", frame=frame, arrival=arrival, **rest)

    def _image(self, topic, t, arrival, frame, pixels, encoding):
        if ";" in encoding:
            data = np.frombuffer(compressed_depth(pixels, encoding), np.uint8)
            self._send(f"{topic}/compressedDepth", t, "sensor_msgs/msg/CompressedImage", frame=frame, arrival=arrival,
                       format=encoding, data=data)  # fmt: skip
            return
        if encoding == "32FC1":
            pixels = np.where(pixels > 0, pixels / 1000, np.nan).astype(np.float32)
        size = {"height": pixels.shape[0], "width": pixels.shape[1], "step": pixels[0].nbytes, "is_bigendian": 0}
        data = np.frombuffer(pixels.tobytes(), np.uint8)
        self._send(topic, t, "sensor_msgs/msg/Image", frame=frame, arrival=arrival, encoding=encoding, data=data, **size)

    def _tf(self, t):
        root = self._habits.root
        above = np.eye(4) if root == "base_link" else WORLD_BASE
        places = {f"{name}_link": above @ pose @ inverse(OPTICAL) for name, pose in poses().items()}
        edges = [(self._habits.mount or root, child, place) for child, place in places.items()]
        if root != "base_link":
            edges.append((root, "base_link", above))
        edges += [(f"{name}_link", f"{name}_optical", OPTICAL) for name in poses()]
        tool = np.eye(4)
        tool[:3, 3] = np.add(TOOL, [0, 0, 0.1 * (t - START)])
        edges += self._links(t) if self._habits.links else [("base_link", "tool_frame", tool)]
        moves = []
        for parent, child, place in edges:
            x, y, z, w = Rotation.from_matrix(place[:3, :3]).as_quat()
            turn = self._type("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)
            shift = self._type("geometry_msgs/msg/Vector3")(*place[:3, 3])
            move = self._type("geometry_msgs/msg/Transform")(translation=shift, rotation=turn)
            kind = self._type("geometry_msgs/msg/TransformStamped")
            moves.append(kind(header=self._header(t, parent), child_frame_id=child, transform=move))
        self._send("/tf", t, "tf2_msgs/msg/TFMessage", header=False, transforms=moves)

    def _links(self, t):
        robot = gen3()
        angles = dict(zip([robot.moving[index].name for index in robot.arm], HOME_RAD, strict=True))
        angles |= {"finger_joint": 0.4, "joint_3": HOME_RAD[2] + 0.5 * (t - START)}
        for joint in robot.description.joints:
            place = np.eye(4)
            place[:3, :3] = Rotation.from_rotvec(angles.get(joint.name, 0.0) * joint.axis).as_matrix()
            yield joint.parent, joint.child, joint.T_parent_joint @ place

    def _type(self, name):
        return self._store.types[name]

    def _header(self, t, frame):
        stamp = self._type("builtin_interfaces/msg/Time")(sec=int(t), nanosec=round(t % 1 * 1e9))
        sequence = {"seq": 0} if self._ros1 else {}
        return self._type("std_msgs/msg/Header")(stamp=stamp, frame_id=frame, **sequence)

    def _send(self, topic, t, kind, *, frame="", header=True, arrival=None, **fields):
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        if header:
            fields["header"] = self._header(t, frame)
        message = self._type(kind)(**fields)
        raw = self._store.serialize_ros1(message, kind) if self._ros1 else self._store.serialize_cdr(message, kind)
        self._writer.write(self._connections[topic], round((t if arrival is None else arrival) * 1e9), raw)


def compressed_depth(depth, message_format):
    """Millimetres [H, W] as compressed_depth_image_transport writes them, with its default quantisation and range."""
    quantisation, furthest_m = 100.0, 10.0
    a = b = 0.0
    if message_format.startswith("32FC1"):
        a = quantisation * (quantisation + 1)
        b = 1 - a / furthest_m
        metres = np.where(depth > 0, depth / 1000, np.inf)
        depth = np.where(metres < furthest_m, a / metres + b, 0).astype(np.uint16)
    image = rvl(depth) if message_format.endswith("rvl") else cv2.imencode(".png", depth)[1].tobytes()
    return struct.pack("<iff", 1, a, b) + image


def rvl(depth):
    """Written number by number, as the paper's encoder does."""
    bits = ""

    def write(number):
        nonlocal bits
        while True:
            group, number = number & 7, number >> 3
            bits += f"{group | (8 if number else 0):04b}"
            if not number:
                return

    pixels, place, before = [int(value) for value in depth.ravel()], 0, 0
    while place < len(pixels):
        for measured in (False, True):
            count = 0
            while place + count < len(pixels) and (pixels[place + count] > 0) == measured:
                count += 1
            write(count)
            for value in pixels[place : place + count] if measured else []:
                step, before = value - before, value
                write(2 * step if step >= 0 else -2 * step - 1)
            place += count
    bits += "0" * (-len(bits) % 32)
    words = [int(bits[start : start + 32], 2) for start in range(0, len(bits), 32)]
    return struct.pack(f"<ii{len(words)}I", depth.shape[1], depth.shape[0], *words)


def bag(tmp_path, kind, **habits):
    """Path of a whole recording."""
    path = tmp_path / ("bag.bag" if kind == "rosbag1" else "bag")
    Bag(path, kind, Habits(**habits)).write()
    if kind == "mcap":  # a lone file, as MCAP is mostly handed around
        shutil.move(path / "bag.mcap", tmp_path / "lone.mcap")
        return tmp_path / "lone.mcap"
    return path
