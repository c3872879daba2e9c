"""What stands still beside the cloth at a known place (the pole, the hook), taken out of clouds.

A network learns little from points that are the same in every cloud: of a cloud of the published band, three quarters show
the pole.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffcloud.mesh.topology import SurfaceMesh

_PAIRS = 2**21
"""Points times triangles that are measured at once: bounds the memory."""


@dataclass(frozen=True)
class Background:
    """A body, and how near a point must be to count as the body's."""

    corners: Tensor
    """[F, 3, 3] of the body's triangles."""
    reach: float
    """[length unit]"""

    @staticmethod
    def build(body: SurfaceMesh, reach: float, *, device: torch.device | str = "cpu") -> Background:
        return Background(torch.as_tensor(body.nodes[body.faces], dtype=torch.float32, device=device), reach)

    def holds(self, points: Tensor) -> Tensor:
        """bool [...] of float32 [..., 3]: nearer to the body than the reach."""
        flat = points.reshape(-1, 3)
        box = self.corners.reshape(-1, 3)
        around = ((flat >= box.amin(0) - self.reach) & (flat <= box.amax(0) + self.reach)).all(-1).nonzero()[:, 0]
        held = torch.zeros(len(flat), dtype=torch.bool, device=flat.device)
        for some in around.split(max(1, _PAIRS // len(self.corners))):
            held[some] = squared_triangle_distances(flat[some], self.corners).amin(1) < self.reach**2
        return held.view(points.shape[:-1])

    def first_free(self, points: Tensor, count: int) -> Tensor:
        """The first points [..., count, 3] of [..., N, 3] that are not the body's. Where there are fewer they are repeated;
        where there is none, the body's are taken."""
        held = self.holds(points)
        order = held.to(torch.uint8).argsort(dim=-1, stable=True)
        free = (~held).sum(-1, keepdim=True)
        free = torch.where(free > 0, free, points.shape[-2])
        index = order.gather(-1, torch.arange(count, device=points.device).expand(*order.shape[:-1], -1) % free)
        return points.gather(-2, index[..., None].expand(*index.shape, 3))


def squared_triangle_distances(points: Tensor, corners: Tensor) -> Tensor:
    """[N, F] squared distances from points [N, 3] to triangles [F, 3, 3], which must have an area."""
    edges = corners.roll(-1, dims=1) - corners  # [F, 3, 3] from each corner to the next
    normal = torch.linalg.cross(edges[:, 0], edges[:, 1])  # [F, 3]
    from_corner = points[:, None, None] - corners  # [N, F, 3, 3]
    along = ((from_corner * edges).sum(-1) / edges.square().sum(-1)).clamp(0, 1)
    to_edges = (from_corner - along[..., None] * edges).square().sum(-1).amin(-1)
    # inside where the point is on the inner side of all three edges' planes
    inner = torch.linalg.cross(normal[:, None].expand_as(edges), edges)  # [F, 3, 3]
    inside = ((from_corner * inner).sum(-1) >= 0).all(-1)
    height = (from_corner[:, :, 0] * normal).sum(-1).square() / normal.square().sum(-1)
    return torch.where(inside, height, to_edges)
