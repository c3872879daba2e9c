"""`diffcloud import`: existing recordings become episodes."""

from __future__ import annotations

import math
import sys
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from diffcloud.cli.console import JsonFlag, Topics, errors, finish, warn, writes
from diffcloud.errors import ConfigError, EpisodeError
from diffcloud.hardware.realsense import play_recordings
from diffcloud.io.depth_folders import depth_folders
from diffcloud.io.episodes import Episode, write_episode
from diffcloud.io.files import together
from diffcloud.io.grippers import named_files
from diffcloud.io.imports import RELEASE_FOLDERS, cloud_folder, release_episodes
from diffcloud.io.inputs import open_input
from diffcloud.io.published import RECORDED_START_M, read_trajectories, recorded_episode
from diffcloud.io.recordings import Recording, read_joint_log, write_recording
from diffcloud.io.ros.joints import GRIPPER_CLOSED_RAD, GRIPPER_JOINT
from diffcloud.io.ros.recording import ros_recording
from diffcloud.io.urdf import RobotDescription, read_urdf
from diffcloud.sensing.agreement import agreement, corrected
from diffcloud.sensing.filters import without_strays
from diffcloud.sensing.fusion import FusionSettings
from diffcloud.sensing.visible_region import with_cut_planes

_FARTHEST_M = 50.0
"""From the robot's base: no cloth hangs there."""
app = typer.Typer(no_args_is_help=True, help="Turn existing recordings into episodes.")


