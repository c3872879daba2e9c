"""Read ROS recordings (rosbag1 files, rosbag2 folders and files, MCAP) without a ROS installation.

A recording is read twice. The first pass reads everything except the pixels: topics, stamps, intrinsics, tf and joints.
So errors in these are found before anything is written. The second pass reads the images.

Colour is imported only if its pixels are aligned with depth. Unaligned colour could be reprojected with the extrinsics,
but occlusions and depth holes would give wrong colours. So it is omitted, with a warning.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.raw_episodes import CameraInfo, RobotLog
from diffcloud.io.recordings import EPOCH_S, RecordedFrame, Recording
from diffcloud.io.ros.clocks import message_times
from diffcloud.io.ros.files import opened, refuse_lone_parts
from diffcloud.io.ros.joints import GRIPPER_JOINT, Grip, joint_log, log_from_links
from diffcloud.io.ros.messages import (
    DEPTH_UNITS_M,
    MOST_POINTS,
    DepthEncoding,
    camera_intrinsics,
    cloud_points,
    color_image,
    depth_encoding,
    depth_image,
    is_calibrated,
    stamp_s,
)
from diffcloud.io.ros.pairing import Pairing, pair
from diffcloud.io.ros.publishers import JointMessage
from diffcloud.io.ros.tool import POSES, StampedPose, stamped_pose
from diffcloud.io.ros.topics import (
    CAMERA_INFO,
    POINT_CLOUD,
    CameraTopics,
    aligned_by_name,
    cloud_cameras,
    depth_cameras,
    info_topic,
    is_rectified,
    only_named,
    refuse_unknown,
    same_camera,
)
from diffcloud.io.ros.transforms import TransformTree, refuse_conflicts
from diffcloud.io.urdf import RobotDescription

_JOINTS = "sensor_msgs/msg/JointState"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


def ros_recording(
    *paths: Path,
    world_frame: str = "base_link",
    tool_frame: str = "tool_frame",
    joint_names: list[str] | None = None,
    gripper_joint: str | None = GRIPPER_JOINT,
    gripper_open: float = 0.0,
    gripper_closed: float | None = None,
    description: Callable[[], RobotDescription] | None = None,
    topics: Sequence[str] = (),
) -> Recording:
    """Open a ROS recording. Its images are read lazily.

    Args:
        paths: one file or rosbag2 folder, or all parts of a split recording.
        world_frame, tool_frame: tf frames. If tf lacks a pose, it stays unknown, with a warning.
        joint_names: joints of the arm in order. None: joint_1, joint_2, ... of joint_states.
        gripper_joint: joint that gives the gripper state, 0 (open) to 1 (closed). None: the arm has no gripper.
        gripper_open: position of this joint if the gripper is open [rad or m].
        gripper_closed: position if it is closed. None: that of a Robotiq 2F-85.
        description: function that returns the robot description. It is needed for a joint log if the recording has no
            joint_states, but the link frames in tf.
        topics: topics to use where there are several candidates of one kind (depth, colour, camera_info, joint states,
            transforms). TOPIC#NUMBER selects one of several publishers of joint states.

    Raises:
        ConfigError: open and closed position of the gripper are equal or not finite.
        EpisodeError: the recording is not readable, or not all parts are given. Also if depth, camera_info, or a
            requested joint or topic is missing, stamps run backwards, or several candidates exist and none is selected.
    """
    grip = Grip.of(gripper_joint, gripper_open, gripper_closed)
    split = refuse_lone_parts(paths)
    shown = ", ".join(path.name for path in map(Path, paths))
    scan = first_pass(paths, shown, topics)
    tree = TransformTree(scan.transforms)
    cameras: dict[str, CameraInfo] = {}
    sources: dict[str, _Source] = {}
    warnings = [*split, *scan.warnings, *tree.warnings]
    if clouds := sorted(topic for topic, kind in scan.topics.items() if kind == POINT_CLOUD):
        warnings.append(
            f"The depth images were taken, and the clouds on {', '.join(clouds)} were not. If the clouds show only the "
            f"cloth, take them by `--topic {clouds[0]}`."
        )
    for name, own in scan.cameras.items():
        info, depth = scan.infos.get(own.info), scan.images.get(own.depth)
        if info is None or depth is None:
            raise EpisodeError(f"{shown}: camera {name} has no message on {own.info} or {own.depth}.")
        color, why_not = _aligned_color(scan, own)
        warnings += why_not
        pairing = pair(name, own.depth, depth.stamps, None if color is None else scan.images[color].stamps)
        warnings += pairing.warnings
        assert depth.encoding is not None  # true for all depth topics
        sources[name] = _Source(own.depth, color, depth.encoding, pairing)
        place = None
        try:
            place = tree.fixed(world_frame, info.header.frame_id or depth.frame)
        except EpisodeError as error:
            warnings.append(
                f"Camera {name}: its place stays open, as {error}. Name the robot's base with --world-frame, or calibrate."
            )
        intrinsics = camera_intrinsics(info, name, own.info, rectified=is_rectified(own.depth))
        cameras[name] = CameraInfo(name, f"ros{own.depth}", intrinsics, DEPTH_UNITS_M[depth.encoding], place)
    robot = None
    if scan.joints:
        robot, unknown = joint_log(
            shown,
            scan.joints,
            tree,
            world_frame=world_frame,
            tool_frame=tool_frame,
            joint_names=joint_names,
            grip=grip,
            named=topics,
        )
        warnings += unknown
        _refuse_other_clock(shown, robot, sources)
    elif description is not None and scan.transforms:
        try:
            robot, unknown = log_from_links(
                tree,
                description(),
                world_frame=world_frame,
                tool_frame=tool_frame,
                grip=grip,
            )
            warnings += unknown
        except EpisodeError as error:
            warnings.append(f"There are no joint_states, and tf does not give the joints either: {error}.")
    return Recording(cameras, _frames(paths, sources), f"ros recording {shown}", robot, tuple(warnings))


@dataclass
class _Images:
    """Data of an image topic from the first pass."""

    frame: str
    """tf frame of the first message."""
    size: tuple[int, int] | None
    """(width, height) of the first colour image. None for depth, whose size is in camera_info."""
    encoding: DepthEncoding | None
    """Encoding of the first depth image. None for colour."""
    stamps: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    """[N] stamps in order of arrival [s]."""
    clouds: list[NDArray[np.floating[Any]]] = field(default_factory=list)
    """Points [N, 3] of each message in the topic's frame [m]. Empty for images."""


