"""Recordings of ROS, without ROS: rosbag1 files, rosbag2 folders and files, MCAP.

Depth images (16UC1 in millimetres, 32FC1 in metres, or compressedDepth PNG), camera_info, joint_states and tf. A camera is
found by its depth topic: `/overhead/aligned_depth_to_color/image_raw` is the camera `overhead`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffcloud.errors import EpisodeError
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.images import decode_color, decode_depth
from diffcloud.io.raw_episodes import CameraInfo, RobotLog
from diffcloud.io.recordings import RecordedFrame, Recording

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_INFO, _JOINTS = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/JointState"
_TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_MILLIMETRE = 0.001
_FLOAT_SCALE_M = 0.00025
"""Of 32-bit depth: a quarter of a millimetre, up to 16 m."""
_COMPRESSED_DEPTH_HEADER = 12
_PAIR_S = 0.02
"""Colour belongs to depth when their stamps differ by less."""
_COLOR_CHANNELS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2), "bgra8": (2, 1, 0), "mono8": (0, 0, 0)}


def ros_recording(
    path: Path,
    *,
    world_frame: str = "base_link",
    tool_frame: str = "tool_frame",
    joint_names: list[str] | None = None,
    gripper_joint: str = "finger_joint",
    gripper_closed_rad: float = 0.8,
) -> Recording:
    """A bag as a recording; images are read lazily.

    Args:
        world_frame, tool_frame: tf frames; poses that tf does not have stay open.
        joint_names: of the arm, in order; None takes joint_1, joint_2, ... of joint_states.
        gripper_joint, gripper_closed_rad: its angle, from 0 (open) to this (closed), becomes 0..1.

    Raises:
        EpisodeError: unreadable, without depth and camera_info, or without the named joints; lists the topics there are.
    """
    with _opened(path) as reader:
        topics = {connection.topic: connection.msgtype for connection in reader.connections}
        depth_topics = _depth_topics(path, topics)
        info_topics = {name: _info_topic(path, topic, topics) for name, topic in depth_topics.items()}
        color_topics = {name: _color_topic(name, topics) for name in depth_topics}
        infos: dict[str, Any] = {}
        joints: list[Any] = []
        transforms: list[tuple[float, Any]] = []
        scales: dict[str, float] = {}
        wanted = {*info_topics.values(), *depth_topics.values()}
        for connection, stamp, raw in reader.messages(
            [held for held in reader.connections if held.topic in wanted or held.msgtype in (_JOINTS, *_TF)]
        ):
            if connection.topic in depth_topics.values():
                name = next(key for key, topic in depth_topics.items() if topic == connection.topic)
                if name not in scales:  # images are skipped otherwise: only the first tells the encoding
                    message = reader.deserialize(raw, connection.msgtype)
                    scales[name] = _FLOAT_SCALE_M if getattr(message, "encoding", "") == "32FC1" else _MILLIMETRE
                continue
            message = reader.deserialize(raw, connection.msgtype)
            if connection.msgtype == _INFO:
                infos.setdefault(connection.topic, message)
            elif connection.msgtype == _JOINTS:
                joints.append((_time(message, stamp), message))
            else:
                transforms += [(_time(item, stamp), item) for item in message.transforms]
    tree = _TransformTree(transforms)
    cameras = {}
    for name in depth_topics:
        held = infos.get(info_topics[name])
        if held is None or name not in scales:
            raise EpisodeError(f"{path}: camera {name} has no message on {info_topics[name]} or {depth_topics[name]}.")
        pose = tree.lookup(world_frame, held.header.frame_id, np.zeros(1))
        cameras[name] = CameraInfo(
            name, f"ros{depth_topics[name]}", _intrinsics(held, name), scales[name], None if pose is None else pose[0]
        )
    robot = _robot(path, joints, tree, world_frame, tool_frame, joint_names, gripper_joint, gripper_closed_rad)
    frames = _frames(path, depth_topics, color_topics, cameras)
    return Recording(cameras, frames, f"ros recording {Path(path).name}", robot)


def _opened(path: Path) -> Any:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    # bags of rosbag2 before 2023 carry no message definitions; those of Humble serve
    try:
        reader = AnyReader([Path(path)], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except FileNotFoundError as error:
        raise EpisodeError(f"No such recording: {path}.") from error
    except Exception as error:  # damaged files fail in many ways inside
        raise EpisodeError(f"{path} is not a readable ROS recording ({type(error).__name__}: {error}).") from error
    return _Closing(reader)


class _Closing:
    """An already open reader as a context."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader

    def __enter__(self) -> Any:
        return self._reader

    def __exit__(self, *_: object) -> None:
        with suppress(Exception):
            self._reader.close()


def _depth_topics(path: Path, topics: dict[str, str]) -> dict[str, str]:
    """Camera -> depth topic; of several of one camera, the one aligned to colour."""
    found: dict[str, str] = {}
    for topic, kind in sorted(topics.items()):
        if kind not in (_IMAGE, _COMPRESSED) or "depth" not in topic.lower():
            continue
        name = _camera_name(topic)
        if name not in found or ("aligned" in topic and "aligned" not in found[name]):
            found[name] = topic
    if not found:
        raise EpisodeError(f"{path} has no depth image topic; its topics are {', '.join(sorted(topics)) or 'none'}.")
    return found


