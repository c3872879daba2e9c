"""Existing recordings become episodes: what kind they are, and how each kind is read."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.console import errors, warn, writes
from diffcloud.errors import ConfigError, EpisodeError
from diffcloud.io.clouds import FORMATS
from diffcloud.io.depth_folders import depth_folders
from diffcloud.io.episodes import Episode, write_episode
from diffcloud.io.files import files_in, together
from diffcloud.io.grippers import named_files
from diffcloud.io.imports import RELEASE_FOLDERS, cloud_folder, release_episodes
from diffcloud.io.inputs import open_input
from diffcloud.io.numbers import number
from diffcloud.io.published import RECORDED_START_M, read_trajectories, recorded_episode
from diffcloud.io.recordings import Recording, read_joint_log, write_recording
from diffcloud.io.ros.recording import ros_recording
from diffcloud.io.ros.surfaces import is_cloud_recording, ros_clouds
from diffcloud.io.urdf import RobotDescription, read_urdf
from diffcloud.sensing.agreement import agreement, corrected
from diffcloud.sensing.filters import without_strays
from diffcloud.sensing.fusion import FusionSettings
from diffcloud.sensing.tool_poses import turning
from diffcloud.sensing.visible_region import with_cut_planes

_FARTHEST_M = 50.0
"""From the robot's base: no cloth hangs there."""
_KINDS = {
    "clouds": "a folder of clouds",
    "release": "the published data",
    "ros": "a ROS recording",
    "ros_clouds": "a ROS recording of clouds",
    "realsense": "a RealSense recording",
    "folder": "a depth folder",
}
"""Kind of source -> how messages call it."""
_RECORDINGS = ("ros", "realsense", "folder")
_OF = {
    "--gripper": ("clouds",),
    "--camera": ("clouds", "ros_clouds"),
    "--rate-hz": ("clouds", "folder"),
    "--label": ("clouds", "ros_clouds", *_RECORDINGS),
    "--joint-log": _RECORDINGS,
    "--clock-offset": _RECORDINGS,
    "--world-frame": ("ros", "ros_clouds"),
    "--tool-frame": ("ros", "ros_clouds"),
    "--joints": ("ros", "ros_clouds"),
    "--gripper-joint": ("ros",),
    "--topic": ("ros", "ros_clouds"),
    "--urdf": ("ros", "ros_clouds"),
    "--trajectories": ("release",),
}
"""Option -> the kinds of source that it belongs to."""
_IMAGE_SIGNS = ("depth", "camera.json", "intrinsics.json", "camera_intrinsic.json", "intrinsic.json")
"""What a depth folder holds."""


def source_kind(sources: list[Path], stated: str | None = None, topics: Sequence[str] = ()) -> str:
    """Return what the sources are: clouds, release, ros, ros_clouds, realsense or folder (of depth images).

    Args:
        stated: clouds, recording or release, in place of what the files show; None to look.
        topics: those that the user named, of a ROS recording.

    Raises:
        EpisodeError: an unreadable ROS recording.
        ConfigError: nothing that can be imported, files of several kinds, or a kind that takes one folder with several.
    """
    paths = named(sources).values()
    kinds = {stated or _general_kind(path) for path in paths}
    if kinds == {"recording"}:
        kinds = {recording_kind(path) for path in paths}
    if len(kinds) > 1:
        raise ConfigError(
            "The sources are of several kinds. Give one folder of clouds, one ROS recording, or one RealSense recording or "
            "folder per camera, not a mixture."
        )
    (kind,) = kinds
    if kind in ("clouds", "release"):
        if len(sources) > 1:
            raise ConfigError(
                f"{len(sources)} sources are given. Of {_KINDS[kind]}, an import takes one. Import them one by one."
            )
        if not sources[0].exists():  # NAME=PATH
            raise ConfigError(f"{sources[0]}: only recordings of several cameras have names. Give the folder alone.")
    if kind == "ros" and is_cloud_recording(list(paths), topics):
        return "ros_clouds"
    return kind


