"""Which axis-aligned boxes overlap, for a batch, without testing all pairs.

Few boxes are compared outright. Many go through a uniform grid: each box is entered into the cells it covers, and only
boxes that share a cell are compared; the few boxes much larger than the rest (a table's faces) are compared with all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

_ALL_PAIRS = 500_000
"""Up to this many pairs per batch entry, comparing all is quicker than a grid on a CPU (measured on folded cloths: by a
half there, and by up to eight times below a tenth of it, where boxes overlap much)."""
_MOST_CELLS = 64
"""A box that covers more grid cells is compared with all others."""


@dataclass(frozen=True)
class Boxes:
    """Axis-aligned boxes."""

    low: Tensor
    """[B, N, 3] [m]"""
    high: Tensor
    """[B, N, 3] [m]"""

    @staticmethod
    def around(corners: tuple[Tensor, ...], margin: float) -> Boxes:
        """Boxes that hold all `corners`, each [B, N, n, 3], and `margin` more on every side."""
        low = torch.stack([c.amin(2) for c in corners]).amin(0) - margin
        high = torch.stack([c.amax(2) for c in corners]).amax(0) + margin
        return Boxes(low, high)


class Eligible(Protocol):
    """Of which pairs of two lists an overlap matters, whatever their places."""

    def __call__(self, a: Tensor, b: Tensor) -> Tensor:
        """bool of pairs by their indices in both lists, which are broadcast."""

    @property
    def table(self) -> Tensor:
        """bool [N, M] of all pairs: kept, since it is asked for in every step."""


def overlapping(first: Boxes, second: Boxes, eligible: Eligible) -> tuple[Tensor, Tensor, Tensor]:
    """(entry [P], index in `first` [P], index in `second` [P]) of the boxes that overlap, in lexicographic order."""
    if first.low.shape[1] * second.low.shape[1] <= _ALL_PAIRS:
        return _all_pairs(first, second, eligible.table)
    entry, a, b = _grid_pairs(first, second)
    kept = eligible(a, b).nonzero().flatten()
    return entry[kept], a[kept], b[kept]


def _all_pairs(first: Boxes, second: Boxes, eligible: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    # axis by axis in memory, which the comparisons need to be vectorised
    low_a, high_a, low_b, high_b = (t.movedim(-1, 0).contiguous() for t in (first.low, first.high, second.low, second.high))
    together = low_a[0, :, :, None] <= high_b[0, :, None]
    together &= low_b[0, :, None] <= high_a[0, :, :, None]
    for axis in (1, 2):
        together &= low_a[axis, :, :, None] <= high_b[axis, :, None]
        together &= low_b[axis, :, None] <= high_a[axis, :, :, None]
    together &= eligible
    entry, a, b = together.nonzero(as_tuple=True)
    return entry, a, b


def _grid_pairs(first: Boxes, second: Boxes) -> tuple[Tensor, Tensor, Tensor]:
    batch, count_a, count_b = len(first.low), first.low.shape[1], second.low.shape[1]
    low_a, high_a = first.low.flatten(0, 1), first.high.flatten(0, 1)
    low_b, high_b = second.low.flatten(0, 1), second.high.flatten(0, 1)
    extent = torch.cat([high_a - low_a, high_b - low_b])
    cell = float(extent.amax(-1).median().clamp(min=1e-12)) * 1.5
    origin = torch.minimum(low_a.amin(0), low_b.amin(0))

    def cells(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
        start = ((low - origin) / cell).floor().long()
        return start, ((high - origin) / cell).floor().long() - start + 1

    start_a, size_a = cells(low_a, high_a)
    start_b, size_b = cells(low_b, high_b)
    extent_of_grid = torch.maximum((start_a + size_a).amax(0), (start_b + size_b).amax(0))
    entry_a = torch.arange(batch, device=low_a.device).repeat_interleave(count_a)
    entry_b = torch.arange(batch, device=low_a.device).repeat_interleave(count_b)
    large_a, large_b = size_a.prod(-1) > _MOST_CELLS, size_b.prod(-1) > _MOST_CELLS

    key_a, box_a = _enter(start_a, size_a, entry_a, (~large_a).nonzero().flatten(), extent_of_grid)
    key_b, box_b = _enter(start_b, size_b, entry_b, (~large_b).nonzero().flatten(), extent_of_grid)
    key_b, order = key_b.sort()
    box_b = box_b[order]
    lowest, highest = torch.searchsorted(key_b, key_a), torch.searchsorted(key_b, key_a, right=True)
    pair_a, pair_b = _join(box_a, lowest, highest - lowest, box_b)
    lists = [(pair_a, pair_b)]
    # a large box meets every box of its batch entry
    for large, per_entry, swap in ((large_a, count_b, False), (large_b, count_a, True)):
        which = large.nonzero().flatten()
        if len(which):
            entry = which // (count_b if swap else count_a)
            others = entry[:, None] * per_entry + torch.arange(per_entry, device=which.device)
            own = which[:, None].expand_as(others)
            lists.append((others.flatten(), own.flatten()) if swap else (own.flatten(), others.flatten()))
    pair_a, pair_b = (torch.cat(parts) for parts in zip(*lists, strict=True))
    meet = ((low_a[pair_a] <= high_b[pair_b]) & (low_b[pair_b] <= high_a[pair_a])).all(-1)
    unique = torch.unique(pair_a[meet] * (batch * count_b) + pair_b[meet])
    pair_a, pair_b = unique // (batch * count_b), unique % (batch * count_b)
    return entry_a[pair_a], pair_a % count_a, pair_b % count_b


def _enter(start: Tensor, size: Tensor, entry: Tensor, which: Tensor, grid: Tensor) -> tuple[Tensor, Tensor]:
    """(cell key, box) of every cell that the boxes `which` cover."""
    start, size = start[which], size[which]
    count = size.prod(-1)
    box = torch.arange(len(which), device=which.device).repeat_interleave(count)
    place = torch.arange(len(box), device=which.device) - (count.cumsum(0) - count)[box]
    size_y, size_z = size[box, 1], size[box, 2]
    x = start[box, 0] + place // (size_y * size_z)
    y = start[box, 1] + place // size_z % size_y
    z = start[box, 2] + place % size_z
    return ((entry[which][box] * grid[0] + x) * grid[1] + y) * grid[2] + z, which[box]


def _join(left: Tensor, lowest: Tensor, count: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
    """Pair left[i] with right[lowest[i] : lowest[i] + count[i]]."""
    index = torch.arange(len(left), device=left.device).repeat_interleave(count)
    place = torch.arange(len(index), device=left.device) - (count.cumsum(0) - count)[index]
    return left[index], right[lowest[index] + place]
