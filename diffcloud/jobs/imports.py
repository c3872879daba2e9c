"""Import existing recordings as episodes: detect their kind and read them."""

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
from diffcloud.io.camera_models import read_transform
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
from diffcloud.sensing.filters import cropped, transformed, without_strays
from diffcloud.sensing.fusion import FusionSettings
from diffcloud.sensing.tool_poses import turning
from diffcloud.sensing.visible_region import with_cut_planes

Box = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Lowest and highest corner [3] [m]."""
_FARTHEST_M = 50.0
"""Largest plausible distance of a point from the robot's base."""
_KINDS = {
    "clouds": "a folder of clouds",
    "release": "the published data",
    "ros": "a ROS recording",
    "ros_clouds": "a ROS recording of clouds",
    "realsense": "a RealSense recording",
    "folder": "a depth folder",
}
"""Kind of source -> its description in messages."""
_RECORDINGS = ("ros", "realsense", "folder")
_OF = {
    "--gripper": ("clouds",),
    "--camera": ("clouds", "ros_clouds"),
    "--transform": ("clouds",),
    "--crop": ("clouds", "ros_clouds"),
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
"""Option -> kinds of sources for which it is valid."""
_IMAGE_SIGNS = ("depth", "camera.json", "intrinsics.json", "camera_intrinsic.json", "intrinsic.json")
"""File and folder names that identify a depth folder."""


def source_kind(sources: list[Path], stated: str | None = None, topics: Sequence[str] = ()) -> str:
    """Return the kind of the sources: clouds, release, ros, ros_clouds, realsense or folder (of depth images).

    Args:
        stated: clouds, recording or release, instead of detection. None: detect the kind from the files.
        topics: topics that the user chose in a ROS recording.

    Raises:
        EpisodeError: a ROS recording is not readable.
        ConfigError: the kind is unknown, the sources have several kinds, or the kind allows only one folder.
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
    """Detect the kind of a path: clouds, recording or release.

    Raises:
        ConfigError: a folder looks like none of them, or like several.
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
    """Check that all given options are valid for this kind of source.

    Raises:
        ConfigError: an option belongs to other kinds.
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
    """Write the published data as episodes, and return the names of the written episodes per folder."""
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
    transform: Path | None = None,
    box: Box | None = None,
) -> dict[str, Any]:
    """Write a folder of clouds and gripper tracks as an episode. Return the file name and counts.

    Args:
        transform: text file of the matrix [4, 4] from the frame of the clouds to the robot's frame.
        box: see `crop_box`.
    """
    meta: dict[str, Any] = {**labels, **({"viewpoints": viewpoints} if viewpoints else {})}
    episode = cloud_folder(folder, grippers=named_files(gripper) if gripper else None, rate_hz=rate_hz, meta=meta)
    if transform is not None:
        episode = transformed(episode, read_transform(transform))
    if box is not None:
        episode = cropped(episode, *box)
    _refuse_far(episode, folder)
    return _write_clouds(out, episode)


@writes(".npz")
def import_ros_clouds(
    paths: list[Path],
    out: Path,
    choices: dict[str, Any],
    labels: dict[str, str],
    viewpoints: dict[str, list[float]],
    box: Box | None = None,
) -> dict[str, Any]:
    """Write a ROS recording of clouds as an episode; file, counts and warnings, for the result.

    Args:
        box: see `crop_box`.
    """
    meta: dict[str, Any] = {**labels, **({"viewpoints": viewpoints} if viewpoints else {})}
    episode, warnings = cloud_recording(paths, {**choices, "meta": meta})
    return {**_write_clouds(out, episode if box is None else cropped(episode, *box)), "warnings": warnings}


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
    """Write a depth recording as a raw episode. Return counts and warnings.

    Args:
        play: function that opens recordings of the RealSense SDK.
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
    """Convert command-line options to keyword arguments of `ros_recording`."""
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
    """Parse NAME[,OPEN,CLOSED] or `none` to keyword arguments of `ros_recording`.

    Raises:
        ConfigError: the text has another form.
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
    """Read the tracks of the motions whose recordings exist in the folder."""
    folders = {kind: RELEASE_FOLDERS[kind][0] for kind in RECORDED_START_M}
    kinds = tuple(kind for kind, name in folders.items() if (folder / name).is_dir())
    if not kinds:
        raise ConfigError(
            f"{folder} has neither {' nor '.join(folders.values())}, the recordings to which --trajectories belongs. "
            "Give the folder that has one of them, or leave --trajectories out."
        )
    return read_trajectories(trajectories, kinds)


def _recorded(kind: str, name: str, published: Episode, track: NDArray[np.float64]) -> Episode:
    """Return the recording without stray points. If its cameras are known, add their crop planes."""
    episode = without_strays(recorded_episode(kind, name, published, track), FusionSettings.cluster_gap_m)
    if episode.camera is not None:
        return with_cut_planes(episode)
    warn(
        f"{name}: no known camera set-up gives its points whole pixels and millimetres, so its points name no camera. Fits "
        "treat it as one anonymous cloud per frame."
    )
    return episode


def _corrected(recorded: dict[Path, Episode]) -> dict[Path, Episode]:
    """Correct the second camera of the recordings against the first, with one correction per camera setup."""
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
    """Read a URDF, or return the description of the package's own Gen3."""
    from diffcloud.sensing.robot import gen3  # imported here because it imports torch

    return gen3().description if urdf is None else read_urdf(urdf)


def recording_kind(path: Path) -> str:
    """Detect the kind of a recording: ros, realsense or folder.

    Raises:
        ConfigError: the file has another kind.
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
    # Recordings of the RealSense SDK are bags too. Their topic names start with the device.
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


def crop_box(text: str | None) -> Box | None:
    """Parse X,Y,Z:X,Y,Z to the lowest and the highest corner [3] of a box [m].

    Raises:
        ConfigError: the text has another form, or the box has no volume.
    """
    if text is None:
        return None
    corners = [_point(corner) for corner in text.split(":")]
    if len(corners) != 2 or not all(corners) or not np.ptp(corners, axis=0).all():
        raise ConfigError(
            "--crop takes X,Y,Z:X,Y,Z in metres, two corners that differ in x, y and z, as in 0.3,-0.4,0.01:0.9,0.4,0.8; "
            f"got {text!r}."
        )
    return np.min(corners, axis=0), np.max(corners, axis=0)


def _point(text: str) -> list[float]:
    """Parse X,Y,Z to finite coordinates [3] [m]. Return an empty list if the text has another form."""
    try:
        place = [float(part) for part in text.split(",")]
    except ValueError:
        return []
    return place if len(place) == 3 and all(map(math.isfinite, place)) else []


def viewpoints(items: list[str] | None) -> dict[str, list[float]]:
    """Parse NAME=X,Y,Z items to camera name -> [x, y, z] [m].

    Raises:
        ConfigError: an item has another form, or a camera occurs twice.
    """
    found: dict[str, list[float]] = {}
    for item in items or []:
        name, _, text = item.partition("=")
        place = _point(text)
        if not name or name in found or not place:
            raise ConfigError(f"--camera takes NAME=X,Y,Z in metres, each camera once, as in side=1.2,0,0.5; got {item!r}.")
        found[name] = place
    return found
