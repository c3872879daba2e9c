"""A short synthetic raw episode: a sheet whose corner is lifted under the arm's gripper."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffcloud.mesh import grid_cloth
from diffcloud.sensing.depth_camera import published_cameras
from diffcloud.sensing.recorder import ClothMotion, RecorderSettings, record

FRAMES = 4
META = {"scenario": "lift", "fabric": "blue", "repeat": 1, "truth": {"stretch": 1.0, "mass": 2.0}}


def motion() -> ClothMotion:
    """A square of 0.24 m; the corner at +x +y rises by 4 cm a frame and draws what is near along."""
    cloth = grid_cloth(7, 7, 0.24, 0.24)
    start = cloth.nodes - cloth.nodes.mean(axis=0) + [0.0, 0.0, 0.002]
    corner = int(start[:, :2].sum(axis=1).argmax())
    nearness = np.exp(-np.square(np.linalg.norm(start - start[corner], axis=1) / 0.1))
    rise = 0.04 * np.arange(FRAMES)[:, None] * nearness
    nodes = np.repeat(start[None], FRAMES, axis=0)
    nodes[..., 2] += rise
    nodes[..., 1] -= 0.4 * rise
    return ClothMotion(nodes, cloth.faces, 0.1 * np.arange(FRAMES), [corner])


def write_recorded_episode(folder: Path, *, seed: int = 3, **settings: object) -> Path:
    record(folder, motion(), published_cameras(), settings=RecorderSettings(**settings), seed=seed, meta=META)
    return folder
