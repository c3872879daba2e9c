"""Which places on a mesh viewpoints see."""

from __future__ import annotations

import torch
from torch import Tensor


def seen_places(
    positions: Tensor, faces: Tensor, points: Tensor, viewpoints: Tensor, *, near: float, blind: Tensor | None = None
) -> Tensor:
    """bool [B, L, N] which points [B, L, N, 3] no face [F, 3] hides from all viewpoints [B, C, 3].

    Args:
        positions: [B, L, V, 3] nodes of the meshes.
        near: what is nearer to a point hides nothing.
        blind: bool [B, L, N, C] which viewpoints cannot see a point anyway; None for none.
    """
    from diffcloud.clouds.surface import find_hidden  # numba takes a moment to import

    states = positions.shape[0] * positions.shape[1]
    eyes = viewpoints[:, None].expand(-1, positions.shape[1], -1, -1)
    nodes, places, eyes = (part.detach().reshape(states, -1, 3).contiguous() for part in (positions, points, eyes))
    shape = (states, places.shape[1], eyes.shape[1])
    unable = torch.zeros(shape, dtype=torch.int64) if blind is None else blind.long().reshape(shape)
    hidden = find_hidden(places.numpy(), eyes.numpy(), unable.numpy(), nodes.numpy(), faces.numpy(), near)
    return torch.from_numpy(hidden == 0).reshape(points.shape[:-1])
