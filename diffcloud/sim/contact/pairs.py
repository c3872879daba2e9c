"""Pairs of primitives that may touch: flat lists over the whole batch, so that contact sets may differ between entries.

Both kinds of pair are four points with signed weights that sum to zero, and the vector between the closest places is
Σ w_k x_k: a point and a face have (1, -b0, -b1, -b2), two edges (a0, a1, -b0, -b1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from diffcloud.sim.contact.broad_phase import Boxes, overlapping
from diffcloud.sim.contact.surface import ContactSurface

Kind = Literal["point_face", "edge_edge"]


@dataclass(frozen=True)
class Pairs:
    """C pairs of one kind."""

    kind: Kind
    entry: Tensor
    """[C] batch entry."""
    points: Tensor
    """[C, 4] point and face corners, or both ends of the first and of the second edge."""
    primitives: Tensor
    """[C, 2] index into the surface's points and faces, or its edges (twice)."""
    area: Tensor
    """[C] the smaller of both primitives' areas [m²]."""

    def __len__(self) -> int:
        return len(self.entry)

    def where(self, keep: Tensor) -> Pairs:
        """The pairs of a bool [C] mask or an index."""
        keep = keep.nonzero().flatten() if keep.dtype == torch.bool else keep  # once, not for each tensor
        return Pairs(self.kind, self.entry[keep], self.points[keep], self.primitives[keep], self.area[keep])

    def gather(self, positions: Tensor) -> Tensor:
        """[B, N, 3] -> [C, 4, 3]."""
        count = positions.shape[1]
        index = (self.entry[:, None] * count + self.points).flatten()
        return positions.flatten(0, 1)[index].view(-1, 4, 3)

    def repeated(self, copies: int, batch: int) -> Pairs:
        """The same pairs for `copies` copies of a batch, copies outermost."""
        if copies == 1:
            return self
        offset = torch.arange(copies, device=self.entry.device).repeat_interleave(len(self)) * batch
        return Pairs(
            self.kind,
            self.entry.repeat(copies) + offset,
            self.points.repeat(copies, 1),
            self.primitives.repeat(copies, 1),
            self.area.repeat(copies),
        )


def candidates(
    surface: ContactSurface, places: tuple[Tensor, ...], margin: float, *, among_fixed: bool = False
) -> tuple[Pairs, Pairs]:
    """(point-face, edge-edge) pairs whose boxes come within `margin` of each other [m].

    Pairs that share a point, that lie on one obstacle, or of which neither can move are left out.

    Args:
        places: positions [B, N, 3] of all points; a box holds a primitive at all of them (start and end of a motion).
        among_fixed: keep the pairs of which neither can move.
    """

    def boxes(primitives: Tensor) -> Boxes:
        corners = tuple(place[:, primitives.flatten()].view(len(place), *primitives.shape, 3).detach() for place in places)
        return Boxes.around(corners, 0.5 * margin)

    partners = surface.all_partners if among_fixed else surface.partners
    entry, point, face = overlapping(boxes(surface.points[:, None]), boxes(surface.faces), partners.point_face)
    corner = torch.cat([surface.points[point][:, None], surface.faces[face]], dim=1)
    area = torch.minimum(surface.point_area[point], surface.face_area[face])
    point_face = Pairs("point_face", entry, corner, torch.stack([point, face], 1), area)

    edge_boxes, moving = boxes(surface.edges), partners.first_edges
    first_boxes = Boxes(edge_boxes.low[:, moving], edge_boxes.high[:, moving])
    entry, first, second = overlapping(first_boxes, edge_boxes, partners.edge_edge)
    first = moving[first]
    corner = torch.cat([surface.edges[first], surface.edges[second]], dim=1)
    area = torch.minimum(surface.edge_area[first], surface.edge_area[second])
    return point_face, Pairs("edge_edge", entry, corner, torch.stack([first, second], 1), area)