@dataclass
class Scan:
    """Result of the first pass: everything except the pixels."""

    topics: Mapping[str, str]
    cameras: Mapping[str, CameraTopics]
    surfaces: Mapping[str, str]
    """Topic of clouds of each camera; empty where depth images are read."""
    infos: dict[str, Any] = field(default_factory=dict)
    images: dict[str, _Images] = field(default_factory=dict)
    joints: list[JointMessage] = field(default_factory=list)
    transforms: list[tuple[float, Any]] = field(default_factory=list)
    poses: dict[str, list[StampedPose]] = field(default_factory=dict)
    """By topic, in order of arrival; only where clouds are read."""
    times: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    """Of the messages of each topic, in order of arrival [s]."""
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Source:
    """Image topics of a camera and the pairing of their messages."""

    depth: str
    color: str | None
    encoding: DepthEncoding
    pairing: Pairing


def first_pass(paths: Sequence[Path], shown: str, named: Sequence[str], *, clouds: bool = False) -> Scan:
    """Read everything but the pixels.

    Args:
        shown: the recording, for messages.
        named: topics that the user named.
        clouds: read clouds and poses in place of depth images.

    Raises:
        EpisodeError: an unreadable recording, a damaged message, or topics as of `ros_recording`.
    """
    stamps: dict[str, list[tuple[float, float]]] = {}
    joints: list[tuple[str, str, int, Any]] = []
    transforms: list[tuple[str, int, Any]] = []
    points = 0
    with opened(paths) as reader:
        topics = {held.topic: held.msgtype for held in reader.connections}
        refuse_unknown(topics, named, shown)
        scan = Scan(
            topics,
            {} if clouds else depth_cameras(topics, shown, named),
            cloud_cameras(topics, shown, named) if clouds else {},
        )
        depths = {camera.depth for camera in scan.cameras.values()}
        surfaces, poses = set(scan.surfaces.values()), only_named(topics, named, POSES if clouds else ())
        images = depths | surfaces | {topic for camera in scan.cameras.values() for topic in camera.colors}
        others = only_named(topics, named, (_JOINTS,)) | only_named(topics, named, TF)
        wanted = [
            held for held in reader.connections if held.topic in images | poses | others or held.msgtype == CAMERA_INFO
        ]
        senders = _senders(wanted)
        for connection, arrival, raw in reader.messages(wanted):
            topic, kind = connection.topic, connection.msgtype
            message = reader.deserialize(raw, kind)
            if kind == CAMERA_INFO:
                if not is_calibrated(scan.infos.setdefault(topic, message)):
                    scan.infos[topic] = message  # keep the latest message until one is calibrated
                continue
            own = stamps.setdefault(topic, [])
            if kind in TF:
                for item in message.transforms:
                    transforms.append((topic, len(own), item))
                    own.append((stamp_s(item), 1e-9 * arrival))
                continue
            if kind == _JOINTS:
                joints.append((topic, senders[connection.id, connection.topic, id(connection.owner)], len(own), message))
            elif topic in poses:
                scan.poses.setdefault(topic, []).append(stamped_pose(message))
            elif topic not in scan.images:
                scan.images[topic] = _first_image(message, topic, is_depth=topic in depths)
            elif message.header.frame_id != scan.images[topic].frame:
                raise EpisodeError(
                    f"{shown}: {topic} has {'clouds' if clouds else 'images'} of two cameras, in the frames "
                    f"{scan.images[topic].frame!r} and {message.header.frame_id!r}. Record each camera on a topic of its "
                    "own."
                )
            if topic in surfaces:
                cloud = cloud_points(message, topic)
                scan.images[topic].clouds.append(cloud)
                points += len(cloud)
                if points > MOST_POINTS:
                    raise EpisodeError(
                        f"{shown} has more than {MOST_POINTS:,} points in its clouds. Record smaller clouds, or cut the "
                        "recording."
                    )
            own.append((stamp_s(message), 1e-9 * arrival))
    if silent := sorted((surfaces | (poses & set(named))) - stamps.keys()):
        raise EpisodeError(f"{shown} has no message on {silent[0]}. Name another topic, or record this one again.")
    refuse_conflicts([(topic, item) for topic, _, item in transforms], shown)
    static = {topic for topic in stamps if topic.endswith("tf_static")}
    times, warnings = message_times({topic: held for topic, held in stamps.items() if topic not in static})
    times |= {topic: np.array([stamp for stamp, _ in stamps[topic]]) for topic in static}  # valid at all times
    scan.warnings += warnings
    scan.times = times
    for topic, held in scan.images.items():
        held.stamps = times[topic]
    scan.joints += [JointMessage(float(times[topic][row]), topic, sender, item) for topic, sender, row, item in joints]
    scan.transforms += [(float(times[topic][row]), item) for topic, row, item in transforms]
    return scan


