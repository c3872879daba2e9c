"""A short synthetic raw episode: a sheet whose corner is lifted under the arm's gripper."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from diffcloud.mesh import grid_cloth
from diffcloud.sensing.depth_camera import published_cameras
from diffcloud.sensing.recorder import ClothMotion, RecorderSettings, record
from diffcloud.sim.motion import Keyframe, Motion

FRAMES = 4
META = {"scenario": "lift", "fabric": "blue", "repeat": 1, "truth": {"stretching": 1.0, "density": 2.0}}


LIFT = ((0.0, 0.0, 0.0), (0.0, -0.14, 0.40))
FOLD = ((0.0, 0.0, 0.0), (0.0, 0.12, 0.26), (0.0, 0.28, 0.08))
"""Ways of a corner, towards the middle [m]."""


def motion() -> ClothMotion:
    """A square of 0.24 m; the corner at +x +y rises by 4 cm a frame and draws what is near along."""
    return drawn_along(np.array([0.0, -0.016, 0.04]) * np.arange(FRAMES)[:, None])


def smooth_motion(way: tuple[tuple[float, float, float], ...], *, speed: float = 1.0, frames: int = 10) -> ClothMotion:
    """The corner of a diamond goes a way within 2.5 s / `speed`, at rest before and after."""
    keys = [Keyframe(index / (len(way) - 1), place) for index, place in enumerate(way)]
    _, displacement = Motion(tuple(keys)).at(np.linspace(0, 1, frames))
    outwards = (1.0, 1.0) if way[-1][1] < 0 else (-1.0, -1.0)
    return drawn_along(displacement, outwards=outwards, yaw_deg=45.0, interval=2.5 / speed / (frames - 1))


def drawn_along(
    displacement: np.ndarray,
    *,
    outwards: tuple[float, float] = (1.0, 1.0),
    yaw_deg: float = 0.0,
    interval: float = 0.1,
) -> ClothMotion:
    """A corner is displaced by [T, 3] [m], and what is near it along with it.

    Args:
        outwards: where from the middle it lies before the cloth is turned by `yaw_deg`.
        interval: between frames [s].
    """
    cloth = grid_cloth(7, 7, 0.24, 0.24)
    flat = cloth.nodes - cloth.nodes.mean(axis=0)
    corner = int((flat[:, :2] @ outwards).argmax())
    turned: np.ndarray = Rotation.from_euler("z", yaw_deg, degrees=True).apply(flat)
    start = turned + np.array([0.0, 0.0, 0.002])
    nearness = np.exp(-np.square(np.linalg.norm(start - start[corner], axis=1) / 0.1))
    nodes = start + displacement[:, None] * nearness[:, None]
    return ClothMotion(nodes, cloth.faces, interval * np.arange(len(nodes)), [corner])


def write_recorded_episode(
    folder: Path, *, seed: int = 3, seen: ClothMotion | None = None, size: tuple[int, int] = (424, 240), **settings: object
) -> Path:
    shown, cameras = motion() if seen is None else seen, published_cameras(*size)
    record(folder, shown, cameras, settings=RecorderSettings(**settings), seed=seed, meta=META)
    return folder
