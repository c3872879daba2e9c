"""Pairs of a cloth's primitives that are close to each other in its rest shape. They have a smaller contact thickness.

Contact keeps the layers of a cloth apart. Parts of one layer that are closer than the thickness at rest are not two layers:
a barrier between them would push a flat cloth apart, more so with a finer mesh. The tightest fold that contact allows is a
half circle with the thickness as its diameter. So parts whose distance along the cloth is less than this half circumference
cannot meet as layers. Their thickness is a fraction of the mesh's smallest height, which bounds their distance at rest. So
they do not repel each other at rest, but cannot pass through each other in a sharp crease.

Distances are lengths of paths over the faces in material space. So they do not depend on charts, seams or the initial
shape. Paths go through nodes and midpoints of edges, and straight across each face (Lanthier, Maheshwari and Sack 1997).
They are a few per cent longer than the shortest paths.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.mesh.topology import ClothMesh
from diffcloud.sim.compiled.data import Floats, Ints
from diffcloud.sim.compiled.pool import with_room

CREASE = np.pi / 2
"""Distance along the cloth, in thicknesses, below which two parts cannot meet as layers: half a circumference."""
NEAR_PART = 0.5
"""Contact thickness of these pairs as a fraction of the mesh's smallest height. Below 1 there is no force at rest. One half
leaves room for compression."""


class Lists(NamedTuple):
    """A list of primitives for each of n other primitives, concatenated."""

    starts: Ints
    """[n + 1] start of each list; the last entry is the end of the last list."""
    members: Ints
    """Indices of primitives, ascending in each list."""


class RestPairs(NamedTuple):
    """Pairs that are close at rest, including those that share a node."""

    faces: Lists
    """Close faces of each node."""
    edges: Lists
    """Close edges of each edge, those with a larger index only."""


def near_at_rest(mesh: ClothMesh, distance: float) -> RestPairs:
    """Find the node-face and edge-edge pairs whose distance along the cloth is below `distance` [m]."""
    edges, _ = mesh.edges
    if distance <= mesh.smallest_height:
        return RestPairs(_empty(len(mesh.nodes)), _empty(len(edges)))
    nodes, faces = len(mesh.nodes), mesh.faces
    middles = nodes + _edge_numbers(edges, faces, nodes)
    points = np.concatenate([faces, middles], axis=1)  # [F, 6]: corners, then the midpoints of 01, 12, 20
    corner = mesh.verts[mesh.face_verts]
    places = np.concatenate([corner, 0.5 * (corner + np.roll(corner, -1, axis=1))], axis=1)
    i, j = np.array(list(combinations(range(6), 2))).T
    ways = np.linalg.norm(places[:, i] - places[:, j], axis=-1).ravel()
    links = np.stack([points[:, i].ravel(), points[:, j].ravel()], axis=1)
    graph, lengths = _lists(np.concatenate([links, links[:, ::-1]]), nodes + len(edges), np.concatenate([ways, ways]))
    of_faces = np.stack([points.ravel(), np.repeat(np.arange(len(faces)), 6)], axis=1)
    ends = np.concatenate([edges, nodes + np.arange(len(edges))[:, None]], axis=1)
    of_edges = np.stack([ends.ravel(), np.repeat(np.arange(len(edges)), 3)], axis=1)
    touching_faces, _ = _lists(of_faces, nodes + len(edges))
    touching_edges, _ = _lists(of_edges, nodes + len(edges))
    near_faces = _reached(np.arange(nodes)[:, None], *graph, lengths, *touching_faces, distance)
    near_edges = _reached(ends, *graph, lengths, *touching_edges, distance)
    larger = near_edges[:, 1] > near_edges[:, 0]
    return RestPairs(_lists(near_faces, nodes)[0], _lists(near_edges[larger], len(edges))[0])


def _empty(count: int) -> Lists:
    return Lists(np.zeros(count + 1, np.int64), np.empty(0, np.int64))


def _edge_numbers(edges: Ints, faces: Ints, nodes: int) -> Ints:
    """Indices [F, 3] of the edges 01, 12, 20 of each face."""
    keys = np.sort(edges, axis=1) @ (nodes, 1)
    order = np.argsort(keys)
    asked = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2) @ (nodes, 1)
    return np.asarray(order[np.searchsorted(keys[order], asked)])


def _lists(pairs: Ints, count: int, values: Floats | None = None) -> tuple[Lists, Floats]:
    """Group pairs [n, 2] by their first number. Return the lists of second numbers, and the values in the same order."""
    order = np.lexsort(pairs.T[::-1])
    starts = np.concatenate([[0], np.cumsum(np.bincount(pairs[:, 0], minlength=count))])
    return Lists(starts, np.ascontiguousarray(pairs[order, 1])), np.empty(0) if values is None else values[order]


@kernel
def _reached(
    sources: Ints, starts: Ints, links: Ints, lengths: Floats, touching_starts: Ints, touching: Ints, distance: float
) -> Ints:
    """For each row of sources [N, k], find everything that touches a point closer than `distance`. Return pairs [n, 2].

    Args:
        starts, links, lengths: `Lists` of the neighbours of each point, and the lengths of these links [m].
        touching_starts, touching: `Lists` of the primitives that touch each point.
    """
    best, queue = np.full(len(starts) - 1, np.inf), np.empty((64, 1), np.int64)
    seen = np.full(touching.max() + 1, -1, np.int64)
    found, count = np.empty((16 * len(sources), 2), np.int64), 0
    for n in range(len(sources)):
        tail = head = 0
        for k in range(sources.shape[1]):
            best[sources[n, k]] = 0.0
            queue[tail, 0] = sources[n, k]
            tail += 1
        while head < tail:  # a point is queued again each time its distance decreases
            i = queue[head, 0]
            head += 1
            for e in range(starts[i], starts[i + 1]):
                way = best[i] + lengths[e]
                if way < distance and way < best[links[e]]:
                    best[links[e]] = way
                    queue = with_room(queue, tail, 1)
                    queue[tail, 0] = links[e]
                    tail += 1
        for q in range(tail):
            i = queue[q, 0]
            if best[i] == np.inf:
                continue
            best[i] = np.inf
            found = with_room(found, count, touching_starts[i + 1] - touching_starts[i])
            for e in range(touching_starts[i], touching_starts[i + 1]):
                if seen[touching[e]] != n:
                    seen[touching[e]] = n
                    found[count, 0], found[count, 1] = n, touching[e]
                    count += 1
    return found[:count]


@kernel
def listed_in(starts: Ints, members: Ints, n: int, one: int) -> bool:
    """Whether primitive `one` is in list n of `Lists`."""
    low, high = starts[n], starts[n + 1]
    while low < high:
        middle = (low + high) // 2
        if members[middle] < one:
            low = middle + 1
        else:
            high = middle
    return low < starts[n + 1] and members[low] == one
