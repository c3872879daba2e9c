"""Differentiable point sampling on triangle meshes (paper, section III-B).

A point is x = u p1 + v p2 + w p3 on a face that is chosen with probability proportional to its area in world space. So its
derivative with respect to the corners is exactly (u, v, w). Random numbers are sampled once, when the sampler is made
(common random numbers). So the loss is a deterministic function of the node positions. The choice of faces depends on the
areas, but is not differentiated, as in the paper.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffcloud.errors import ConfigError

_TINY = 1e-30


@dataclass(frozen=True)
class SurfacePoints:
    """Points at fixed barycentric positions on the faces of a mesh."""

    nodes: Tensor
    """[..., N, 3] nodes of each point's face."""
    barycentric: Tensor
    """[..., N, 3] barycentric coordinates of each point."""

    def of(self, values: Tensor) -> Tensor:
        """Positions of the points [..., N, 3], or their derivatives, from those of the nodes [..., V, 3].
        Differentiable."""
        return (self.barycentric[..., None, :] @ self.corners(values)).squeeze(-2)

    def corners(self, values: Tensor) -> Tensor:
        """Values [..., N, 3, 3] at the corners of each point's face, from node values [..., V, 3]."""
        flat = values.reshape(-1, *values.shape[-2:])
        nodes = self.nodes.reshape(len(flat), -1, 1).expand(-1, -1, 3)
        return flat.gather(1, nodes).reshape(*self.nodes.shape, 3)


@dataclass(frozen=True)
class SurfaceSampler:
    """Samples N points on the surface of a mesh."""

    faces: Tensor
    """[F, 3] node indices of the faces that may be sampled."""
    choice: Tensor
    """[N] in [0, 1): selects the face, stratified so that each face gets its share."""
    barycentric: Tensor
    """[N, 3] barycentric coordinates (u, v, w), uniform on the triangle."""

    @staticmethod
    def build(
        faces: Tensor,
        points: int,
        *,
        generator: torch.Generator,
        subset: Tensor | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> SurfaceSampler:
        """Sample the random numbers.

        Args:
            faces: [F, 3] node indices.
            points: number N of points.
            generator: random number generator on the CPU.
            subset: indices of the faces that may be sampled (the paper's occlusion heuristic); None for all.

        Raises:
            ConfigError: no points, no faces, or an index out of range.
        """
        if points < 1:
            raise ConfigError(f"At least one point must be sampled, got {points}.")
        if subset is not None:
            if len(subset) == 0 or int(subset.min()) < 0 or int(subset.max()) >= len(faces):
                raise ConfigError(f"The face subset must hold indices in 0..{len(faces) - 1}, and at least one.")
            faces = faces[subset]
        device = faces.device
        stratum = torch.arange(points, dtype=dtype)
        choice = (stratum + torch.rand(points, dtype=dtype, generator=generator)) / points
        r1, r2 = torch.rand(2, points, dtype=dtype, generator=generator)
        return SurfaceSampler(faces, choice.to(device), uniform_barycentric(r1, r2).to(device))

    def draw(self, positions: Tensor) -> SurfacePoints:
        """Sample points [..., N] on the mesh at node positions [..., V, 3]."""
        flat = positions.reshape(-1, *positions.shape[-2:])
        nodes = _choose(flat, self.faces, self.choice, None)
        return SurfacePoints(
            nodes.reshape(*positions.shape[:-2], -1, 3), self.barycentric.expand(*positions.shape[:-2], -1, 3)
        )

    def sample(self, positions: Tensor) -> Tensor:
        """Positions of the sampled points [..., N, 3], for node positions [..., V, 3]."""
        return self.draw(positions).of(positions)


def points_on_faces(
    positions: Tensor, faces: Tensor, choice: Tensor, barycentric: Tensor, *, weights: Tensor | None = None
) -> Tensor:
    """Points [B, N, 3] on faces that are chosen in proportion to their area, for node positions [B, V, 3].

    Args:
        faces: [F, 3] node indices.
        choice: [N] or [B, N] in [0, 1): selects the face.
        barycentric: [N, 3] or [B, N, 3] barycentric coordinates on the face.
        weights: [F] or [B, F] factors on the areas; None for 1.
    """
    nodes = _choose(positions, faces, choice, weights)
    return SurfacePoints(nodes, barycentric).of(positions)


@torch.no_grad()
def _choose(positions: Tensor, faces: Tensor, choice: Tensor, weights: Tensor | None) -> Tensor:
    """Nodes [B, N, 3] of the selected faces."""
    corner = positions[:, faces]
    area = torch.linalg.cross(corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0])
    area = area.square().sum(-1).sqrt().clamp(min=_TINY)
    if weights is not None:
        area = area * weights
    cumulative = area.cumsum(-1)
    face = torch.searchsorted(cumulative, choice * cumulative[:, -1:], right=True)
    # Rounding can select the end of the list. The last face with a nonzero weight is where the sum stops growing.
    last = torch.searchsorted(cumulative, cumulative[:, -1:].contiguous())
    return faces[torch.minimum(face, last)]


def uniform_barycentric(first: Tensor, second: Tensor) -> Tensor:
    """Barycentric coordinates (u, v, w) [..., 3], uniform on a triangle, from two uniform numbers [...] in [0, 1)."""
    root = first.sqrt()
    return torch.stack([1 - root, root * (1 - second), root * second], dim=-1)
