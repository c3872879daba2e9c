"""Find out which camera saw each point of the published real recordings.

A published cloud merges the depth images of two cameras. Depths are whole millimetres and image coordinates are whole
pixels. So with the right camera pose, each point has whole coordinates in its image. `published_cameras.json` lists the
camera setups of the recordings. A recording has the setup for which all its points have whole coordinates.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib.resources import as_file, files

import numpy as np
from numpy.typing import NDArray

from diffcloud.io.episodes import Pinhole
from diffcloud.io.files import read_json

_WHOLE = 0.02
"""Tolerance for whole coordinates [px, mm]. With a wrong pose, one point in 16,000 meets it by chance."""
_RECOGNISED = 0.98
"""Fraction of the points that must fit a camera of the setup."""


@dataclass(frozen=True)
class SetUp:
    """Camera setup of some recordings, and the robot's position."""

    name: str
    pinholes: dict[str, Pinhole]
    """Camera name -> intrinsics and pose in the clouds' frame [m]."""
    robot_to_clouds_m: NDArray[np.float64] | None
    """[3] (x, y, z): robot point r is (r_y + x, y - r_x, r_z + z) in the clouds' frame. None if unknown."""

    def seen(self, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return camera index [N] (-1 for none) and pixel [N, 2] (column, row) of points [N, 3] in the clouds' frame
        [m]."""
        camera, pixel, least = (
            np.full(len(points), -1),
            np.zeros((len(points), 2), dtype=np.int64),
            np.full(len(points), _WHOLE),
        )
        for number, pinhole in enumerate(self.pinholes.values()):
            x, y, z = pinhole.T_camera_scene[:, :3] @ points.T + pinhole.T_camera_scene[:, 3:]
            (fx, fy), (cx, cy) = pinhole.focal, pinhole.centre
            found = np.stack([fx * x / z + cx, fy * y / z + cy, 1e3 * z], axis=1)
            whole = np.rint(found)
            error = np.abs(found - whole).max(axis=1)
            inside = (z > 0) & ((whole[:, :2] >= 0) & (whole[:, :2] < [pinhole.width, pinhole.height])).all(axis=1)
            closer = inside & (error < least)
            camera[closer], pixel[closer], least[closer] = number, whole[closer, :2], error[closer]
        return camera, pixel


@cache
def published_set_ups() -> tuple[SetUp, ...]:
    """Return all known camera setups."""
    with as_file(files("diffcloud.io") / "published_cameras.json") as path:
        told = read_json(path)
    width, height = told["size"]
    return tuple(
        SetUp(
            name,
            {
                camera: Pinhole(width, height, (fx, fy), (cx, cy), np.array(entry["T_camera_clouds"][camera]))
                for camera, (fx, fy, cx, cy) in told["intrinsics"].items()
            },
            None if entry["robot_to_clouds_m"] is None else np.array(entry["robot_to_clouds_m"]),
        )
        for name, entry in told["set_ups"].items()
    )


def recognised(points: NDArray[np.float64], set_ups: Iterable[SetUp]) -> SetUp | None:
    """Return the setup whose cameras saw points [N, 3] in the clouds' frame [m], or None."""
    for set_up in set_ups:
        if (set_up.seen(points)[0] >= 0).mean() >= _RECOGNISED:
            return set_up
    return None
