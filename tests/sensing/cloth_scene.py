"""A cloth on a table under the arm, ray-cast into two small cameras: a raw episode with the truth of every pixel."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.raw_episodes import CameraInfo, RawEpisodeWriter, RobotSample
from diffcloud.sensing.cameras import looking_at
from diffcloud.sensing.masking import RobotMask, View
from diffcloud.sensing.robot import gen3

INTRINSICS = Intrinsics(160, 120, 154.0, 153.0, 79.0, 60.0)
TABLE, CLOTH, ROBOT = 0, 1, 2
COLORS = np.array([[120, 110, 100], [40, 60, 180], [200, 200, 200]], dtype=np.uint8)
CLOTH_LOW, CLOTH_HIGH = np.array([0.45, -0.15]), np.array([0.70, 0.15])
TOOL_M = np.array([0.60, 0.05, 0.12])
STEP_M = np.array([0.0, -0.02, 0.02])
"""Motion of the tool from frame to frame."""
PLACES = {"overhead": (1.05, 0.02, 0.75), "side": (0.62, -0.70, 0.40)}
SETTINGS = {"depth_jump_m": 0.05, "workspace_m": ((0.35, -0.35, -0.05), (0.85, 0.35, 0.5))}
"""Of small images: neighbouring pixels are four times as far apart as in the camera's own."""


@dataclass(frozen=True)
class ClothScene:
    folder: Path
    labels: dict[str, list[np.ndarray]]
    """[H, W] of each frame: TABLE, CLOTH or ROBOT."""
    views: dict[str, View]


def views() -> dict[str, View]:
    target = (0.58, 0.0, 0.05)
    return {name: View(INTRINSICS, looking_at(place, target)) for name, place in PLACES.items()}


def cloth_height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A sheet 2 mm above the table, with a ridge 5 cm high."""
    return 0.002 + 0.05 * np.exp(-(((x - 0.62) / 0.03) ** 2))


@cache
def still_depth(name: str) -> tuple[np.ndarray, np.ndarray]:
    """(z-depth [m], label) of each pixel without the robot. The sheet is found by marching along the rays."""
    view = views()[name]
    direction = view.directions @ view.T_world_camera[:3, :3].T
    origin = view.T_world_camera[:3, 3]
    depth = -origin[2] / direction[..., 2]
    depth = np.where(depth > 0, depth, np.inf)
    label = np.full(depth.shape, TABLE)
    for t in np.linspace(0.5, 1.6, 1101):
        point = origin + t * direction
        over = ((point[..., :2] > CLOTH_LOW) & (point[..., :2] < CLOTH_HIGH)).all(axis=-1)
        hit = over & (point[..., 2] < cloth_height(point[..., 0], point[..., 1])) & (label == TABLE) & (t < depth)
        depth, label = np.where(hit, t, depth), np.where(hit, CLOTH, label)
    return depth, label


def write_cloth_episode(
    folder: Path, *, frames: int = 3, noise_m: float = 0.001, colored: bool = True, shift_m: float = 0.0
) -> ClothScene:
    """A raw episode at 10 Hz.

    Args:
        noise_m: deviation of depth.
        shift_m: error of the second camera's stated place, along x.
    """
    robot, rng = gen3(), np.random.default_rng(0)
    solid = RobotMask(robot, robot_margin_m=0.003)  # the real arm is a little larger than its description
    seen = views()
    down = np.diag([1.0, -1.0, -1.0])
    joints = robot.inverse_kinematics(TOOL_M + np.arange(frames)[:, None] * STEP_M, rotations=down)
    infos = {}
    for index, (name, view) in enumerate(seen.items()):
        stated = view.T_world_camera.copy()
        stated[0, 3] += index * shift_m
        infos[name] = CameraInfo(name, f"00{index}", INTRINSICS, 0.0005, stated)
    labels: dict[str, list[np.ndarray]] = {name: [] for name in seen}
    robot_meta, meta = {"model": "Kinova Gen3"}, {"scenario": "lift", "fabric": "blue"}
    with RawEpisodeWriter(folder, infos, rate_hz=10.0, source="test", robot=robot_meta, durable=False, meta=meta) as writer:
        for frame in range(frames):
            writer.add_robot(RobotSample(frame / 10, joints[frame], 0.8))
            poses = robot.forward_kinematics(robot.configuration(joints[frame], 0.8))
            for name, view in seen.items():
                depth, label = still_depth(name)
                robot_depth = solid.surface(view, poses)
                depth, label = np.minimum(depth, robot_depth), np.where(robot_depth < depth, ROBOT, label)
                labels[name].append(label)
                noisy = depth + noise_m * rng.normal(size=depth.shape)
                image = np.where(depth < 3.0, np.rint(noisy / 0.0005), 0).astype(np.uint16)
                writer.add_frame(name, frame / 10, image, COLORS[label] if colored else None)
    return ClothScene(folder, labels, seen)
