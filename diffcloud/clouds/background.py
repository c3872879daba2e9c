"""Removes the points of a static body at a known position (the pole, the hook) from clouds.

Points that are the same in every cloud contain little information for a network. In a cloud of the published band, three
quarters of the points belong to the pole.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffcloud.mesh.topology import SurfaceMesh

_PAIRS = 2**21
"""Upper bound of the number of points times triangles per batch, to limit the memory."""


@dataclass(frozen=True)
class Background:
    """A body, and the distance within which points count as points of the body."""

    corners: Tensor
    """[F, 3, 3] corners of the body's triangles."""
    reach: float
    """Distance [length unit of the scene]."""

    @staticmethod
    def build(body: SurfaceMesh, reach: float, *, device: torch.device | str = "cpu") -> Background:
        return Background(torch.as_tensor(body.nodes[body.faces], dtype=torch.float32, device=device), reach)

    def holds(self, points: Tensor) -> Tensor:
        """Whether points [..., 3] are closer to the body than `reach`, bool [...]."""
        flat = points.reshape(-1, 3)
        box = self.corners.reshape(-1, 3)
        around = ((flat >= box.amin(0) - self.reach) & (flat <= box.amax(0) + self.reach)).all(-1).nonzero()[:, 0]
        held = torch.zeros(len(flat), dtype=torch.bool, device=flat.device)
        for some in around.split(max(1, _PAIRS // len(self.corners))):
            held[some] = squared_triangle_distances(flat[some], self.corners).amin(1) < self.reach**2
        return held.view(points.shape[:-1])

    def first_free(self, points: Tensor, count: int) -> Tensor:
        """The first `count` points [..., count, 3] of [..., N, 3] that do not belong to the body. If there are fewer, they
        are repeated. If there are none, points of the body are returned."""
        held = self.holds(points)
        order = held.to(torch.uint8).argsort(dim=-1, stable=True)
        free = (~held).sum(-1, keepdim=True)
        free = torch.where(free > 0, free, points.shape[-2])
        index = order.gather(-1, torch.arange(count, device=points.device).expand(*order.shape[:-1], -1) % free)
        return points.gather(-2, index[..., None].expand(*index.shape, 3))


def squared_triangle_distances(points: Tensor, corners: Tensor) -> Tensor:
    """Squared distances [N, F] from points [N, 3] to triangles [F, 3, 3], which must have a nonzero area."""
    edges = corners.roll(-1, dims=1) - corners  # [F, 3, 3] vectors from each corner to the next
    normal = torch.linalg.cross(edges[:, 0], edges[:, 1])  # [F, 3]
    from_corner = points[:, None, None] - corners  # [N, F, 3, 3]
    along = ((from_corner * edges).sum(-1) / edges.square().sum(-1)).clamp(0, 1)
    to_edges = (from_corner - along[..., None] * edges).square().sum(-1).amin(-1)
    # A point is inside if it is on the inner side of the planes through all three edges.
    inner = torch.linalg.cross(normal[:, None].expand_as(edges), edges)  # [F, 3, 3]
    inside = ((from_corner * inner).sum(-1) >= 0).all(-1)
    height = (from_corner[:, :, 0] * normal).sum(-1).square() / normal.square().sum(-1)
    return torch.where(inside, height, to_edges)
