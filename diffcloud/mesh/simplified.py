"""Coarser meshes of a surface, with triangles of about equal size, and cloths made of a surface.

Seeds are spread over the surface by farthest-point sampling, first along its outline and its creases, and then moved to
the middle of their cells (Lloyd). Three cells that meet are a triangle, the dual of a geodesic Voronoi diagram (Peyré and
Cohen 2006). Decimation by quadric errors, as in open3d, gives slivers on a flat cloth, where all errors are zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from diffcloud.errors import MeshError
from diffcloud.mesh.refinement import refined
from diffcloud.mesh.topology import ClothMesh, FloatArray, IntArray, SurfaceMesh, directed_edges

_CREASE = np.cos(np.deg2rad(60.0))
"""Cosine of the angle between the normals of two faces, below which their edge is kept as a line."""
_CORNER = np.cos(np.deg2rad(35.0))
"""Cosine of 35 degrees. A node is kept where an outline or crease changes its direction by more than this."""
_DENSE = 0.2
"""Largest mean edge length of the mesh on which distances are measured, as a fraction of the wanted one."""
_ALONG = 0.6
"""Largest distance from the next seed along a line, as a fraction of the wanted edge length."""
_LLOYD = 4
_TRIALS = 5
_FEWER = 0.93
"""Factor of the number of nodes in the next trial, if a mesh has another topology than its source."""


def cloth_of(surface: SurfaceMesh) -> ClothMesh:
    """Return a cloth that is at rest in the shape of a surface. Each face has its own piece of the material space, with
    the lengths of its edges.

    Raises:
        MeshError: the mesh has no faces, a face without area, or an edge of three faces.
    """
    corner = surface.nodes[surface.faces]
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    length = np.maximum(np.linalg.norm(first, axis=1), np.finfo(float).tiny)
    along = (first * second).sum(axis=1) / length
    height = np.linalg.norm(np.cross(first, second), axis=1) / length
    zero = np.zeros(len(length))
    verts = np.stack([zero, zero, length, zero, along, height], axis=1).reshape(-1, 2)
    faces = np.arange(len(verts)).reshape(-1, 3)
    return ClothMesh(nodes=surface.nodes, verts=verts, vert_node=surface.faces.reshape(-1), face_verts=faces)


def simplified(surface: SurfaceMesh, count: int) -> SurfaceMesh:
    """Return a mesh of about `count` nodes on a surface, with triangles of about equal size.

    Outline, creases of more than 60 degrees, and their corners are kept.

    Raises:
        MeshError: no mesh of that many nodes has the topology of the surface.
    """
    area = float(cloth_of(surface).face_area.sum())
    for trial in range(_TRIALS):
        wanted = round(count * _FEWER**trial)
        length = float(np.sqrt(area * 2 / np.sqrt(3) / wanted))
        dense = surface
        while _mean_edge(dense) > _DENSE * length:
            finer, _ = refined(cloth_of(dense))
            dense = SurfaceMesh(finer.nodes, finer.faces)
        found = _Cells(dense, length).mesh(wanted)
        if topology(found) == topology(surface):
            return found
    raise MeshError(
        f"The mesh cannot be simplified to about {count} nodes without a change of its topology. Narrow parts may be the "
        f"reason. Simplify it in another program, to at most {count} nodes."
    )


def topology(surface: SurfaceMesh) -> tuple[int, int, int, int]:
    """Return the numbers of parts, of boundary loops, of irregular edges (not between one or two faces of the same
    orientation), and the Euler characteristic."""
    half = surface.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    whole, count = np.unique(np.sort(half, axis=1), axis=0, return_counts=True)
    directed = len(half) - len(np.unique(half, axis=0))
    used = np.unique(surface.faces)
    parts = connected_components(_graph(whole, np.ones(len(whole)), len(surface.nodes)), directed=False)[1][used]
    rim = whole[count == 1]
    loops = connected_components(_graph(rim, np.ones(len(rim)), len(surface.nodes)), directed=False)[1][np.unique(rim)]
    irregular = int((count > 2).sum()) + directed
    return len(np.unique(parts)), len(np.unique(loops)), irregular, len(used) - len(whole) + len(surface.faces)


def lines(surface: SurfaceMesh) -> IntArray:
    """Return the edges [E, 2] of the outline and of creases."""
    edges, sides = directed_edges(surface.faces)
    corner = surface.nodes[surface.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    sharp = (normal[sides[:, 0]] * normal[sides[:, 1]]).sum(axis=1) < _CREASE
    return edges[(sides < 0).any(axis=1) | sharp]


def corners_of(nodes: FloatArray, edges: IntArray) -> IntArray:
    """Return the nodes where lines [E, 2] end, meet or turn sharply."""
    ends = np.concatenate([edges, edges[:, ::-1]])
    way = nodes[ends[:, 1]] - nodes[ends[:, 0]]
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), np.finfo(float).tiny)
    sums, degree = np.zeros((len(nodes), 3)), np.bincount(ends[:, 0], minlength=len(nodes))
    np.add.at(sums, ends[:, 0], way)
    # two unit vectors that leave a node with a turn φ have a sum of the squared length 2 - 2 cos φ
    turned = (degree == 2) & ((sums**2).sum(axis=1) > 2 - 2 * _CORNER)
    return np.flatnonzero(turned | ((degree > 0) & (degree != 2)))


@dataclass
class _Cells:
    """Seeds on a dense mesh, and their cells."""

    dense: SurfaceMesh
    length: float
    """Wanted edge length [m]."""

    def mesh(self, count: int) -> SurfaceMesh:
        """Return the mesh whose nodes are `count` seeds."""
        nodes, faces = self.dense.nodes, self.dense.faces
        edges, _ = directed_edges(faces)
        graph = _with_diagonals(cloth_of(self.dense), edges)
        feature = lines(self.dense)
        fixed = corners_of(nodes, feature)
        along = _graph(feature, np.linalg.norm(nodes[feature[:, 0]] - nodes[feature[:, 1]], axis=1), len(nodes))
        on_line = np.zeros(len(nodes), dtype=bool)
        on_line[feature] = True
        fixed = _spread(along, fixed, on_line, len(nodes), _ALONG * self.length)
        seeds = _spread(graph, fixed, np.ones(len(nodes), dtype=bool), count, 0.0)
        for _ in range(_LLOYD):
            labels = _labels(graph, seeds)
            weight = np.bincount(labels, minlength=len(seeds))
            middle = np.stack([np.bincount(labels, axis, len(seeds)) for axis in nodes.T], axis=1) / weight[:, None]
            away = np.where(on_line, np.inf, ((nodes - middle[labels]) ** 2).sum(axis=1))
            order = np.lexsort([away, labels])
            nearest = order[np.searchsorted(labels[order], np.arange(len(seeds)))]
            free = (np.arange(len(seeds)) >= len(fixed)) & ~on_line[nearest]
            seeds = np.where(free, nearest, seeds)
        meeting = _labels(graph, seeds)[faces]
        meeting = meeting[(meeting != np.roll(meeting, 1, axis=1)).all(axis=1)]
        start = meeting.argmin(axis=1)[:, None]
        triangles = np.unique(np.take_along_axis(meeting, (start + np.arange(3)) % 3, axis=1), axis=0)
        return SurfaceMesh(nodes[seeds], triangles.astype(np.int64))


def _spread(graph: csr_array, seeds: IntArray, allowed: np.ndarray, count: int, near: float) -> IntArray:
    """Add the farthest allowed node to the seeds until there are `count`, or all are nearer than `near`."""
    distance = np.where(allowed, np.inf, -1.0)
    if len(seeds):
        distance = np.minimum(distance, dijkstra(graph, directed=False, indices=seeds, min_only=True))
    found = seeds.tolist()
    while len(found) < count and (farthest := float(distance.max())) > near:
        node = int(distance.argmax())
        found.append(node)
        distance = np.minimum(distance, dijkstra(graph, directed=False, indices=node, limit=farthest))
        distance[node] = 0.0
    return np.array(found, dtype=np.int64)


def _labels(graph: csr_array, seeds: IntArray) -> IntArray:
    """Return the index of the nearest seed of each node."""
    _, _, source = dijkstra(graph, directed=False, indices=seeds, min_only=True, return_predecessors=True)
    number = np.full(graph.shape[0], -1)
    number[seeds] = np.arange(len(seeds))
    return np.asarray(number[source])


def _with_diagonals(cloth: ClothMesh, edges: IntArray) -> csr_array:
    """Distances along edges, and straight across two faces that share an edge."""
    nodes, hinges = cloth.nodes, cloth.hinges
    start, end, first, second = nodes[hinges.nodes].transpose(1, 0, 2)
    way = end - start
    length = np.linalg.norm(way, axis=1)
    along = [((one - start) * way).sum(axis=1) / length for one in (first, second)]
    across = [np.linalg.norm(np.cross(one - start, way), axis=1) / length for one in (first, second)]
    straight = np.hypot(along[0] - along[1], across[0] + across[1])
    pairs = np.concatenate([edges, hinges.nodes[:, 2:]])
    sides = np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)
    return _graph(pairs, np.concatenate([sides, straight]), len(nodes))


def _graph(edges: IntArray, lengths: FloatArray, count: int) -> csr_array:
    return coo_array((lengths, (edges[:, 0], edges[:, 1])), shape=(count, count)).tocsr()


def _mean_edge(surface: SurfaceMesh) -> float:
    corner = surface.nodes[surface.faces]
    return float(np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=-1).mean())
