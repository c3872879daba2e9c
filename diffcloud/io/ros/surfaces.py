"""ROS recordings of point clouds (PointCloud2) as episodes: clouds in the robot's base frame, and the tool's track."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffcloud.errors import EpisodeError
from diffcloud.io.episodes import Episode
from diffcloud.io.ros.files import opened, refuse_lone_parts
from diffcloud.io.ros.pairing import nearest, sorted_stamps
from diffcloud.io.ros.recording import TF, Scan, first_pass
from diffcloud.io.ros.tool import TOOL_FRAME, ToolTrack, joint_track, pose_track, poses_in_base, tf_track, tool_source
from diffcloud.io.ros.topics import holds_clouds, only_named
from diffcloud.io.ros.transforms import TransformTree

Floats = NDArray[np.float64]

_BASE = "base_link"
_OPTICAL = "optical"
"""Part of the name of a camera's own frame (REP 103), whose origin is where the camera stands."""
_LATEST_POSE_S = 0.05
"""Beyond its transforms, a camera that moves has no pose."""
_SAME_CLOCK_S = 1e-3
"""Cameras whose stamps differ by less are synchronised."""


@dataclass(frozen=True)
class CloudRecording:
    """A recording of clouds."""

    episode: Episode
    tool_quaternions: Floats
    """[K, 4] orientations of the tool in the base frame (w, x, y, z), at its own rate; empty without a tool."""
    summary: str
    """Which frames and topics were taken."""
    warnings: tuple[str, ...]
    """What was left out or guessed, for the person who imports."""


@dataclass(frozen=True)
class _Clouds:
    """The clouds of one camera in order of time."""

    topic: str
    frame: str
    times: Floats
    """[T] [s]."""
    points: Sequence[NDArray[np.floating[Any]]]
    """[T] of [N, 3] in `frame` [m]."""
    poses: Floats
    """[T, 4, 4] that map `frame` to the base frame."""

    def placed(self, row: int) -> NDArray[np.float32]:
        """[N, 3] points of one cloud in the base frame [m]."""
        pose = self.poses[row]
        return (self.points[row] @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)


def is_cloud_recording(paths: Sequence[Path], named: Collection[str] = ()) -> bool:
    """Whether a ROS recording is read by its clouds: one of them is named, or it has no depth images.

    Raises:
        EpisodeError: an unreadable recording, or both clouds and depth images are named.
    """
    with opened(paths) as reader:
        topics = {held.topic: held.msgtype for held in reader.connections}
    return holds_clouds(topics, named, ", ".join(path.name for path in map(Path, paths)))


