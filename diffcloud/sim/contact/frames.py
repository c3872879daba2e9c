"""Normal and weights where two primitives meet, as ARCSim has them: projected along the common normal, not clamped.

Both kinds of pair obey one formula. With two edge vectors a, b and an offset d,

    point and face    a = y1 - y0,  b = y2 - y0,  d = x - y0
    two edges         a = p1 - p0,  b = q1 - q0,  d = q0 - p0

the normal is c/|c| with c = a × b, the places are α = (d × b)·c/|c|², β = (a × d)·c/|c|², and the four points are coplanar
where c·d = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffcloud.sim.contact.pairs import Pairs

_TINY = 1e-300

_SPAN = (
    ((0, -1, 1, 0), (0, -1, 0, 1), (1, -1, 0, 0)),  # point and face: a, b, d of the four points
    ((-1, 1, 0, 0), (0, 0, -1, 1), (-1, 0, 1, 0)),  # two edges
)
_WEIGHT = (
    ((1, 0, 0), (-1, 1, 1), (0, -1, 0), (0, 0, -1)),  # of 1, α, β: (1, -(1 - α - β), -α, -β)
    ((1, -1, 0), (0, 1, 0), (-1, 0, -1), (0, 0, 1)),  # (1 - α, α, -(1 + β), β)
)
_SIGN = ((1, -1, -1, -1), (1, 1, -1, -1))


@dataclass(frozen=True)
class MeetingPairs:
    """C pairs of both kinds in one list (entry, points and area as in `Pairs`)."""

    edge_edge: Tensor
    """[C] 1 for two edges, 0 for a point and a face."""
    entry: Tensor
    points: Tensor
    """[C, 4]"""
    primitives: Tensor
    """[C, 2]"""
    area: Tensor

    @staticmethod
    def join(pairs: tuple[Pairs, Pairs]) -> MeetingPairs:
        """(point-face, edge-edge) -> one list in that order."""
        kinds = [torch.full_like(pair.entry, int(pair.kind == "edge_edge")) for pair in pairs]
        fields = zip(*((pair.entry, pair.points, pair.primitives, pair.area) for pair in pairs), strict=True)
        return MeetingPairs(torch.cat(kinds), *(torch.cat(parts) for parts in fields))

    def __len__(self) -> int:
        return len(self.entry)

    def where(self, keep: Tensor) -> MeetingPairs:
        """The pairs of a bool [C] mask or an index."""
        keep = keep.nonzero().flatten() if keep.dtype == torch.bool else keep  # once, not for each tensor
        tensors = (self.edge_edge, self.entry, self.points, self.primitives, self.area)
        return MeetingPairs(*(tensor[keep] for tensor in tensors))

    def then(self, others: MeetingPairs) -> MeetingPairs:
        """These pairs, then the others."""
        parts = [(p.edge_edge, p.entry, p.points, p.primitives, p.area) for p in (self, others)]
        return MeetingPairs(*(torch.cat(tensors) for tensors in zip(*parts, strict=True)))

    def gather(self, field: Tensor) -> Tensor:
        """[B, N, ...] -> [C, 4, ...]."""
        index = (self.entry[:, None] * field.shape[1] + self.points).flatten()
        return field.flatten(0, 1)[index].unflatten(0, (-1, 4))

    def repeated(self, copies: int, batch: int) -> MeetingPairs:
        """The same pairs for `copies` copies of a batch, copies outermost."""
        if copies == 1:
            return self
        tensors = (self.edge_edge, self.entry, self.points, self.primitives, self.area)
        shifted = [tensor.repeat(copies, *[1] * (tensor.dim() - 1)) for tensor in tensors]
        shifted[1] = shifted[1] + torch.arange(copies, device=self.entry.device).repeat_interleave(len(self)) * batch
        return MeetingPairs(*shifted)

    def spans(self, corners: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """a, b, d [C, 3] of corners [C, 4, 3]."""
        span = corners.new_tensor(_SPAN)[self.edge_edge] @ corners
        a, b, d = span.unbind(1)
        return a, b, d

    def covers(self, weights: Tensor, tolerance: float) -> Tensor:
        """[C] whether the places [C, 4] lie on both primitives."""
        return (weights * weights.new_tensor(_SIGN)[self.edge_edge] >= -tolerance).all(-1)

    def frames(self, corners: Tensor) -> Frames:
        """Weights and normals at corners [C, 4, 3], differentiable."""
        a, b, d = self.spans(corners)
        cross = torch.linalg.cross(a, b)
        square = cross.square().sum(-1)
        direction = cross / square.clamp(min=_TINY)[:, None]
        alpha = (torch.linalg.cross(d, b) * direction).sum(-1)
        beta = (torch.linalg.cross(a, d) * direction).sum(-1)
        places = torch.stack([torch.ones_like(alpha), alpha, beta], dim=-1)
        weights = (corners.new_tensor(_WEIGHT)[self.edge_edge] @ places[..., None]).squeeze(-1)
        normals = cross * square.clamp(min=_TINY).rsqrt()[:, None]
        return Frames(weights, normals, square)


@dataclass(frozen=True)
class Frames:
    """Where and along what the pairs meet."""

    weights: Tensor
    """[C, 4], sum zero: Σ w_k x_k leads from the place on the second primitive to that on the first."""
    normals: Tensor
    """[C, 3] unit."""
    square: Tensor
    """[C] |c|² [m⁴]"""

    def distance(self, corners: Tensor) -> Tensor:
        """[C] signed distance along the normal at corners [C, 4, 3] [m]."""
        return (self.normals * along(self.weights, corners)).sum(-1)


def along(weights: Tensor, corners: Tensor) -> Tensor:
    """[C, 3] Σ w_k x_k."""
    return (weights[..., None] * corners).sum(1)
