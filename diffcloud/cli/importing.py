"""`diffcloud data import`: existing recordings become episodes."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from diffcloud.cli.options import JsonFlag, Topics
from diffcloud.console import finish
from diffcloud.errors import ConfigError


def import_(
    source: Annotated[
        list[Path],
        typer.Argument(
            help="A folder of clouds (npy, ply, xyz, pcd) that are numbered or named by time, one a frame, in metres. Or a "
            "ROS recording (.bag, .mcap, .db3, rosbag2 folder), or all parts of a split one. Or, for each camera and as "
            "NAME=PATH, a RealSense recording (.db3, .bag), or a folder with depth/*.png and camera.json. Or the folder of "
            "the published data."
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            help="Clouds, also of ROS: episode file (.npz). Recordings: folder of the raw episode; must not exist. "
            "Published data: folder; episodes go to OUT/release_<lift|fold|band|hang>/."
        ),
    ],
    kind: Annotated[
        Literal["clouds", "recording", "release"] | None, typer.Option(help="What the source is. Default: it is detected.")
    ] = None,
    gripper: Annotated[
        list[str] | None,
        typer.Option(
            help="Clouds: CSV with x, y, z in metres and optionally t_s, one row per frame. Several grippers: one CSV with "
            "a column gripper, or NAME=PATH for each."
        ),
    ] = None,
    rate_hz: Annotated[
        float | None,
        typer.Option(
            help="Clouds, depth folders: frame rate, if neither a CSV nor the file names have times. If the file "
            "names are times, a given rate must agree with them."
        ),
    ] = None,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            help="Clouds, also of ROS: NAME=X,Y,Z in metres, in the robot's frame, for every camera. Fits omit parts that "
            "no camera could see."
        ),
    ] = None,
    transform: Annotated[
        Path | None,
        typer.Option(help="Clouds: text file of the 4 x 4 matrix from their frame to the robot's frame."),
    ] = None,
    crop: Annotated[
        str | None,
        typer.Option(
            help="Clouds, also of ROS: box that is kept, X,Y,Z:X,Y,Z. Opposite corners in m, in the robot's frame."
        ),
    ] = None,
    label: Annotated[
        list[str] | None,
        typer.Option(help="KEY=VALUE, stored in the episode, such as scenario=lift or fabric=tan. May be repeated."),
    ] = None,
    joint_log: Annotated[
        Path | None, typer.Option(help="Recordings: CSV of the joints, with the columns of robot.csv.")
    ] = None,
    clock_offset: Annotated[
        float | None, typer.Option(help="Recordings: seconds to add to the times of --joint-log.")
    ] = None,
    world_frame: Annotated[str | None, typer.Option(help="ROS: the robot's base in tf. Default: base_link.")] = None,
    tool_frame: Annotated[str | None, typer.Option(help="ROS: the tool in tf. Default: tool_frame.")] = None,
    joints: Annotated[
        list[str] | None,
        typer.Option(help="ROS: the arm's joints in order, NAME,NAME,... or repeated. Default: joint_1, joint_2, ..."),
    ] = None,
    gripper_joint: Annotated[
        str | None,
        typer.Option(
            help="ROS: NAME[,OPEN,CLOSED]: the gripper's joint in joint_states, and its positions when open and closed, in "
            "rad or m. Default: finger_joint,0,0.8. none: an arm without gripper."
        ),
    ] = None,
    topic: Topics = None,
    urdf: Annotated[
        Path | None,
        typer.Option(
            help="ROS without joint_states: URDF of the robot. Its links are in tf. Default: a Kinova Gen3 with a 2F-85."
        ),
    ] = None,
    trajectories: Annotated[
        Path | None,
        typer.Option(
            help="Published data: folder of lift_traj.npy and fold_traj.npy, the gripper's tracks. Adds "
            "OUT/recorded_<lift|fold>/: the same recordings in metres, with the gripper."
        ),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Import clouds, recordings or the published data. The kind of the source is detected.

    Clouds become an episode, the input of a fit. Depth recordings become a raw episode: check it with `diffcloud data
    check`. An option that does not belong to the source's kind is refused.
    """
    from diffcloud.hardware.realsense import play_recordings
    from diffcloud.io.labels import read_labels
    from diffcloud.jobs.imports import (
        crop_box,
        import_clouds,
        import_recording,
        import_release,
        import_ros_clouds,
        named,
        refuse_others,
        ros_choices,
        source_kind,
        viewpoints,
    )

    found = source_kind(source, kind, topic or ())
    given = {
        "--gripper": gripper, "--rate-hz": rate_hz, "--camera": camera, "--transform": transform,
        "--crop": crop, "--label": label, "--joint-log": joint_log,
        "--clock-offset": clock_offset, "--world-frame": world_frame, "--tool-frame": tool_frame, "--joints": joints,
        "--gripper-joint": gripper_joint, "--topic": topic, "--urdf": urdf, "--trajectories": trajectories,
    }  # fmt: skip
    refuse_others(source, found, [option for option, value in given.items() if value not in (None, [])])
    labels, box = read_labels(label or []), crop_box(crop)
    if found == "release":
        result = import_release(source[0], out, trajectories)
    elif found == "clouds":
        result = import_clouds(source[0], out, gripper, rate_hz, labels, viewpoints(camera), transform, box)
    elif found == "ros_clouds":
        choices = ros_choices(world_frame, tool_frame, joints, None, topic, urdf)
        result = import_ros_clouds(list(named(source).values()), out, choices, labels, viewpoints(camera), box)
    else:
        if clock_offset is not None and joint_log is None:
            raise ConfigError("--clock-offset shifts the times of a joint log, and none is given. Give --joint-log too.")
        later = partial(ros_choices, world_frame, tool_frame, joints, gripper_joint, topic, urdf)
        offset = clock_offset or 0.0
        result = import_recording(named(source), out, found, later, rate_hz, joint_log, offset, labels, play_recordings)
    finish({"out": str(out), "kind": found, **result}, json)