def ros_clouds(
    *paths: Path,
    world_frame: str | None = None,
    tool_frame: str | None = None,
    joint_names: Sequence[str] | None = None,
    topics: Sequence[str] = (),
    tool_pose: Callable[[Floats], Floats] | None = None,
    meta: Mapping[str, Any] | None = None,
) -> CloudRecording:
    """A recording of clouds as an episode in the robot's base frame, in metres.

    The tool's position at each cloud is linear between the tool's poses around it. Of several cameras, the clouds nearest
    in time make a frame, in which each point names its camera.

    Args:
        paths: one file or rosbag2 folder, or all parts of a split recording.
        world_frame: the robot's base in tf. None takes base_link. A recording without base_link is taken in the frame from
            which both clouds and tool descend.
        tool_frame: the tool in tf; None takes tool_frame, or a topic of poses.
        joint_names: of the arm, in order; None takes joint_1, joint_2, ... of joint_states.
        topics: those to take where several could be: of clouds, poses, joint states or transforms.
        tool_pose: joint angles [K, J] -> poses of the tool [K, 4, 4] in the base frame, for a recording without poses of
            the tool. None: such a recording gets no track.
        meta: facts for the episode.

    Raises:
        EpisodeError: unreadable, a damaged cloud, clouds of several topics or poses of several tools of which none is
            named, frames that tf does not connect, or no cloud with points while the tool's poses are known.
    """
    warnings = list(refuse_lone_parts(paths))
    shown = ", ".join(path.name for path in map(Path, paths))
    scan = first_pass(paths, shown, topics, clouds=True)
    tree = TransformTree(scan.transforms)
    warnings += [*scan.warnings, *tree.warnings]
    source = tool_source(shown, scan.poses, tree, tool_frame, named=topics, tf=only_named(scan.topics, topics, TF))
    frames = [held.frame for held in scan.images.values()]
    if source is not None:
        frames.append(scan.poses[source][0].frame if source in scan.poses else source)
    base = world_frame or _base(frames, tree, has_tool=source is not None)
    cameras = {name: _clouds(shown, scan, topic, tree, base, warnings) for name, topic in scan.surfaces.items()}
    times, rows = _frames(shown, cameras, warnings)
    track = _track(shown, scan, source, tree, base, times, joint_names, topics, tool_pose, warnings)
    if track is not None:
        inside = _covered(shown, track, times, warnings)
        times, rows = times[inside], {name: own[inside] for name, own in rows.items()}
    seen = all(_OPTICAL in held.frame and not tree.moving_stamps(base, held.frame) for held in cameras.values())
    places = {name: held.poses[0, :3, 3].tolist() for name, held in cameras.items()} if seen else {}
    told = {"source": f"ros recording {shown}", **({"viewpoints": places} if places else {}), **(meta or {})}
    episode = Episode.from_frames(
        [np.concatenate([cameras[name].placed(row[frame]) for name, row in rows.items()]) for frame in range(len(times))],
        times - times[0],
        gripper=None if track is None else track.positions(times)[:, None],
        meta=told,
    )
    if len(cameras) > 1:
        episode = _with_cameras(episode, cameras, times, rows)
    summary = (
        f"Clouds: {', '.join(held.topic for held in cameras.values())}. Base: {base}. Tool: "
        f"{'unknown' if track is None else track.name}. "
        + (
            f"Camera positions: from tf, as {_OPTICAL} frames are the cameras' own."
            if places
            else "Camera positions: unknown."
        )
    )
    turns = np.empty((0, 4))
    if track is not None:
        turns = Rotation.from_matrix(track.poses[:, :3, :3]).as_quat(scalar_first=True)
    return CloudRecording(episode, turns, summary, tuple(warnings))


def _base(frames: Sequence[str], tree: TransformTree, *, has_tool: bool) -> str:
    """The robot's base frame where nobody names it: base_link, or else where all these frames descend from."""
    plain = [frame.strip("/") for frame in frames]
    roots = {tree.root(frame) for frame in plain}
    if _BASE in tree.frames | set(plain) or not has_tool or len(roots) > 1:
        return _BASE
    return roots.pop()


def _clouds(shown: str, scan: Scan, topic: str, tree: TransformTree, base: str, warnings: list[str]) -> _Clouds:
    """The clouds of a topic that have points and a pose.

    Args:
        warnings: those about clouds that are left out are added.

    Raises:
        EpisodeError: no cloud is left, a clock that was set back, or tf does not connect their frame with the base.
    """
    held = scan.images[topic]
    order, late = sorted_stamps(topic, held.stamps)
    if late:
        warnings.append(f"{topic}: {late} of {len(held.stamps)} clouds arrived out of order, and were sorted.")
    if len(order) < len(held.stamps):
        warnings.append(f"{topic}: {len(held.stamps) - len(order)} clouds have the stamp of another, and were left out.")
    empty = np.array([len(held.clouds[number]) == 0 for number in order])
    _leave_out(empty, f"{shown}: no finite point on {topic}", "Record the topic again", warnings)
    order = order[~empty]
    times = held.stamps[order]
    poses = poses_in_base(topic, tree, base, held.frame, times)
    known = np.full(len(times), True)
    for stamps in tree.moving_stamps(base, held.frame):
        known &= (times >= stamps[0] - _LATEST_POSE_S) & (times <= stamps[-1] + _LATEST_POSE_S)
    why = f"{topic}: tf moves {held.frame!r} in {base!r}, and has no transform at their times"
    _leave_out(~known, why, "Record /tf during the whole motion", warnings)
    return _Clouds(topic, held.frame, times[known], [held.clouds[number] for number in order[known]], poses[known])