def _senders(connections: Sequence[Any]) -> dict[tuple[int, str, int], str]:
    """Connection -> sender: the node name in ROS 1, otherwise the connection's number for its topic and file."""
    senders: dict[tuple[int, str, int], str] = {}
    counts = Counter[tuple[str, int]]()
    for held in connections:
        place = (held.topic, id(held.owner))
        counts[place] += 1
        senders[held.id, *place] = getattr(held.ext, "callerid", None) or str(counts[place])
    return senders


def _refuse_other_clock(shown: str, robot: RobotLog, sources: Mapping[str, _Source]) -> None:
    """Check that joint states and images have the same kind of clock.

    Raises:
        EpisodeError: one is stamped since 1970 and the other in simulated time.
    """
    images = next(iter(sources.values())).pairing.times
    if (robot.times[0] < EPOCH_S) != (images[0] < EPOCH_S):
        raise EpisodeError(
            f"{shown}: joint states are stamped {robot.times[0]:.2f} to {robot.times[-1]:.2f} s, depth images "
            f"{images[0]:.2f} to {images[-1]:.2f} s: one is simulated time, the other time since 1970. Record with "
            "use_sim_time set alike for all nodes."
        )


def _first_image(message: Any, topic: str, *, is_depth: bool) -> _Images:
    if hasattr(message, "point_step"):
        return _Images(message.header.frame_id, None, None)
    if is_depth:
        return _Images(message.header.frame_id, None, depth_encoding(message, topic))
    height, width = color_image(message, topic).shape[:2]
    return _Images(message.header.frame_id, (width, height), None)


def _aligned_color(scan: Scan, camera: CameraTopics) -> tuple[str | None, list[str]]:
    """Return the camera's colour topic that is aligned with depth (or None), and warnings if colour is not aligned."""
    why_not = {}
    for topic in camera.colors:
        if topic not in scan.images:
            continue  # the topic exists but has no message
        reason = _unaligned(scan, camera, topic)
        if reason is None:
            return topic, []
        why_not[topic] = reason
    if not why_not:
        return None, []
    return None, [
        f"Camera {camera.name}: colour is left out, as it is not aligned to {camera.depth}: "
        + "; ".join(f"{topic} {reason}" for topic, reason in why_not.items())
        + ". Record depth aligned to colour (with realsense2_camera align_depth.enable:=true), or play the recording "
        "through depth_image_proc's register node."
    ]