def _general_kind(path: Path) -> str:
    """clouds, recording or release, by what lies there.

    Raises:
        ConfigError: a folder with signs of none of them, or of several.
    """
    if not path.is_dir():
        if path.suffix.lower() in FORMATS:
            raise ConfigError(f"{path} is a single cloud. Give the folder with one cloud per frame: {path.parent}.")
        return "recording"
    if (path / "episode.json").is_file():
        raise ConfigError(f"{path} is a raw episode already. Make clouds of it: diffcloud data preprocess {path}.")
    signs = {
        "release": any((path / name).is_dir() for name, _ in RELEASE_FOLDERS.values()),
        "recording": any((path / name).exists() for name in ("metadata.yaml", "meta/info.json", *_IMAGE_SIGNS)),
        "clouds": bool(files_in(path, *FORMATS)),
    }
    kinds = [kind for kind, found in signs.items() if found]
    if len(kinds) == 1:
        return kinds[0]
    if kinds:
        raise ConfigError(f"{path} looks like several kinds: {', '.join(kinds)}. Say which one it is with --kind.")
    raise ConfigError(
        f"{path} holds nothing that can be imported. A folder holds clouds ({', '.join(FORMATS)}), or depth/*.png with "
        "camera.json, or metadata.yaml of a rosbag2, or lift_real_pcls/ and others of the published data. Give such a "
        "folder, or the files of a recording."
    )


def refuse_others(source: list[Path], found: str, given: list[str]) -> None:
    """
    Raises:
        ConfigError: an option belongs to other kinds of source.
    """
    for option in given:
        if found not in _OF[option]:
            own = " or ".join(_KINDS[kind] for kind in _OF[option])
            raise ConfigError(
                f"{option} belongs to {own}, and {source[0]} is {_KINDS[found]}. Leave {option} out. If the kind is wrong, "
                "name the right one with --kind."
            )


@writes()
def import_release(folder: Path, out: Path, trajectories: Path | None) -> dict[str, Any]:
    """Write the published data as episodes; the names by folder, for the result."""
    tracks = {} if trajectories is None else _tracks(folder, trajectories)
    written: dict[str, list[str]] = {}
    recorded: dict[Path, Episode] = {}
    with together():
        for scenario, name, episode in release_episodes(folder):
            kind = scenario.removeprefix("release_")
            write_episode(out / scenario / f"{name}.npz", episode)
            written.setdefault(scenario, []).append(name)
            if kind in tracks:
                recorded[out / f"recorded_{kind}" / f"{name}.npz"] = _recorded(kind, name, episode, tracks[kind])
                written.setdefault(f"recorded_{kind}", []).append(name)
        for path, episode in _corrected(recorded).items():
            write_episode(path, episode)
    for scenario, names in written.items():
        errors.print(f"{scenario}: {len(names)} episodes in {out / scenario}")
    return {"episodes": written}


@writes(".npz")
def import_clouds(
    folder: Path,
    out: Path,
    gripper: list[str] | None,
    rate_hz: float | None,
    labels: dict[str, str],
    viewpoints: dict[str, list[float]],
) -> dict[str, Any]:
    """Write a folder of clouds and the tracks of grippers as an episode; file and counts, for the result."""
    meta: dict[str, Any] = {**labels, **({"viewpoints": viewpoints} if viewpoints else {})}
    episode = cloud_folder(folder, grippers=named_files(gripper) if gripper else None, rate_hz=rate_hz, meta=meta)
    _refuse_far(episode, folder)
    return _write_clouds(out, episode)


@writes(".npz")
def import_ros_clouds(
    paths: list[Path], out: Path, choices: dict[str, Any], labels: dict[str, str], viewpoints: dict[str, list[float]]
) -> dict[str, Any]:
    """Write a ROS recording of clouds as an episode; file, counts and warnings, for the result."""
    meta: dict[str, Any] = {**labels, **({"viewpoints": viewpoints} if viewpoints else {})}
    episode, warnings = cloud_recording(paths, {**choices, "meta": meta})
    return {**_write_clouds(out, episode), "warnings": warnings}


