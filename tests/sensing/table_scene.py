"""A table with two boxes, seen by two small depth cameras: a raw episode that tests write, and then damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.raw_episodes import CameraInfo, RawEpisodeWriter, RobotSample
from diffcloud.sensing.cameras import looking_at, rays

INTRINSICS = Intrinsics(160, 120, 154.0, 154.0, 79.5, 59.5)
BOXES = (((0.50, -0.05, 0.0), (0.60, 0.05, 0.12)), ((0.68, 0.10, 0.0), (0.80, 0.14, 0.05)))
SERIALS = {"overhead": "036522070001", "side": "036522070002"}
HOME_RAD = np.deg2rad([0.0, 15.0, 180.0, -130.0, 0.0, 55.0, 90.0])


def poses() -> dict[str, np.ndarray]:
    return {
        "overhead": looking_at((1.1, 0.05, 0.8), (0.62, 0.0, 0.0)),
        "side": looking_at((0.7, -0.8, 0.4), (0.62, 0.0, 0.0)),
    }


def table_depth(pose: np.ndarray, intrinsics: Intrinsics = INTRINSICS) -> np.ndarray:
    """uint16 [H, W] in millimetres of the table z = 0 and the boxes."""
    column, row = np.meshgrid(np.arange(intrinsics.width), np.arange(intrinsics.height))
    direction = rays(np.stack([column, row], axis=-1).astype(float), intrinsics) @ pose[:3, :3].T
    origin = pose[:3, 3]
    with np.errstate(divide="ignore"):
        depth = np.where(direction[..., 2] < 0, -origin[2] / direction[..., 2], np.inf)
        for low, high in BOXES:  # the slab method
            near = np.minimum((low - origin) / direction, (high - origin) / direction).max(axis=-1)
            far = np.maximum((low - origin) / direction, (high - origin) / direction).min(axis=-1)
            depth = np.where((near < far) & (near > 0), np.minimum(depth, near), depth)
    return np.where(depth < 4.0, np.rint(depth * 1000), 0).astype(np.uint16)


def camera_infos() -> dict[str, CameraInfo]:
    return {name: CameraInfo(name, SERIALS[name], INTRINSICS, 0.001, pose) for name, pose in poses().items()}


def robot_sample(t_s: float) -> RobotSample:
    return RobotSample(
        t_s,
        HOME_RAD + 0.01 * t_s,
        0.8,
        np.array([0.5767, 0.0013, 0.4337]),
        np.array([0.5, 0.5, 0.5, 0.5]),
        np.zeros(6),
    )


def write_table_episode(folder: Path, *, frames: int = 6, names: tuple[str, ...] = ("overhead", "side")) -> Path:
    """A faultless raw episode of `frames` frames at 10 Hz with a robot log at 20 Hz."""
    infos = {name: info for name, info in camera_infos().items() if name in names}
    robot = {"model": "Kinova Gen3"}
    with RawEpisodeWriter(folder, infos, rate_hz=10.0, source="test", robot=robot, durable=False) as writer:
        for row in range(2 * frames + 2):
            writer.add_robot(robot_sample(row / 20 - 0.05))
        for name, info in infos.items():
            depth = table_depth(info.T_world_camera)
            color = np.repeat((depth // 8).astype(np.uint8)[..., None], 3, axis=2)
            for frame in range(frames):
                writer.add_frame(name, frame / 10, depth, color)
    return folder
