"""Crop planes of each camera, estimated from a recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from diffcloud.io.episodes import Episode


def with_cut_planes(episode: Episode) -> Episode:
    """Add to the meta the height below which each camera's points were removed together with the table.

    Args:
        episode: recording in which each point has its camera, and whose meta has `cameras`.

    Returns:
        An episode whose meta has `cut_planes`: camera -> [a, b, c, d]. The camera's points satisfy a x + b y + c z >=
            d. The plane is horizontal, at the height of the camera's lowest point. A camera without points has no
            plane.
    """
    assert episode.camera is not None
    heights = {
        name: episode.points[episode.camera == number, 2].astype(np.float64)
        for number, name in enumerate(episode.meta["cameras"])
    }
    planes = {name: [0.0, 0.0, 1.0, float(z.min())] for name, z in heights.items() if len(z)}
    return replace(episode, meta={**episode.meta, "cut_planes": planes})