def cloud_recording(paths: list[Path], choices: dict[str, Any]) -> tuple[Episode, list[str]]:
    """A ROS recording of clouds as an episode, and the warnings, which are printed.

    Args:
        choices: what `ros_choices` returns, and `meta`.

    Raises:
        EpisodeError: as `ros_clouds`.
        ConfigError: points that are too far away to be in metres.
    """
    described = choices.pop("description")

    def tool_pose(joints_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        from diffcloud.sensing.robot import TOOL_LINK, Robot  # not above: it brings torch

        return Robot(described(), choices.get("tool_frame") or TOOL_LINK).tool_pose(joints_rad)

    found = ros_clouds(*paths, tool_pose=tool_pose, **choices)
    turned = turning(found.tool_quaternions)
    warnings = [*found.warnings, *([] if turned is None else [turned])]
    for message in warnings:
        warn(message)
    errors.print(found.summary)
    _refuse_far(found.episode, paths[0])
    return found.episode, warnings


def _refuse_far(episode: Episode, source: Path) -> None:
    """
    Raises:
        ConfigError: points that are too far away to be in metres.
    """
    far = float(np.abs(episode.points).max())
    if far > _FARTHEST_M:
        raise ConfigError(
            f"{source}: points lie up to {far:.0f} m from the origin. Clouds are in metres, in the robot's frame; divide "
            "millimetres by 1000."
        )


def _write_clouds(out: Path, episode: Episode) -> dict[str, Any]:
    write_episode(out, episode)
    errors.print(f"Wrote {episode.frame_count} frames, {len(episode.points)} points to {out}.")
    return {"out": str(out), "frames": episode.frame_count, "points": len(episode.points)}


@writes()
def import_recording(
    named: dict[str, Path],
    out: Path,
    kind: str,
    ros_choices: Callable[[], dict[str, Any]],
    rate_hz: float | None,
    joint_log: Path | None,
    clock_offset_s: float,
    labels: dict[str, str],
    play: Callable[[dict[str, Path]], AbstractContextManager[Recording]],
) -> dict[str, Any]:
    """Write depth recordings as a raw episode; counts and warnings, for the result.

    Args:
        play: opens recordings of the RealSense SDK.
    """
    with ExitStack() as stack:
        if kind == "ros":
            found = ros_recording(*named.values(), **ros_choices())
        elif kind == "realsense":
            found = stack.enter_context(play(named))
        else:
            found = depth_folders(named, rate_hz=rate_hz)
        if joint_log is not None:
            found = _with_log(found, joint_log, clock_offset_s)
        warnings = list(found.warnings)
        if found.robot is None:
            warnings.append("No joint log: the robot cannot be masked later. Give --joint-log if there is one.")
        for message in warnings:
            warn(message)
        frames = write_recording(out, found, rate_hz=rate_hz, meta=labels)
    errors.print(f"Wrote {frames} frames to {out}.")
    rows = 0 if found.robot is None else len(found.robot.times)
    return {"frames": frames, "robot_rows": rows, "source": found.source, "warnings": warnings}


def ros_choices(
    world_frame: str | None,
    tool_frame: str | None,
    joints: list[str] | None,
    gripper_joint: str | None,
    topics: list[str] | None,
    urdf: Path | None,
) -> dict[str, Any]:
    """What options choose in a ROS recording, as `ros_recording` takes it."""
    frames = {"world_frame": world_frame, "tool_frame": tool_frame}
    names = [name.strip() for item in joints or [] for name in item.split(",")]
    if not all(names):
        raise ConfigError(f"--joints takes NAME,NAME,..., got {','.join(joints or [])!r}. Try --joints joint_1,joint_2.")
    return {
        **{key: frame for key, frame in frames.items() if frame is not None},
        **({} if gripper_joint is None else _gripper(gripper_joint)),
        "joint_names": names or None,
        "description": partial(robot_description, urdf),
        "topics": topics or (),
    }


def _gripper(text: str) -> dict[str, Any]:
    """NAME[,OPEN,CLOSED], or none, as `ros_recording` takes it.

    Raises:
        ConfigError: something else.
    """
    name, *positions = (part.strip() for part in text.split(","))
    if text.strip() == "none":
        return {"gripper_joint": None}
    try:
        open_, closed = map(number, positions) if positions else (0.0, None)
    except ValueError:
        name = ""
    if name in ("", "none"):
        raise ConfigError(
            "--gripper-joint takes NAME, or NAME,OPEN,CLOSED with the joint's positions in rad or m, or none; got "
            f"{text!r}. Try --gripper-joint finger_joint,0,0.8."
        )
    return {"gripper_joint": name, "gripper_open": open_, "gripper_closed": closed}


def _tracks(folder: Path, trajectories: Path) -> dict[str, NDArray[np.float64]]:
    """The tracks of those motions whose recordings are there."""
    folders = {kind: RELEASE_FOLDERS[kind][0] for kind in RECORDED_START_M}
    kinds = tuple(kind for kind, name in folders.items() if (folder / name).is_dir())
    if not kinds:
        raise ConfigError(
            f"{folder} holds neither {' nor '.join(folders.values())}, to which the trajectories belong; give the folder "
            "that does, or leave --trajectories out."
        )
    return read_trajectories(trajectories, kinds)


def _recorded(kind: str, name: str, published: Episode, track: NDArray[np.float64]) -> Episode:
    """The recording without strays; of known cameras with the heights at which their points were cut off."""
    episode = without_strays(recorded_episode(kind, name, published, track), FusionSettings.cluster_gap_m)
    if episode.camera is not None:
        return with_cut_planes(episode)
    warn(
        f"{name}: no known camera set-up gives its points whole pixels and millimetres, so its points name no camera. Fits "
        "treat it as one anonymous cloud per frame."
    )
    return episode


def _corrected(recorded: dict[Path, Episode]) -> dict[Path, Episode]:
    """The recordings with the second camera corrected against the first, by one correction for each set-up."""
    result = dict(recorded)
    groups: dict[tuple[Path, str], dict[Path, Episode]] = {}
    for path, episode in recorded.items():
        if "set_up" in episode.meta:
            groups.setdefault((path.parent, episode.meta["set_up"]), {})[path] = episode
    for (_, name), mine in groups.items():
        first, second = next(iter(mine.values())).meta["cameras"]
        try:
            found = agreement(list(mine.values()), (first, second))
        except EpisodeError as error:
            warn(f"Set-up {name}: the camera {second} was not corrected. {error}")
            continue
        names = [path.stem for path in mine]
        result |= {path: corrected(episode, found, names) for path, episode in mine.items()}
    return result


def named(sources: list[Path]) -> dict[str, Path]:
    named: dict[str, Path] = {}
    for source in sources:
        name, equals, path = str(source).partition("=")
        entry = (name, Path(path)) if equals else (source.absolute().stem, source)
        if entry[0] in named:
            raise ConfigError(f"Two sources are named {entry[0]!r}; name them with NAME=PATH.")
        if not entry[1].exists():
            raise ConfigError(f"No such recording: {entry[1]}.")
        named[entry[0]] = entry[1]
    return named


def robot_description(urdf: Path | None) -> RobotDescription:
    """A URDF's, or that of the package's own Gen3."""
    from diffcloud.sensing.robot import gen3  # not above: it brings torch

    return gen3().description if urdf is None else read_urdf(urdf)


def recording_kind(path: Path) -> str:
    """ros, realsense or folder.

    Raises:
        ConfigError: a file of another kind.
    """
    if (path / "meta" / "info.json").is_file() and not (path / "metadata.yaml").is_file():
        raise ConfigError(
            f"{path} is a LeRobot data set: its videos hold no depth in metres. Export depth images and joints, and import "
            "them as a folder with depth/*.png, camera.json and --joint-log."
        )
    if path.is_dir():
        return "ros" if (path / "metadata.yaml").is_file() else "folder"
    if path.suffix not in (".bag", ".db3", ".mcap"):
        raise ConfigError(f"{path}: unknown kind of recording; allowed are .bag, .db3, .mcap and folders.")
    # the SDK's files are bags too, and name their topics after the device
    marker = b"/device_0/sensor_"
    with open_input(path, kind="recording", error=ConfigError, most_bytes=sys.maxsize) as stream:
        tail = b""
        while block := stream.read(1 << 20):
            if marker in tail + block:
                return "realsense"
            tail = block[-len(marker) :]
            if stream.tell() > 64 << 20:
                break
    return "ros"


def _with_log(found: Recording, path: Path, offset_s: float) -> Recording:
    frames = iter(found.frames)
    first = next(frames, None)
    start = 0.0 if first is None else first.time_s
    log = read_joint_log(path, offset_s=offset_s, recording_start_s=start)
    return replace(found, frames=frames if first is None else chain([first], frames), robot=log)


def viewpoints(items: list[str] | None) -> dict[str, list[float]]:
    """NAME=X,Y,Z items as camera -> [x, y, z] [m].

    Raises:
        ConfigError: what is not NAME=X,Y,Z, or a camera that is named twice.
    """
    found: dict[str, list[float]] = {}
    for item in items or []:
        name, _, text = item.partition("=")
        try:
            place = [float(part) for part in text.split(",")]
        except ValueError:
            place = []
        if not name or name in found or len(place) != 3 or not all(map(math.isfinite, place)):
            raise ConfigError(f"--camera takes NAME=X,Y,Z in metres, each camera once, as in side=1.2,0,0.5; got {item!r}.")
        found[name] = place
    return found