def _camera_name(topic: str) -> str:
    return topic.strip("/").split("/")[0]


def _info_topic(path: Path, depth_topic: str, topics: dict[str, str]) -> str:
    folder = depth_topic
    while "/" in folder:
        folder = folder.rsplit("/", 1)[0]
        if topics.get(f"{folder}/camera_info") == _INFO:
            return f"{folder}/camera_info"
    raise EpisodeError(f"{path} has no camera_info beside {depth_topic}; record it, the intrinsics are in it.")


def _color_topic(name: str, topics: dict[str, str]) -> str | None:
    candidates = [
        topic
        for topic, kind in sorted(topics.items())
        if kind in (_IMAGE, _COMPRESSED)
        and _camera_name(topic) == name
        and re.search("color|rgb", topic)
        and "depth" not in topic
    ]
    return candidates[0] if candidates else None


def _frames(
    path: Path, depth_topics: dict[str, str], color_topics: dict[str, str | None], cameras: dict[str, CameraInfo]
) -> Iterator[RecordedFrame]:
    """Depth images in order of the bag, each with the colour image of its time if that has come within a few messages."""
    names = {topic: name for name, topic in depth_topics.items()}
    names |= {topic: name for name, topic in color_topics.items() if topic is not None}
    waiting: dict[str, list[RecordedFrame]] = {name: [] for name in depth_topics}
    colors: dict[str, list[tuple[float, NDArray[np.uint8]]]] = {name: [] for name in depth_topics}
    with _opened(path) as reader:
        for connection, stamp, raw in reader.messages([held for held in reader.connections if held.topic in names]):
            name = names[connection.topic]
            message = reader.deserialize(raw, connection.msgtype)
            time_s = _time(message, stamp)
            if connection.topic == color_topics[name]:
                colors[name] = [*colors[name][-3:], (time_s, _color(message, connection.topic))]
            else:
                depth = _depth(message, connection.topic, cameras[name].depth_scale_m)
                waiting[name].append(RecordedFrame(name, time_s, depth))
            # colour may come before or after its depth: one more message of either is waited for
            while waiting[name] and (
                color_topics[name] is None
                or len(waiting[name]) > 1
                or _matching(waiting[name][0], colors[name]) is not None
            ):
                yield _paired(waiting[name].pop(0), colors[name])
    for name, left in waiting.items():
        for frame in left:
            yield _paired(frame, colors[name])


def _matching(frame: RecordedFrame, colors: list[tuple[float, NDArray[np.uint8]]]) -> NDArray[np.uint8] | None:
    near = [(abs(time_s - frame.time_s), color) for time_s, color in colors if color.shape[:2] == frame.depth.shape]
    best = min(near, key=lambda pair: pair[0], default=None)
    return best[1] if best is not None and best[0] < _PAIR_S else None


def _paired(frame: RecordedFrame, colors: list[tuple[float, NDArray[np.uint8]]]) -> RecordedFrame:
    return RecordedFrame(frame.camera, frame.time_s, frame.depth, _matching(frame, colors))


def _time(message: Any, stamp_ns: int) -> float:
    stamp = message.header.stamp
    seconds = float(stamp.sec + 1e-9 * stamp.nanosec)
    return seconds if seconds > 0 else 1e-9 * stamp_ns


def _depth(message: Any, topic: str, scale: float) -> NDArray[np.uint16]:
    if not hasattr(message, "encoding"):
        data = bytes(message.data)
        return decode_depth(data[_COMPRESSED_DEPTH_HEADER:] if "compressedDepth" in message.format else data, topic)
    if message.encoding in ("16UC1", "mono16"):
        return _pixels(message, np.dtype(np.uint16))[..., 0].astype(np.uint16)
    if message.encoding == "32FC1":
        metres = _pixels(message, np.dtype(np.float32))[..., 0]
        known = np.isfinite(metres) & (metres > 0)
        return np.where(known, np.rint(np.where(known, metres, 0) / scale), 0).clip(0, 65535).astype(np.uint16)
    raise EpisodeError(f"{topic} has the encoding {message.encoding!r}; depth is 16UC1, 32FC1 or compressedDepth.")


def _color(message: Any, topic: str) -> NDArray[np.uint8]:
    if not hasattr(message, "encoding"):
        return decode_color(bytes(message.data), topic)
    if message.encoding not in _COLOR_CHANNELS:
        raise EpisodeError(f"{topic} has the encoding {message.encoding!r}; colour is {', '.join(_COLOR_CHANNELS)}.")
    return np.ascontiguousarray(_pixels(message, np.dtype(np.uint8))[..., _COLOR_CHANNELS[message.encoding]])


