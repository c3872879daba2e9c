"""Pictures for a quick visual check of a calibration, a mask or a merged cloud."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from diffcloud.io.episodes import Episode
from diffcloud.io.raw_episodes import RawCamera
from diffcloud.sensing.calibration.charuco import CameraViews, CharucoBoard
from diffcloud.sensing.calibration.hand_eye import HandEyeResult
from diffcloud.sensing.cameras import inverse, project, transform
from diffcloud.sensing.fusion import Seen

_SHOWN = 3
_DETECTED, _REPROJECTED = (0, 255, 0), (255, 0, 0)
_MASKED, _KEPT = np.array([230, 60, 60]), np.array([60, 200, 90])
_VIEWS = np.array([[31, 119, 180], [255, 127, 14], [44, 160, 44], [214, 39, 40]], dtype=np.uint8)
_MARGIN = 1.08


def reprojection_picture(
    cameras: Mapping[str, RawCamera],
    views: Mapping[str, CameraViews],
    T_world_gripper: NDArray[np.float64],
    board: CharucoBoard,
    found: HandEyeResult,
) -> NDArray[np.uint8]:
    """Draw detected corners as green circles and reprojected ones as red crosses, in a row of three views per camera.

    Returns:
        uint8 [H, W, 3] red, green, blue. Narrower rows are padded with black.
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


def mask_picture(cameras: Mapping[str, RawCamera], parts: Mapping[str, Seen]) -> NDArray[np.uint8]:
    """Show each camera's image side by side, with masked pixels in red and kept cloth pixels in green.

    Depth in grey replaces missing colour images.

    Returns:
        uint8 [H, W, 3] red, green, blue. Lower images are padded with black.
    """
    tiles = []
    for name, part in parts.items():
        image = cameras[name].color(part.image)
        if image is None:
            depth = cameras[name].depth(part.image)
            image = np.repeat((255.0 * depth / max(1, int(depth.max()))).astype(np.uint8)[..., None], 3, axis=2)
        tinted = image.astype(np.float64)
        kept = np.zeros(image.shape[:2], dtype=bool)
        kept[part.pixels[:, 1], part.pixels[:, 0]] = True
        for where, color in ((part.spoilt.any, _MASKED), (kept, _KEPT)):
            tinted[where] = 0.45 * tinted[where] + 0.55 * color
        tiles.append(tinted.astype(np.uint8))
    height = max(tile.shape[0] for tile in tiles)
    return np.concatenate([np.pad(tile, ((0, height - len(tile)), (0, 0), (0, 0))) for tile in tiles], axis=1)


def cloud_picture(episode: Episode, frame: int, *, size: int = 240) -> NDArray[np.uint8]:
    """Draw a merged cloud from above, from the front (along y) and from the side (along x), coloured by camera.

    Args:
        size: size of each of the three squares [px].

    Returns:
        uint8 [size, 3 size, 3] red, green, blue on white, with x to the right or z upwards.
    """
    points = episode.frame(frame).astype(np.float64)
    camera = (
        np.zeros(len(points), dtype=np.int64)
        if episode.camera is None
        else episode.camera[episode.offsets[frame] : episode.offsets[frame + 1]].astype(np.int64)
    )
    low, high = points.min(axis=0), points.max(axis=0)
    scale = (size - 1) / (_MARGIN * max(float((high - low).max()), 1e-9))
    tiles = []
    for across, up in ((0, 1), (0, 2), (1, 2)):
        place = np.rint((points - 0.5 * (low + high))[:, [across, up]] * [scale, -scale] + 0.5 * (size - 1)).astype(int)
        tile = np.full((size, size, 3), 255, dtype=np.uint8)
        tile[place[:, 1], place[:, 0]] = _VIEWS[camera % len(_VIEWS)]
        tiles.append(tile)
    return np.concatenate(tiles, axis=1)
