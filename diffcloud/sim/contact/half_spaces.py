"""Planar obstacles as half-spaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diffcloud.mesh.topology import ClothMesh
from diffcloud.sim.surrounding import Surrounding


def half_spaces(mesh: ClothMesh, surrounding: Surrounding) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Planar obstacles n · x >= offset: normals [P, 3] and offsets [P] [m], on the side where most of the cloth starts."""
    found = [obstacle.plane() for obstacle in surrounding.obstacles]
    planes = [plane for plane in found if plane is not None]
    normals = np.array([normal for normal, _ in planes]).reshape(-1, 3)
    offsets = np.array([offset for _, offset in planes]).reshape(-1)
    side = np.where(np.median(mesh.nodes @ normals.T - offsets, axis=0) < 0, -1.0, 1.0)
    return normals * side[:, None], offsets * side