@app.command()
@writes()
def release(
    folder: Annotated[Path, typer.Argument(help="Holds lift_real_pcls/, fold_real_pcls/, band_sim_pcls/, hang_sim_pcls/.")],
    out: Annotated[Path, typer.Option(help="Folder; episodes go to OUT/release_<lift|fold|band|hang>/.")],
    trajectories: Annotated[
        Path | None,
        typer.Option(
            help="Holds lift_traj.npy and fold_traj.npy, the gripper's tracks. Adds OUT/recorded_<lift|fold>/: the same "
            "recordings in metres, with the gripper."
        ),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Import the data published with the paper."""
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
    finish({"out": str(out), "episodes": written}, json)


@app.command()
@writes(".npz")
def clouds(
    folder: Annotated[
        Path, typer.Argument(help="Clouds (npy, ply, xyz, pcd) numbered or named by time, one a frame, in metres.")
    ],
    out: Annotated[Path, typer.Option(help="Episode file (.npz).")],
    gripper: Annotated[
        list[str] | None,
        typer.Option(
            help="CSV with x, y, z in metres and optionally t_s, one row a frame. Of several grippers: one with a column "
            "gripper that names them, or NAME=PATH, repeated."
        ),
    ] = None,
    rate_hz: Annotated[
        float | None,
        typer.Option(
            help="Frame rate, if neither the CSV has t_s nor the file names are times. Names that are times must agree."
        ),
    ] = None,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            help="NAME=X,Y,Z in metres, in the frame of the clouds, for every camera: fits leave out what none of them "
            "could see."
        ),
    ] = None,
    scenario: Annotated[str | None, typer.Option(help="Name kept in the episode's metadata.")] = None,
    fabric: Annotated[str | None, typer.Option(help="Fabric kept in the episode's metadata.")] = None,
    json: JsonFlag = False,
) -> None:
    """Import a folder of clouds and the tracks of grippers."""
    labels = (("scenario", scenario), ("fabric", fabric), ("viewpoints", _viewpoints(camera)))
    meta = {name: value for name, value in labels if value}
    episode = cloud_folder(folder, grippers=named_files(gripper) if gripper else None, rate_hz=rate_hz, meta=meta)
    far = float(np.abs(episode.points).max())
    if far > _FARTHEST_M:
        raise ConfigError(
            f"{folder}: points lie up to {far:.0f} m from the origin. Clouds are in metres, in the robot's frame; divide "
            "millimetres by 1000."
        )
    write_episode(out, episode)
    errors.print(f"Wrote {episode.frame_count} frames, {len(episode.points)} points to {out}.")
    finish({"out": str(out), "frames": episode.frame_count, "points": len(episode.points)}, json)


@app.command()
@writes()
def recording(
    source: Annotated[
        list[Path],
        typer.Argument(
            help="A ROS recording (.bag, .mcap, .db3, rosbag2 folder), or all parts of a split one; or, one per camera and "
            "as NAME=PATH, recordings of the RealSense SDK (.db3, .bag) or folders with depth/*.png and camera.json."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder of the raw episode; must not exist.")],
    joint_log: Annotated[Path | None, typer.Option(help="CSV with the columns of robot.csv.")] = None,
    log_offset: Annotated[float, typer.Option(help="Seconds to add to the joint log's times.")] = 0.0,
    rate_hz: Annotated[
        float | None,
        typer.Option(help="Frame rate, where the source has no times. File names that are times must agree with it."),
    ] = None,
    world_frame: Annotated[str, typer.Option(help="ROS: the robot's base in tf.")] = "base_link",
    tool_frame: Annotated[str, typer.Option(help="ROS: the tool in tf.")] = "tool_frame",
    topic: Topics = None,
    joint: Annotated[
        list[str] | None, typer.Option(help="ROS: the arm's joints in order; joint_1, ... if not given.")
    ] = None,
    gripper_joint: Annotated[
        str, typer.Option(help="ROS: in joint_states; none for an arm without gripper.")
    ] = GRIPPER_JOINT,
    gripper_open: Annotated[float, typer.Option(help="ROS: its position when open, rad or m.")] = 0.0,
    gripper_closed: Annotated[
        float | None, typer.Option(help=f"ROS: its position when closed, rad or m; {GRIPPER_CLOSED_RAD} if not given.")
    ] = None,
    urdf: Annotated[
        Path | None,
        typer.Option(
            help="ROS without joint_states: the robot, whose link frames are in tf. Default: a Kinova Gen3 with a 2F-85."
        ),
    ] = None,
    scenario: Annotated[str | None, typer.Option(help="Kept in episode.json.")] = None,
    fabric: Annotated[str | None, typer.Option(help="Kept in episode.json.")] = None,
    json: JsonFlag = False,
) -> None:
    """Import existing depth recordings as a raw episode. Check it with `diffcloud episode validate`."""
    named = _named(source)
    kinds = {recording_kind(path) for path in named.values()}
    if len(kinds) > 1:
        raise ConfigError("Give one ROS recording, or one RealSense recording or folder per camera, not a mixture.")
    with ExitStack() as stack:
        if kinds == {"ros"}:
            found = ros_recording(
                *named.values(),
                world_frame=world_frame,
                tool_frame=tool_frame,
                joint_names=joint or None,
                gripper_joint=None if gripper_joint == "none" else gripper_joint,
                gripper_open=gripper_open,
                gripper_closed=gripper_closed,
                description=partial(robot_description, urdf),
                topics=topic or (),
            )
        elif kinds == {"realsense"}:
            found = stack.enter_context(play_recordings(named))
        else:
            found = depth_folders(named, rate_hz=rate_hz)
        if joint_log is not None:
            found = _with_log(found, joint_log, log_offset)
        warnings = list(found.warnings)
        if found.robot is None:
            warnings.append("No joint log: the robot cannot be masked later. Give --joint-log if there is one.")
        for message in warnings:
            warn(message)
        meta = {key: value for key, value in (("scenario", scenario), ("fabric", fabric)) if value is not None}
        frames = write_recording(out, found, rate_hz=rate_hz, meta=meta)
    errors.print(f"Wrote {frames} frames to {out}.")
    rows = 0 if found.robot is None else len(found.robot.times)
    result = {"out": str(out), "frames": frames, "robot_rows": rows, "source": found.source, "warnings": warnings}
    finish(result, json)


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


def _named(sources: list[Path]) -> dict[str, Path]:
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


def _viewpoints(items: list[str] | None) -> dict[str, list[float]]:
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
