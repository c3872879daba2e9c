"""Pairs of a cloth's primitives that are near each other in its rest shape, for which contact is thinner.

Contact keeps layers of a cloth apart. Parts of one layer that are nearer than the thickness at rest are no layers: a
barrier between them would push a flat cloth apart, the more the finer its mesh. The tightest bend that contact allows is
a half circle with the thickness as its diameter, so parts that are nearer on the cloth than half of its circumference
cannot meet as layers. Their thickness is a part of the mesh's smallest height, which no two of them are nearer than at
rest: they do not repel each other there, and do not pass through each other in a sharp crease.

Distances are measured along the cloth, as the lengths of paths over its faces in material space, so charts, seams and
the shape in which the cloth starts do not matter. Paths go through nodes and the middles of edges, straight over each
face (Lanthier, Maheshwari and Sack 1997): they are longer than the shortest ones by a few per cent.
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
"""Distance on the cloth, in thicknesses, below which two of its parts cannot meet as layers: half a circumference."""
NEAR_PART = 0.5
"""Thickness between them, as a part of the mesh's smallest height: below 1 no force acts at rest, and half leaves the cloth
room to be compressed."""


class Lists(NamedTuple):
    """One list of primitives for each of others, end to end."""

    starts: Ints
    """[n + 1] where each list starts; the last number is where the last one ends."""
    members: Ints
    """Primitives, ascending in each list."""


class RestPairs(NamedTuple):
    """Pairs that are near at rest; those that share a node are among them."""

    faces: Lists
    """Of each node."""
    edges: Lists
    """Of each edge: those with a larger number."""


def near_at_rest(mesh: ClothMesh, distance: float) -> RestPairs:
    """Return the pairs of nodes and faces, and of edges, that are less than a distance apart on the cloth [m]."""
    edges, _ = mesh.edges
    if distance <= mesh.smallest_height:
        return RestPairs(_empty(len(mesh.nodes)), _empty(len(edges)))
    nodes, faces = len(mesh.nodes), mesh.faces
    middles = nodes + _edge_numbers(edges, faces, nodes)
    points = np.concatenate([faces, middles], axis=1)  # [F, 6]: corners, then the middles of 01, 12, 20
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
    """[F, 3] the numbers of the edges 01, 12, 20 of each face."""
    keys = np.sort(edges, axis=1) @ (nodes, 1)
    order = np.argsort(keys)
    asked = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2) @ (nodes, 1)
    return np.asarray(order[np.searchsorted(keys[order], asked)])


def _lists(pairs: Ints, count: int, values: Floats | None = None) -> tuple[Lists, Floats]:
    """The second numbers of pairs [n, 2] as one list for each first number, and the values in that order."""
    order = np.lexsort(pairs.T[::-1])
    starts = np.concatenate([[0], np.cumsum(np.bincount(pairs[:, 0], minlength=count))])
    return Lists(starts, np.ascontiguousarray(pairs[order, 1])), np.empty(0) if values is None else values[order]


@kernel
def _reached(
    sources: Ints, starts: Ints, links: Ints, lengths: Floats, touching_starts: Ints, touching: Ints, distance: float
) -> Ints:
    """Pairs [n, 2] of a row of sources [N, k] and what touches points that are less than a distance from them.

    Args:
        starts, links, lengths: `Lists` of the points that each point is linked to, and how long the links are [m].
        touching_starts, touching: `Lists` of what touches each point.
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
        while head < tail:  # a point may stand in the queue several times: each time it has come nearer
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
    """Whether a primitive is in list n of `Lists`."""
    low, high = starts[n], starts[n + 1]
    while low < high:
        middle = (low + high) // 2
        if members[middle] < one:
            low = middle + 1
        else:
            high = middle
    return low < starts[n + 1] and members[low] == one
