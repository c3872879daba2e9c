"""Noise-free episodes sampled from the whole surface of a known motion, without a camera."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from diffcloud.clouds.sampling import SurfaceSampler
from diffcloud.io.episodes import Episode
from diffcloud.mesh.topology import SurfaceMesh


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
    """Return a noise-free, fully observed episode, like the simulated targets of the paper.

    Points are sampled separately in every frame, uniformly by area on cloth and obstacle, also where they would be
    occluded. The episode has no gripper track, so that a fit moves the handles exactly as the scene does.

    Args:
        nodes: [T, V, 3] cloth nodes at each frame [m].
        faces: [F, 3].
        times: [T] [s].
        obstacle: a fixed body beside the cloth; None for the cloth alone.
        points: number of points per frame.
        seed: seed of the samples.
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
