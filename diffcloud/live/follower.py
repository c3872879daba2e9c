"""Follow a raw episode during its recording: convert the newest frame to clouds in the base frame.

Only frames that timestamps.csv lists are read, since their images are complete (`io.raw_episodes`). So this works with
any program that writes raw episodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffcloud.io.calibrations import Calibration
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.raw_episodes import RawCamera, read_description, read_raw_camera, read_robot_log
from diffcloud.sensing.cameras import Floats, depth_points, transform
from diffcloud.sensing.fusion import camera_pose


@dataclass(frozen=True)
class LiveCloud:
    """The newest cloud of one camera."""

    frame: int
    """Frame number."""
    t_s: float
    points: Floats
    """[P, 3] in the base frame [m], subsampled evenly. Robot, table and background are included."""
    colors: NDArray[np.uint8] | None
    """[P, 3] RGB. None if colour is not recorded."""
    T_world_camera: Floats
    """[4, 4]"""
    intrinsics: Intrinsics


@dataclass(frozen=True)
class LiveFrame:
    """The state of a recording."""

    status: str
    """recording, complete or stopped."""
    clouds: Mapping[str, LiveCloud]
    """Camera name -> its newest cloud. Cameras without frames are absent."""
    tool: Floats | None
    """[3] newest tool position in the base frame [m], if one is logged."""


class Follower:
    """Reads the newest frame of a raw recording while it is being recorded.

    Args:
        folder: folder of the raw recording, which may not exist yet.
        calibration: calibration of the cameras; by default the one in each camera.json.
        points: maximum number of points per camera.
    """

    def __init__(self, folder: Path, calibration: Calibration | None = None, *, points: int = 20_000) -> None:
        self._folder, self._calibration, self._points = folder, calibration, points
        self._shown: tuple[object, ...] | None = None
        self._poses: dict[str, Floats] = {}

    def newest(self) -> LiveFrame | None:
        """Return the current state, or None if the last call returned the same state or the recording does not exist yet.

        Raises:
            EpisodeError: a file is damaged, or a camera is not calibrated.
            CalibrationError: an unreadable calibration, or one without a camera of the episode.
        """
        if not (self._folder / "episode.json").is_file():
            return None
        description = read_description(self._folder)
        status = str(description.get("status") or "complete")
        every = {name: read_raw_camera(self._folder, name) for name in description["cameras"]}
        cameras = {name: camera for name, camera in every.items() if len(camera.frames)}
        shown = (status, *((name, int(camera.frames[-1])) for name, camera in cameras.items()))
        if shown == self._shown:
            return None
        self._shown = shown
        tool = None
        if description.get("robot") is not None:
            known = read_robot_log(self._folder / "robot.csv", torn=True).tool_position_m[-1:]
            tool = known[0] if len(known) and np.isfinite(known).all() else None
        return LiveFrame(status, {name: self._cloud(name, camera) for name, camera in cameras.items()}, tool)

    def _cloud(self, name: str, camera: RawCamera) -> LiveCloud:
        if name not in self._poses:  # camera.json is written before the first frame and does not change
            self._poses[name] = camera_pose(camera.info, self._folder, self._calibration)
        last = len(camera.frames) - 1
        depth, color = camera.depth(last), camera.color(last)
        step = max(1, int(np.ceil(np.sqrt(depth.size / self._points))))
        points, pixels = depth_points(depth, camera.info.intrinsics, camera.info.depth_scale_m, step=step)
        colors = None if color is None or color.shape[:2] != depth.shape else color[pixels[:, 1], pixels[:, 0]]
        world = transform(self._poses[name], points)
        return LiveCloud(
            int(camera.frames[-1]), float(camera.times[-1]), world, colors, self._poses[name], camera.info.intrinsics
        )
