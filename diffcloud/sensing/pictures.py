"""Pictures that let a person judge a calibration at a glance."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from diffcloud.io.raw_episodes import RawCamera
from diffcloud.sensing.calibration import CameraViews, CharucoBoard, HandEyeResult
from diffcloud.sensing.cameras import inverse, project, transform

_SHOWN = 3
_DETECTED, _REPROJECTED = (0, 255, 0), (255, 0, 0)


def reprojection_picture(
    cameras: Mapping[str, RawCamera],
    views: Mapping[str, CameraViews],
    T_world_gripper: NDArray[np.float64],
    board: CharucoBoard,
    found: HandEyeResult,
) -> NDArray[np.uint8]:
    """Detected corners as green rings, reprojected ones as red crosses: a row of three views for each camera.

    Returns:
        uint8 [H, W, 3] red, green, blue. Narrower rows are filled with black.
    """
    import cv2

    rows = []
    for name, camera in views.items():
        tiles = []
        for index in np.unique(np.linspace(0, len(camera.views) - 1, _SHOWN).astype(int)):
            view = camera.views[index]
            color = cameras[name].color(view.frame)
            assert color is not None  # the board was found in it
            chain = inverse(found.T_world_camera[name]) @ T_world_gripper[view.pose] @ found.T_gripper_board
            again = project(transform(chain, board.corners()[view.numbers]), camera.intrinsics)
            image = np.ascontiguousarray(color)
            for seen, expected in zip(np.rint(view.pixels).astype(int), np.rint(again).astype(int), strict=True):
                cv2.circle(image, (int(seen[0]), int(seen[1])), 4, _DETECTED, 1, cv2.LINE_AA)
                cv2.drawMarker(image, (int(expected[0]), int(expected[1])), _REPROJECTED, cv2.MARKER_CROSS, 6, 1)
            tiles.append(image)
        rows.append(np.concatenate(tiles, axis=1))
    width = max(row.shape[1] for row in rows)
    return np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows])
