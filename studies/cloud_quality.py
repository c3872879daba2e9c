"""How well clouds were made of a synthetic raw episode, against its truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from diffcloud.errors import EpisodeError
from diffcloud.io.episodes import Episode
from diffcloud.io.raw_episodes import RawEpisode
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.sensing.cameras import inverse, transform
from diffcloud.sensing.depth_camera import DepthNoise
from diffcloud.sensing.recorder import ROBOT, TABLE, Truth, caster

Floats = NDArray[np.float64]

FLAT_M = 0.02
"""A cloth whose every node is less than this above the table lies flat."""
_DEVIATIONS = 4.0


@dataclass(frozen=True)
class CloudFigures:
    """Of each frame: arrays [T]."""

    points: NDArray[np.int64]
    robot: NDArray[np.int64]
    """Points whose pixel shows the robot."""
    table: NDArray[np.int64]
    lost: Floats
    """Part of the visible cloth's measurements that is not in the cloud. A flying pixel, farther from the cloth than noise
    explains, measures no cloth and does not count."""
    cloud_to_cloth_m: Floats
    """RMS distance of the points to the true cloth [m]."""
    cloth_to_cloud_m: Floats
    """RMS distance of the visible true cloth, a point for each pixel, to the cloud [m]."""
    flat: NDArray[np.bool_]


def evaluate_clouds(episode: Episode, raw: RawEpisode, truth: Truth, noise: DepthNoise | None = None) -> CloudFigures:
    """Compare clouds with the truth.

    Args:
        episode: made of `raw`, with camera and pixel of each point.
        noise: of the cameras.

    Raises:
        EpisodeError: points without camera and pixel.
    """
    if episode.camera is None or episode.pixel is None:
        raise EpisodeError("The clouds do not say which pixel each point is of; preprocess the raw episode again.")
    noise = noise or DepthNoise()
    names = list(raw.cameras)
    world = raw.placement.to_world(episode.points.astype(np.float64))
    floor = float(truth.nodes[..., 2].min())
    rows = []
    for frame in range(episode.frame_count):  # frames are ragged; each is vectorised
        chosen = slice(int(episode.offsets[frame]), int(episode.offsets[frame + 1]))
        camera, pixel, points = episode.camera[chosen], episode.pixel[chosen], world[chosen]
        images = np.array([truth.labels(name, frame) for name in names])
        label = images[camera, pixel[:, 1], pixel[:, 0]]
        surface = caster([SurfaceMesh(truth.nodes[frame], truth.faces)])
        off = surface.compute_distance(points.astype(np.float32), nthreads=1).numpy()
        visible, measured, kept = [], 0, 0
        for index, name in enumerate(names):
            info = raw.cameras[name].info
            cloth, where = truth.visible_cloth(name, info.intrinsics, frame)
            visible.append(cloth)
            depth_m = raw.cameras[name].depth(frame)[where[:, 1], where[:, 0]] * info.depth_scale_m
            z = transform(inverse(truth.T_world_camera[name]), cloth)[:, 2]
            good = (depth_m > 0) & (np.abs(depth_m - z) <= _DEVIATIONS * noise.sigma_m(z))
            taken = np.zeros(images[index].shape, dtype=bool)
            mine = camera == index
            taken[pixel[mine, 1], pixel[mine, 0]] = True
            measured += int(good.sum())
            kept += int(taken[where[good, 1], where[good, 0]].sum())
        back, _ = cKDTree(points).query(np.concatenate(visible))
        rows.append(
            (
                len(points),
                int((label == ROBOT).sum()),
                int((label == TABLE).sum()),
                1 - kept / max(1, measured),
                float(np.sqrt(np.mean(np.square(off)))),
                float(np.sqrt(np.mean(np.square(back)))),
                float(truth.nodes[frame][:, 2].max()) - floor < FLAT_M,
            )
        )
    points_, robot, table, lost, forth, back_, flat = (np.array(column) for column in zip(*rows, strict=True))
    return CloudFigures(points_, robot, table, lost, forth, back_, flat)


def visible_clouds(raw: RawEpisode, truth: Truth) -> list[Floats]:
    """[P, 3] of each frame [m]: what faultless cameras in their true places see of the cloth, in the base frame."""
    count = min(len(camera.frames) for camera in raw.cameras.values())
    return [
        np.concatenate(
            [truth.visible_cloth(name, camera.info.intrinsics, frame)[0] for name, camera in raw.cameras.items()]
        )
        for frame in range(count)
    ]
