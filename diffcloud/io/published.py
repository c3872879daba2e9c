"""The published gripper tracks, and the real published recordings in metres and seconds with gripper and cameras.

The published scenes use one frame only and move the gripper along a simplified path. In contrast, `recorded_episode`
returns a lift or fold as recorded: clouds in metres at 10 Hz, and the published gripper track. The track is in the
robot's frame. The clouds' frame is rotated by 90° about the vertical relative to it. Its origin is taken from the
camera setup, if known. Otherwise it was estimated from the clouds' highest points, which move with the gripper.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError
from diffcloud.io.episodes import Episode, Pinhole
from diffcloud.io.pickles import load_npy
from diffcloud.io.published_cameras import SetUp, published_set_ups, recognised

RELEASE_UNIT_M = 0.35
"""Length unit of the published recordings [m]."""
PAPER_THRESHOLD = 5e-4
"""Stop threshold of the one-sided Chamfer loss, in squared length units of the release (paper, section IV-F)."""
RECORDED_RATE_HZ = 10.0
"""Rate of robot commands and clouds (paper, section IV-D). Row j of a track is the gripper position in cloud j."""
RECORDED_START_M: Mapping[str, tuple[float, float, float]] = MappingProxyType(
    {"lift": (0.0, 0.105, 0.0), "fold": (0.0, -0.286, -0.033)}
)
"""Motion -> (x, y, offset of z) [m]. x and y are the gripper's start in the scene, at most about 1 cm from the grasped
corner. The offset is added to the robot's z if the clouds' origin in the robot's frame is unknown."""
_POSE_SIGMAS: Mapping[bool, Mapping[str, float]] = MappingProxyType(
    {
        True: {"x": 0.01, "y": 0.01, "yaw": math.radians(1)},
        False: {"x": 0.03, "y": 0.03, "yaw": math.radians(20)},
    }
)
"""Whether the clouds' origin in the robot's frame is known -> prior standard deviations of the pose [m, rad]. Even if
it is known, the fingers hold the cloth up to 1 cm from its corner."""
_SCALE_SIGMA = 0.02
"""Prior standard deviation of the clouds' scale, as a fraction (from the cameras' data sheet). In the published
calibration images the board is 3 to 6 % too large. But the calibration used for the clouds is unpublished, so the prior
mean is 0."""
_FARTHEST_M = 5.0
"""Largest reach of an arm [m]. Larger numbers are probably millimetres."""


def read_trajectories(folder: Path, kinds: tuple[str, ...]) -> dict[str, NDArray[np.float64]]:
    """Read the published gripper tracks: motion -> [T, 3] positions in the robot's frame, z up [m].

    Args:
        folder: folder with `<kind>_traj.npy`, plain arrays [T, 3]. They are never unpickled.
        kinds: motions, keys of `RECORDED_START_M`.

    Raises:
        EpisodeError: a file is missing, damaged, of another shape, not finite, or not in metres.
    """
    return {kind: _read_track(Path(folder) / f"{kind}_traj.npy") for kind in kinds}


