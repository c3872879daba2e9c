"""The tool's track in a recording of clouds, at the tool's own rate: from a topic of poses, tf, or joint states."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffcloud.errors import EpisodeError
from diffcloud.io.ros.joints import Grip, joint_log
from diffcloud.io.ros.pairing import sorted_stamps
from diffcloud.io.ros.publishers import JointMessage
from diffcloud.io.ros.transforms import TransformTree

Floats = NDArray[np.float64]

POSES = (
    *("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"),
    *("geometry_msgs/msg/TransformStamped", "nav_msgs/msg/Odometry"),
)
"""Types of messages that state the pose of one frame."""
TOOL_FRAME = "tool_frame"
"""Default frame of the tool in tf."""
_GAP_S = 0.2
"""A tool that accelerates by 1 m/s² leaves a straight line by 5 mm in this time."""


@dataclass(frozen=True)
class StampedPose:
    """Pose in a message of a type in `POSES`."""

    frame: str
    child: str
    """Frame whose pose is stated. Empty if the message does not name it."""
    values: tuple[float, ...]
    """Position x, y, z [m] and quaternion x, y, z, w, in `frame`."""


@dataclass(frozen=True)
class ToolTrack:
    """Poses of the tool over time."""

    name: str
    """Source of the poses, for messages."""
    times: Floats
    """[K] increasing times [s]."""
    poses: Floats
    """[K, 4, 4] poses in the robot's base frame [m]."""

    def positions(self, times: Floats) -> Floats:
        """Return positions [T, 3] [m], interpolated linearly between poses."""
        return np.stack([np.interp(times, self.times, column) for column in self.poses[:, :3, 3].T], axis=1)

    def gap(self, times: Floats) -> str | None:
        """Return a warning if poses around one of the times [T] are far apart, else None. Times are inside the track."""
        before, after = np.searchsorted(self.times, times, "right") - 1, np.searchsorted(self.times, times)
        gaps = self.times[after] - self.times[before]
        if gaps.max(initial=0) <= _GAP_S:
            return None
        return (
            f"{int((gaps > _GAP_S).sum())} of {len(times)} clouds lie in gaps of the tool's poses ({self.name}), of up to "
            f"{gaps.max():.2f} s. The tool's positions there are interpolated on a straight line."
        )


def stamped_pose(message: Any) -> StampedPose:
    """Return the pose in a message of a type in `POSES`."""
    if hasattr(message, "transform"):
        place, turn = message.transform.translation, message.transform.rotation
    else:
        pose = getattr(message.pose, "pose", message.pose)
        place, turn = pose.position, pose.orientation
    child = getattr(message, "child_frame_id", "")
    return StampedPose(message.header.frame_id, child, (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w))


def poses_in_base(name: str, tree: TransformTree, base: str, frame: str, times: Floats) -> Floats:
    """Return transforms [T, 4, 4] from a frame to the robot's base frame, at times [T] [s].

    Args:
        name: data that are stated in the frame, for messages.

    Raises:
        EpisodeError: tf does not connect the two frames. The message names them.
    """
    try:
        return tree.lookup(base, frame, times)
    except EpisodeError as error:
        raise EpisodeError(
            f"{name}: {error}. Clouds and tool are needed in the robot's base frame. Record /tf and /tf_static too, or "
            "name the base by --world-frame of `diffcloud data import`."
        ) from error


def tool_source(
    where: str,
    poses: Mapping[str, Sequence[StampedPose]],
    tree: TransformTree,
    tool_frame: str | None,
    *,
    named: Sequence[str],
    tf: Collection[str],
) -> str | None:
    """Return the source of the tool's poses: a topic of `poses`, the tool's frame in tf, or None without either.

    Args:
        where: name of the recording, for messages.
        poses: messages of each topic.
        tool_frame: frame of the tool in tf, if the user named it.
        named: topics that the user named.
        tf: topics of transforms.

    Raises:
        EpisodeError: there are several candidates, and the user did not name exactly one. The message lists them.
    """
    asked = [topic for topic in poses if topic in named]
    default = [TOOL_FRAME] if TOOL_FRAME in tree.frames else []
    if asked or tool_frame is not None:
        found = [*asked, *([] if tool_frame is None else [tool_frame])]
    elif default and set(tf) & set(named):
        found = default
    else:
        found = [*poses, *default]
    if len(found) > 1:
        listed = ", ".join(name if name in poses else f"the frame {name!r} in tf" for name in sorted(found))
        by_tf = " ".join(f"--topic {topic}" for topic in sorted(tf))
        raise EpisodeError(
            f"{where} has several candidates for the tool's pose: {listed}. One is taken. Name it by --topic, such as "
            f"`--topic {min(set(found) & set(poses))}`" + (f", or `{by_tf}` for tf." if default else ".")
        )
    return found[0] if found else None