def _frames(shown: str, cameras: Mapping[str, _Clouds], warnings: list[str]) -> tuple[Floats, dict[str, NDArray[np.int64]]]:
    """(times [T] of the camera with the fewest clouds, camera -> [T] its clouds nearest to them).

    Raises:
        EpisodeError: no time at which all cameras have a cloud.
    """
    first = min(cameras.values(), key=lambda held: len(held.times))
    rows = {name: nearest(first.times, held.times)[0] for name, held in cameras.items()}
    whole = np.all([own >= 0 for own in rows.values()], axis=0)
    why = f"{shown}: another camera than {first.topic} has no cloud within half a frame interval"
    _leave_out(~whole, why, "Record all cameras at once, with one clock", warnings)
    return first.times[whole], {name: own[whole] for name, own in rows.items()}


def _track(
    shown: str,
    scan: Scan,
    source: str | None,
    tree: TransformTree,
    base: str,
    times: Floats,
    joint_names: Sequence[str] | None,
    named: Sequence[str],
    tool_pose: Callable[[Floats], Floats] | None,
    warnings: list[str],
) -> ToolTrack | None:
    """The tool's track; None, with a warning, where nothing states it."""
    if source in scan.poses:
        track, more = pose_track(source, scan.poses[source], scan.times[source], tree, base)
        warnings += more
        return track
    if source is not None:
        return tf_track(source, tree, base, times[[0, -1]])
    why = "there are no joint states"
    if scan.joints and tool_pose is not None:
        try:
            track, more = joint_track(shown, scan.joints, tree, base, joint_names, named, tool_pose)
            warnings += more
            return track
        except EpisodeError as error:
            if joint_names is not None:
                raise
            why = str(error).rstrip(".")
    warnings.append(
        f"The tool's pose is unknown: there is no topic of poses, no frame {TOOL_FRAME!r} in tf, and {why}. Name the "
        "tool's frame by --tool-frame of `diffcloud data import`."
    )
    return None


def _covered(shown: str, track: ToolTrack, times: Floats, warnings: list[str]) -> NDArray[np.bool_]:
    """[T] which times lie between the first and the last pose of the tool.

    Raises:
        EpisodeError: none does.
    """
    inside = (times >= track.times[0]) & (times <= track.times[-1])
    why = (
        f"{shown}: the clouds are from {times[0]:.2f} to {times[-1]:.2f} s, the tool's poses ({track.name}) from "
        f"{track.times[0]:.2f} to {track.times[-1]:.2f} s"
    )
    _leave_out(~inside, why, "Record both at the same time, with one clock", warnings)
    warnings += [] if (gap := track.gap(times[inside])) is None else [gap]
    return np.asarray(inside)


def _with_cameras(
    episode: Episode, cameras: Mapping[str, _Clouds], times: Floats, rows: Mapping[str, NDArray[np.int64]]
) -> Episode:
    """The episode with the camera of each point, and the offsets of cameras that are not synchronised."""
    counts = [[len(cameras[name].points[own[frame]]) for name, own in rows.items()] for frame in range(len(times))]
    numbers = np.tile(np.arange(len(cameras), dtype=np.uint8), len(times))
    meta = {**episode.meta, "cameras": list(cameras)}
    offsets = {name: float(np.median(cameras[name].times[own] - times)) for name, own in rows.items()}
    if max(map(abs, offsets.values())) > _SAME_CLOCK_S:
        meta["clocks"] = {name: {"offset_s": offset, "sigma_s": 0.0} for name, offset in offsets.items()}
    return replace(episode, camera=np.repeat(numbers, np.ravel(counts)), meta=meta)


def _leave_out(lost: NDArray[np.bool_], why: str, advice: str, warnings: list[str]) -> None:
    """Add a warning that some clouds [T] are left out.

    Raises:
        EpisodeError: all of them are.
    """
    if lost.all():
        raise EpisodeError(f"No cloud can be used: {why}. {advice}.")
    if lost.any():
        warnings.append(f"{int(lost.sum())} of {len(lost)} clouds were left out: {why}.")
