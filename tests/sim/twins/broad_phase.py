"""Which pairs of primitives can touch, by looking at all of them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from diffcloud.sim.contact.surface import Surface

Pairs = set[tuple[int, int]]


def candidates(
    surface: Surface, places: NDArray[np.float64], others: NDArray[np.float64], margin: float, among_fixed: bool
) -> tuple[Pairs, Pairs]:
    """(points and faces, edges twice with the smaller number first) whose boxes come within a margin."""

    def box(corners: list[int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        both = np.concatenate([places[corners], others[corners]])
        return both.min(axis=0) - margin / 2, both.max(axis=0) + margin / 2

    def meet(one: list[int], other: list[int]) -> bool:
        (low, high), (other_low, other_high) = box(one), box(other)
        return bool((low <= other_high).all() and (other_low <= high).all())

    point_face, edge_edge = listed(surface)
    return tuple(  # type: ignore[return-value]
        {
            (i, j)
            for (i, one), (j, other) in pairs
            if may_touch(surface, one, other, among_fixed=among_fixed) and meet(one, other)
        }
        for pairs in (point_face, edge_edge)
    )


def listed(surface: Surface) -> tuple[Iterator, Iterator]:
    """All pairs of ((number, points), (number, points)): points and faces, and edges, each two once."""
    points = enumerate([[point] for point in surface.points.tolist()])
    edges = enumerate(surface.edges.tolist())
    return itertools.product(points, enumerate(surface.faces.tolist())), itertools.combinations(edges, 2)


def may_touch(surface: Surface, one: list[int], other: list[int], *, among_fixed: bool = False) -> bool:
    """Whether contact can bring two primitives together."""
    a, b = surface.owner[one[0]], surface.owner[other[0]]
    return (
        not set(one) & set(other)
        and bool(a != b or (a == 0 and surface.touches_itself))
        and bool(surface.movable[a] or surface.movable[b] or among_fixed)
    )
