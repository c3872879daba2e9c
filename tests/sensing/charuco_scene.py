"""Synthetic images of a ChArUco board on a gripper, seen by two cameras at the published places."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from diffcloud.io.camera_models import Intrinsics
from diffcloud.sensing.calibration.charuco import CharucoBoard
from diffcloud.sensing.cameras import inverse

BOARD = CharucoBoard(5, 7, 0.04, 0.03)
INTRINSICS = {
    "overhead": Intrinsics(640, 480, 614.910, 615.047, 314.035, 239.564),
    "side": Intrinsics(640, 480, 617.494, 617.375, 318.502, 244.709),
}
_TEXTURE_PX = 60  # a square
_FINER = 3


def camera_pose(position, forward):
    """[4, 4] of an upright camera."""
    forward = np.array(forward) / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = position
    return pose


CAMERAS = {
    "overhead": camera_pose([1.2477, 0.0431, 0.9373], [-0.573, 0.006, -0.819]),
    "side": camera_pose([0.7267, -0.7872, 0.4466], [0.031, 0.939, -0.343]),
}
GRIPPER_BOARD = np.eye(4)
GRIPPER_BOARD[:3, :3] = Rotation.from_euler("xyz", [4, -7, 93], degrees=True).as_matrix()
GRIPPER_BOARD[:3, 3] = [0.03, -0.02, 0.06]


def gripper_poses(count, rng, *, tilt_deg=20.0):
    """[P, 4, 4]: the board near (0.62, 0, 0.3), facing between the cameras, tilted at random about all axes."""
    centre = np.array([0.62, -0.05, 0.3])
    toward = sum((pose[:3, 3] - centre) / np.linalg.norm(pose[:3, 3] - centre) for pose in CAMERAS.values())
    z = -toward / np.linalg.norm(toward)  # the board's z points away from who looks at it
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    facing = np.column_stack([x, np.cross(z, x), z])
    poses = np.zeros((count, 4, 4))
    size = np.array([BOARD.columns, BOARD.rows, 0]) * BOARD.square_m
    for index in range(count):
        board = np.eye(4)
        tilt = Rotation.from_rotvec(np.deg2rad(rng.uniform(-tilt_deg, tilt_deg, 3)))
        board[:3, :3] = facing @ tilt.as_matrix()
        board[:3, 3] = centre + rng.uniform(-0.06, 0.06, 3) - board[:3, :3] @ (size / 2)
        poses[index] = board @ inverse(GRIPPER_BOARD)
    return poses


def render(T_camera_board, intrinsics, rng=None, board=BOARD):
    """uint8 [H, W, 3]: the board over a grey ground, antialiased, optionally with pixel noise."""
    width, height = board.columns * _TEXTURE_PX, board.rows * _TEXTURE_PX
    texture = board.opencv().generateImage((width, height), marginSize=0, borderBits=1)
    # texture pixel -> metres on the board: pixel centres at whole numbers, the board starts at the first pixel's edge
    metre = board.square_m / _TEXTURE_PX
    to_board = np.array([[metre, 0, metre / 2], [0, metre, metre / 2], [0, 0, 1]])
    to_image = intrinsics.matrix @ T_camera_board[:3, [0, 1, 3]] @ to_board
    # finer image: pixel u becomes the block of _FINER pixels around _FINER * u + (_FINER - 1) / 2
    finer = np.array([[_FINER, 0, (_FINER - 1) / 2], [0, _FINER, (_FINER - 1) / 2], [0, 0, 1]])
    size = (_FINER * intrinsics.width, _FINER * intrinsics.height)
    flags = {"flags": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_CONSTANT}
    image = cv2.warpPerspective(texture, finer @ to_image, size, borderValue=130, **flags)
    image = cv2.resize(image, (intrinsics.width, intrinsics.height), interpolation=cv2.INTER_AREA).astype(float)
    if rng is not None:
        image += rng.normal(size=image.shape) * 2.0
    return np.repeat(np.clip(np.rint(image), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def board_depth(T_camera_board, intrinsics, scale=1.0):
    """uint16 [H, W] in millimetres of the board's endless plane, times `scale`."""
    column, row = np.meshgrid(np.arange(intrinsics.width), np.arange(intrinsics.height))
    ray = np.stack(
        [(column - intrinsics.cx) / intrinsics.fx, (row - intrinsics.cy) / intrinsics.fy, np.ones(row.shape)], -1
    )
    normal = T_camera_board[:3, 2]
    depth = (normal @ T_camera_board[:3, 3]) / (ray @ normal)
    return np.where((depth > 0.2) & (depth < 4), np.rint(1000 * scale * depth), 0).astype(np.uint16)