def pose_track(
    topic: str, poses: Sequence[StampedPose], stamps: Floats, tree: TransformTree, base: str
) -> tuple[ToolTrack, list[str]]:
    """Return the track of one topic, and warnings about omitted messages.

    Args:
        stamps: [N] times of the poses, in order of arrival [s].

    Raises:
        EpisodeError: the clock was set back, the poses are of several frames, no pose is finite, or tf does not
            connect the frame with the base.
    """
    kinds = sorted({(held.frame.strip("/"), held.child) for held in poses})
    if len(kinds) > 1:
        shown = ", ".join(f"{child or 'a pose'} in {frame!r}" for frame, child in kinds)
        raise EpisodeError(f"{topic} has poses of several frames: {shown}. Record the tool on a topic of its own.")
    order, _ = sorted_stamps(topic, stamps)
    values = np.array([poses[number].values for number in order])
    sound = np.isfinite(values).all(axis=1)
    if not sound.any():
        raise EpisodeError(f"{topic} has no finite pose. A pose is a position in metres and a quaternion. Record it again.")
    warnings = (
        [] if sound.all() else [f"{topic}: {int((~sound).sum())} of {len(sound)} poses are not finite, and left out."]
    )
    values, times = values[sound], stamps[order][sound]
    matrices = np.tile(np.eye(4), (len(values), 1, 1))
    turned = np.linalg.norm(values[:, 3:], axis=1) > 1e-3  # some senders fill in the position alone
    matrices[turned, :3, :3] = Rotation.from_quat(values[turned, 3:]).as_matrix()
    matrices[:, :3, 3] = values[:, :3]
    return ToolTrack(topic, times, poses_in_base(topic, tree, base, kinds[0][0], times) @ matrices), warnings


def tf_track(frame: str, tree: TransformTree, base: str, span: Floats) -> ToolTrack:
    """Return the track of a frame in tf, at the stamps of the transforms that move it.

    Args:
        span: [2] first and last time of the clouds [s], used if the tool does not move.

    Raises:
        EpisodeError: tf does not connect the frame with the base, or its transforms share no span of time.
    """
    name = f"the frame {frame!r} in tf"
    poses_in_base(name, tree, base, frame, span)
    moving = tree.moving_stamps(base, frame)
    times = np.unique(np.concatenate(moving or [span]))
    if moving:
        first, last = max(stamps[0] for stamps in moving), min(stamps[-1] for stamps in moving)
        times = times[(times >= first) & (times <= last)]
        if not len(times):
            raise EpisodeError(
                f"The transforms between {frame!r} and {base!r} share no span of time. Transforms that move the tool must "
                "cover the motion. Record /tf during the whole motion."
            )
    return ToolTrack(name, times, tree.lookup(base, frame, times))


def joint_track(
    where: str,
    sent: Sequence[JointMessage],
    tree: TransformTree,
    base: str,
    joint_names: Sequence[str] | None,
    named: Sequence[str],
    tool_pose: Callable[[Floats], Floats],
) -> tuple[ToolTrack, list[str]]:
    """Return the track that follows from joint states, and warnings.

    Args:
        joint_names, named: see `joint_log`.
        tool_pose: joint angles [K, J] -> poses of the tool [K, 4, 4] in the robot's base frame.

    Raises:
        EpisodeError: see `joint_log`.
    """
    log, _ = joint_log(
        where,
        sent,
        tree,
        world_frame=base,
        tool_frame=TOOL_FRAME,
        joint_names=joint_names,
        grip=Grip.of(None, 0, 1),
        named=named,
    )
    why = (
        "The tool's poses are computed from joint states, as neither tf nor a topic of poses states them. The robot's "
        "description must be that of this arm (--urdf of `diffcloud data import`)."
    )
    return ToolTrack("joint states", log.times, tool_pose(log.joints_rad)), [why]
