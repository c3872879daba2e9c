"""Visibility of points on a mesh from viewpoints."""

from __future__ import annotations

import torch
from torch import Tensor


def seen_places(
    positions: Tensor, faces: Tensor, points: Tensor, viewpoints: Tensor, *, near: float, blind: Tensor | None = None
) -> Tensor:
    """Whether points [B, L, N, 3] are visible from at least one viewpoint [B, C, 3], bool [B, L, N]. Faces [F, 3] occlude.

    Args:
        positions: [B, L, V, 3] nodes of the meshes.
        near: faces closer than this to a point do not occlude it.
        blind: bool [B, L, N, C] True if a viewpoint cannot see a point anyway; None for none.
    """
    from diffcloud.clouds.surface import find_hidden  # numba takes a moment to import

    states = positions.shape[0] * positions.shape[1]
    eyes = viewpoints[:, None].expand(-1, positions.shape[1], -1, -1)
    nodes, places, eyes = (part.detach().reshape(states, -1, 3).contiguous() for part in (positions, points, eyes))
    shape = (states, places.shape[1], eyes.shape[1])
    unable = torch.zeros(shape, dtype=torch.int64) if blind is None else blind.long().reshape(shape)
    hidden = find_hidden(places.numpy(), eyes.numpy(), unable.numpy(), nodes.numpy(), faces.numpy(), near)
    return torch.from_numpy(hidden == 0).reshape(points.shape[:-1])