def _pixels(message: Any, kind: np.dtype[Any]) -> NDArray[Any]:
    """[H, W, C] of an Image message; rows may be padded, bytes may be swapped."""
    kind = kind.newbyteorder(">" if message.is_bigendian else "<")
    data = np.frombuffer(bytes(message.data), np.uint8)
    if len(data) != message.height * message.step or message.step < message.width * kind.itemsize:
        raise EpisodeError(
            f"An image of {message.width} x {message.height} has {len(data)} bytes; the recording is damaged."
        )
    rows = data.reshape(message.height, message.step)
    channels = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}.get(message.encoding, 1)
    used = np.ascontiguousarray(rows[:, : message.width * channels * kind.itemsize])
    return used.view(kind).reshape(message.height, message.width, channels)


def _intrinsics(message: Any, name: str) -> Intrinsics:
    # ROS 1 writes D and K, ROS 2 d and k
    matrix = np.asarray(message.k if hasattr(message, "k") else message.K, dtype=np.float64).reshape(3, 3)
    lens = [float(value) for value in (message.d if hasattr(message, "d") else message.D)]
    if message.distortion_model not in ("", "plumb_bob") and any(lens):
        raise EpisodeError(f"Camera {name} has the distortion model {message.distortion_model!r}; plumb_bob is read.")
    distorted = any(lens)
    return Intrinsics(
        message.width,
        message.height,
        float(matrix[0, 0]),
        float(matrix[1, 1]),
        float(matrix[0, 2]),
        float(matrix[1, 2]),
        "brown_conrady" if distorted else "none",
        tuple((lens + [0.0] * 5)[:5]) if distorted else (),
    )


def _robot(
    path: Path,
    joints: list[Any],
    tree: _TransformTree,
    world_frame: str,
    tool_frame: str,
    joint_names: list[str] | None,
    gripper_joint: str,
    gripper_closed_rad: float,
) -> RobotLog | None:
    if not joints:
        return None
    seen = {name for _, message in joints for name in message.name}
    if joint_names is None:
        joint_names = sorted((name for name in seen if re.fullmatch(r"joint_\d+", name)), key=lambda name: int(name[6:]))
    missing = sorted(set(joint_names) - seen)
    if not joint_names or missing:
        raise EpisodeError(
            f"{path}: joint_states has {', '.join(sorted(seen))}; {missing or 'joint_1, ...'} not among them. Name the "
            "arm's joints in order with --joint."
        )
    rows = [(t, message) for t, message in joints if set(joint_names) <= set(message.name)]
    rows.sort(key=lambda row: row[0])
    times = np.array([t for t, _ in rows])
    keep = np.concatenate([[True], np.diff(times) > 0])
    named = [dict(zip(message.name, message.position, strict=False)) for _, message in rows]
    angles = np.array([[row[name] for name in joint_names] for row in named], dtype=np.float64)
    gripper = np.array([row.get(gripper_joint, np.nan) for row in named], dtype=np.float64) / gripper_closed_rad
    count = int(keep.sum())
    position, quaternion = np.full((count, 3), np.nan), np.full((count, 4), np.nan)
    poses = tree.lookup(world_frame, tool_frame, times[keep])
    if poses is not None:
        position = poses[:, :3, 3]
        quaternion = np.roll(Rotation.from_matrix(poses[:, :3, :3]).as_quat(), 1, axis=1)
    return RobotLog(times[keep], angles[keep], gripper[keep], position, quaternion, np.full((count, 6), np.nan))


class _TransformTree:
    """tf: each frame's place in its parent over time."""

    def __init__(self, transforms: list[tuple[float, Any]]) -> None:
        grouped: dict[str, list[tuple[float, Any]]] = {}
        for t, item in transforms:
            grouped.setdefault(item.child_frame_id.strip("/"), []).append((t, item))
        self._edges: dict[str, tuple[str, NDArray[np.float64], NDArray[np.float64]]] = {}
        for child, entries in grouped.items():
            entries.sort(key=lambda entry: entry[0])
            moves = [item.transform for _, item in entries]
            matrices = np.tile(np.eye(4), (len(moves), 1, 1))
            turns = [[move.rotation.x, move.rotation.y, move.rotation.z, move.rotation.w] for move in moves]
            matrices[:, :3, :3] = Rotation.from_quat(np.array(turns)).as_matrix()
            matrices[:, :3, 3] = [[move.translation.x, move.translation.y, move.translation.z] for move in moves]
            parent = entries[-1][1].header.frame_id.strip("/")
            self._edges[child] = (parent, np.array([t for t, _ in entries]), matrices)

    def lookup(self, target: str, source: str, times: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """[N, 4, 4] that maps points of `source` to `target` at times [N], each edge at its nearest stamp; None where tf
        does not lead from `source` up to `target`."""
        result = np.tile(np.eye(4), (len(times), 1, 1))
        frame, target, steps = source.strip("/"), target.strip("/"), 0
        while frame != target:
            if frame not in self._edges or steps > len(self._edges):
                return None
            parent, stamps, matrices = self._edges[frame]
            after = np.searchsorted(stamps, times).clip(0, len(stamps) - 1)
            before = (after - 1).clip(0)
            nearest = np.where(np.abs(stamps[before] - times) < np.abs(stamps[after] - times), before, after)
            result = matrices[nearest] @ result
            frame, steps = parent, steps + 1
        return result
