"""Planes at which the points of each camera were cut off, found from a recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from diffcloud.io.episodes import Episode


def with_cut_planes(episode: Episode) -> Episode:
    """State below which height each camera's points were removed together with the table.

    Args:
        episode: each point names its camera, and the meta lists the `cameras`.

    Returns:
        Its meta has `cut_planes`: camera -> [a, b, c, d]. The camera shows only points (x, y, z) of the scene with
        a x + b y + c z >= d. Here it is the height of the camera's lowest point. A camera without points has none.
    """
    assert episode.camera is not None
    heights = {
        name: episode.points[episode.camera == number, 2].astype(np.float64)
        for number, name in enumerate(episode.meta["cameras"])
    }
    planes = {name: [0.0, 0.0, 1.0, float(z.min())] for name, z in heights.items() if len(z)}
    return replace(episode, meta={**episode.meta, "cut_planes": planes})