def recorded_episode(kind: str, name: str, published: Episode, track: NDArray[np.float64]) -> Episode:
    """Return a published recording in metres and seconds, with its gripper track, and with its cameras if known.

    Args:
        kind: motion, a key of `RECORDED_START_M`.
        name: name of the recording, for messages.
        published: T frames in units of the release.
        track: [T, 3] in the robot's frame [m].

    Returns:
        Episode with points [m] and gripper positions [T, 1, 3] [m] in the scene's frame, and times from 0 [s]. The meta
        has the prior standard deviations of scale and pose (`scale_sigma`, `pose_sigmas`). If the camera setup is
        known, points have camera and pixel, and the meta has `set_up`, `cameras`, `viewpoints`, `pinholes` and
        `clouds_shift_m`. This shift was added to the clouds so that the gripper starts as in the scene. Published
        predictions are dropped, since they are multipliers of another scene.

    Raises:
        EpisodeError: the track and the recording differ in the number of frames.
    """
    if len(track) != published.frame_count:
        raise EpisodeError(
            f"{kind}_traj.npy has {len(track)} rows, but {name} has {published.frame_count} clouds; a track has one row "
            "per cloud."
        )
    meta = {name: value for name, value in published.meta.items() if name != "predictions"}
    points = RELEASE_UNIT_M * published.points.astype(np.float64)
    set_up = recognised(points, published_set_ups())
    robot = None if set_up is None else set_up.robot_to_clouds_m
    sigmas = dict(_POSE_SIGMAS[robot is not None])
    meta |= {"scenario": f"recorded_{kind}", "scale_sigma": _SCALE_SIGMA, "pose_sigmas": sigmas}
    gripper, shift = in_clouds_frame(kind, track), np.zeros(3)
    if robot is not None:
        x, y, z = robot
        shift[:2] = gripper[0, :2] - [track[0, 1] + x, y - track[0, 0]]
        gripper[:, 2] = track[:, 2] + z
    episode = replace(
        published,
        points=(points + shift).astype(np.float32),
        times=np.arange(published.frame_count) / RECORDED_RATE_HZ,
        gripper=gripper[:, None],
        meta=meta,
    )
    return episode if set_up is None else _with_cameras(episode, points, set_up, shift)


def _with_cameras(episode: Episode, points: NDArray[np.float64], set_up: SetUp, shift: NDArray[np.float64]) -> Episode:
    """Add the cameras of a setup to an episode, and drop points that none of them saw.

    Args:
        points: [P, 3] points of the episode in the clouds' frame [m].
        shift: [3] vector that was added to them [m].
    """
    camera, pixel = set_up.seen(points)
    pinholes = {name: _shifted(pinhole, shift) for name, pinhole in set_up.pinholes.items()}
    return replace(
        episode,
        camera=camera.astype(np.uint8),
        pixel=pixel.astype(np.uint16),
        meta={
            **episode.meta,
            "set_up": set_up.name,
            "clouds_shift_m": shift.tolist(),
            "cameras": list(pinholes),
            "viewpoints": {name: pinhole.position.tolist() for name, pinhole in pinholes.items()},
            "pinholes": {name: pinhole.described() for name, pinhole in pinholes.items()},
        },
    ).select(camera >= 0)


def _shifted(pinhole: Pinhole, shift: NDArray[np.float64]) -> Pinhole:
    pose = pinhole.T_camera_scene.copy()
    pose[:, 3] -= pose[:, :3] @ shift
    return replace(pinhole, T_camera_scene=pose)


def in_clouds_frame(kind: str, track: NDArray[np.float64]) -> NDArray[np.float64]:
    """Transform a track [T, 3] from the robot's frame to the scene's frame [m], by a rotation and a translation."""
    way = track - track[0]
    x, y, lift = RECORDED_START_M[kind]
    return np.stack([x + way[:, 1], y - way[:, 0], track[:, 2] + lift], axis=1)


def _read_track(path: Path) -> NDArray[np.float64]:
    if not path.is_file():
        raise EpisodeError(
            f"No such track: {path}. --trajectories takes the folder of the published data that holds lift_traj.npy and "
            "fold_traj.npy."
        )
    track = load_npy(path)
    if not isinstance(track, np.ndarray):
        raise EpisodeError(
            f"{path} holds a pickled {type(track).__name__}; a track is a plain array [frames, 3] of metres."
        )
    if track.dtype.kind not in "fiu":
        raise EpisodeError(f"{path} holds {track.dtype} values; a track holds numbers.")
    if track.ndim != 2 or track.shape[1] != 3 or len(track) < 2:
        raise EpisodeError(f"{path} has shape {list(track.shape)}; a track has shape [frames, 3] with two frames or more.")
    track = track.astype(np.float64)
    bad = np.flatnonzero(~np.isfinite(track).all(axis=1))
    if len(bad):
        raise EpisodeError(f"{path}: row {bad[0]} is {track[bad[0]].tolist()}; a track holds finite positions in metres.")
    farthest = float(np.abs(track).max())
    if farthest > _FARTHEST_M:
        raise EpisodeError(
            f"{path} holds a coordinate of {farthest:.4g}; positions are metres, at most {_FARTHEST_M:g} from the base."
        )
    return track
