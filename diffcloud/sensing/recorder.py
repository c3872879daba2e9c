"""Recorders without hardware: what depth cameras would have seen of a known motion, and its whole surface."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from diffcloud.clouds.sampling import SurfaceSampler
from diffcloud.io.episodes import Episode
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.sensing.depth_camera import DepthCamera

_SURFACE_POINTS = 60_000
"""Several per pixel of a hand-sized cloth, so that the z-buffer has no holes."""


def record(
    nodes: NDArray[np.float64],
    faces: NDArray[np.int64],
    times: NDArray[np.float64],
    cameras: tuple[DepthCamera, ...],
    *,
    grasped: list[int],
    seed: int,
    meta: Mapping[str, Any],
) -> Episode:
    """Record a motion.

    Args:
        nodes: [T, V, 3] of the cloth at each frame [m].
        faces: [F, 3].
        times: [T] [s].
        grasped: nodes whose mean is the gripper's position.
        seed: of all noise.
    """
    rng = np.random.default_rng(seed)
    generator = torch.Generator().manual_seed(seed)
    sampler = SurfaceSampler.build(torch.as_tensor(faces), _SURFACE_POINTS, generator=generator)
    frames, camera_ids, pixels, sigmas = [], [], [], []
    for frame in nodes:  # images are taken one after the other; each is vectorised
        surface = sampler.sample(torch.as_tensor(frame)).numpy()
        views = [camera.see(surface, rng) for camera in cameras]
        frames.append(np.concatenate([points for points, _, _ in views]))
        camera_ids.append(np.repeat(np.arange(len(cameras), dtype=np.uint8), [len(points) for points, _, _ in views]))
        pixels += [pixel for _, pixel, _ in views]
        sigmas += [sigma for _, _, sigma in views]
    return Episode(
        points=np.concatenate(frames).astype(np.float32),
        offsets=np.cumsum([0, *(len(frame) for frame in frames)], dtype=np.int64),
        times=times,
        gripper=nodes[:, grasped].mean(axis=1),
        camera=np.concatenate(camera_ids),
        pixel=np.concatenate(pixels),
        sigma=np.concatenate(sigmas),
        meta=meta,
    )


def sample_surface(
    nodes: NDArray[np.float64],
    faces: NDArray[np.int64],
    times: NDArray[np.float64],
    obstacle: SurfaceMesh | None,
    *,
    points: int,
    seed: int,
    meta: Mapping[str, Any],
) -> Episode:
    """A fully observed episode without noise, as the paper's simulated targets are.

    Points are drawn anew in every frame, uniformly by area, on the cloth and the obstacle together; also where nothing
    could see them. The episode carries no gripper track, so that a fit moves the handles exactly as the scene does.

    Args:
        nodes: [T, V, 3] of the cloth at each frame [m].
        faces: [F, 3].
        times: [T] [s].
        obstacle: a fixed body beside the cloth; None for the cloth alone.
        points: in each frame.
        seed: of the points.
    """
    generator = torch.Generator().manual_seed(seed)
    if obstacle is not None:
        faces = np.concatenate([faces, obstacle.faces + nodes.shape[1]])
        nodes = np.concatenate([nodes, np.broadcast_to(obstacle.nodes, (len(nodes), *obstacle.nodes.shape))], axis=1)
    surface = torch.as_tensor(faces)
    clouds = [
        SurfaceSampler.build(surface, points, generator=generator).sample(torch.as_tensor(frame)).numpy() for frame in nodes
    ]
    return Episode.from_frames(clouds, times, meta={**meta, "noise_free": True})