def _unaligned(scan: Scan, camera: CameraTopics, color: str) -> str | None:
    """Explain why a colour image is not aligned with depth, or return None if it is."""
    images, depth_info = scan.images[color], scan.infos[camera.info]
    size = (depth_info.width, depth_info.height)
    if images.size != size:
        assert images.size is not None  # true for all colour topics
        return f"has {images.size[0]} x {images.size[1]} pixels, depth {size[0]} x {size[1]}"
    if aligned_by_name(camera.depth) and same_camera(camera.depth, color):
        return None
    frames = [scan.images[topic].frame.strip("/") for topic in (color, camera.depth)]
    if frames[0] != frames[1]:
        return f"is seen from the tf frame {frames[0]!r}, depth from {frames[1]!r}"
    info = info_topic(color, scan.topics) or ""
    held = scan.infos.get(info)
    if held is None:
        return "has no camera_info that would show that it shares depth's intrinsics"
    depth = camera_intrinsics(depth_info, camera.name, camera.info, rectified=is_rectified(camera.depth))
    try:
        own = camera_intrinsics(held, color, info, rectified=is_rectified(color))
    except EpisodeError as error:
        return f"has intrinsics that cannot be compared ({error})"
    return None if _equal(own, depth) else f"has {_brief(own)}, depth {_brief(depth)}"


def _brief(held: Intrinsics) -> str:
    return f"f {held.fx:.1f}, c ({held.cx:.1f}, {held.cy:.1f})"


def _equal(first: Intrinsics, second: Intrinsics) -> bool:
    """Whether two cameras have equal intrinsics, except for rounding."""
    one, other = (
        [held.width, held.height, held.fx, held.fy, held.cx, held.cy, *(*held.coefficients, *[0.0] * 14)[:14]]
        for held in (first, second)
    )
    if "equidistant" in (first.distortion, second.distortion) and first.distortion != second.distortion:
        return False
    return bool(np.allclose(one, other, rtol=1e-4, atol=1e-4))


def _frames(paths: Sequence[Path], sources: Mapping[str, _Source]) -> Iterator[RecordedFrame]:
    """Yield the frames of all cameras, for each camera in order of time, with their colour images."""
    cameras = {name: _Assembly(name, source) for name, source in sources.items()}
    by_topic: dict[str, _Assembly] = {}
    for name, source in sources.items():
        by_topic |= {topic: cameras[name] for topic in (source.depth, source.color) if topic is not None}
    with opened(paths) as reader:
        for connection, _, raw in reader.messages([held for held in reader.connections if held.topic in by_topic]):
            camera = by_topic[connection.topic]
            camera.take(connection.topic, reader.deserialize(raw, connection.msgtype))
            yield from camera.finished()


class _Assembly:
    """Assembles the frames of one camera. It keeps images only until their frame has been yielded."""

    def __init__(self, name: str, source: _Source) -> None:
        self._name, self._source = name, source
        self._rank = {int(number): rank for rank, number in enumerate(source.pairing.depths)}
        self._uses = {
            int(number): int(count)
            for number, count in zip(*np.unique(source.pairing.colors, return_counts=True), strict=True)
        }
        self._seen = {"depth": 0, "color": 0}
        self._depths: dict[int, NDArray[np.uint16]] = {}
        self._colors: dict[int, NDArray[np.uint8]] = {}
        self._next = 0

    def take(self, topic: str, message: Any) -> None:
        """Add the next message of the depth or colour topic."""
        kind = "depth" if topic == self._source.depth else "color"
        number = self._seen[kind]
        self._seen[kind] += 1
        if kind == "depth" and number in self._rank:
            self._depths[self._rank[number]] = depth_image(message, topic, self._source.encoding)
        elif kind == "color" and number in self._uses:
            self._colors[number] = color_image(message, topic)

    def finished(self) -> Iterator[RecordedFrame]:
        """Yield complete frames whose predecessors have been yielded."""
        pairing = self._source.pairing
        while self._next in self._depths:
            number = int(pairing.colors[self._next])
            if number >= 0 and number not in self._colors:
                return
            color = None
            if number >= 0:
                color = self._colors[number]
                self._uses[number] -= 1
                if not self._uses[number]:
                    del self._colors[number]
            yield RecordedFrame(self._name, float(pairing.times[self._next]), self._depths.pop(self._next), color)
            self._next += 1
