"""Meshes and their connectivity.

A *node* is a point in world space, a *vert* a point in material space. A node on a seam has several verts (as in ARCSim,
Narain et al. 2012). Faces are triples of verts, and each vert belongs to a node.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import MeshError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_MISSING = -1
_SMALLEST_AREA = 1e-14
"""Smallest area of a face, relative to the squared extent of the material space."""


@dataclass(frozen=True)
class Hinges:
    """The H edges between two faces, for the bending energy."""

    nodes: IntArray
    """[H, 4]: the edge (n0, n1), then the opposite node of face 0 and of face 1."""
    faces: IntArray
    """[H, 2]: face 0 traverses the edge n0 -> n1, face 1 traverses it n1 -> n0."""
    length: FloatArray
    """[H] length in material space, mean of both sides [m]."""
    angle: FloatArray
    """[H, 2] direction of the edge in material space on each side [rad]."""


@dataclass(frozen=True)
class SurfaceMesh:
    """A triangle mesh in world space, for obstacles and rendering."""

    nodes: FloatArray
    """[V, 3] positions [m]."""
    faces: IntArray
    """[F, 3] node indices, counter-clockwise seen from outside."""

    @staticmethod
    def joined(parts: Sequence[SurfaceMesh]) -> SurfaceMesh:
        """Concatenate meshes. An empty list gives an empty mesh."""
        first = np.cumsum([0, *(len(part.nodes) for part in parts)])
        return SurfaceMesh(
            np.concatenate([np.zeros((0, 3)), *(part.nodes for part in parts)]),
            np.concatenate(
                [np.zeros((0, 3), np.int64), *(part.faces + n for part, n in zip(parts, first[:-1], strict=True))]
            ),
        )

    def plane(self) -> tuple[FloatArray, float] | None:
        """(unit normal [3], offset [m]) if all nodes are in one plane normal · x = offset, else None."""
        corner = self.nodes[self.faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).sum(axis=0)
        length = np.linalg.norm(normal)
        extent = float(np.ptp(self.nodes, axis=0).max())
        if length <= _SMALLEST_AREA * extent**2:
            return None
        normal = normal / length
        heights = self.nodes @ normal
        return (normal, float(heights.mean())) if np.ptp(heights) <= 1e-6 * extent else None


@dataclass(frozen=True)
class ClothMesh:
    """A cloth: nodes in world space, verts in material space, and faces.

    Raises:
        MeshError: an index is out of range, a face has no area, a repeated node or the wrong orientation in material space,
            or an edge has more than two faces.
    """

    nodes: FloatArray
    """[V, 3] initial positions [m]."""
    verts: FloatArray
    """[U, 2] material-space positions [m]."""
    vert_node: IntArray
    """[U] the node that owns each vert."""
    face_verts: IntArray
    """[F, 3] verts of each face."""

    def __post_init__(self) -> None:
        if not np.isfinite(self.nodes).all() or not np.isfinite(self.verts).all():
            raise MeshError("The mesh holds NaN or infinite coordinates; export it again from its source.")
        if len(self.face_verts) == 0:
            raise MeshError("The mesh has no faces; a cloth needs at least one triangle.")
        for name, index, count in (
            ("face", self.face_verts, len(self.verts)),
            ("vert", self.vert_node, len(self.nodes)),
        ):
            wrong = index[(index < 0) | (index >= count)]
            if len(wrong):
                raise MeshError(f"A {name} refers to index {int(wrong[0])} of {count}; indices run from 0.")
        self._refuse_degenerate_faces()
        self._refuse_crowded_edges()

    @cached_property
    def faces(self) -> IntArray:
        """[F, 3] node indices of each face."""
        return self.vert_node[self.face_verts]

    @cached_property
    def material_edges(self) -> FloatArray:
        """[F, 2, 2] edge matrix: its columns are the two edges from corner 0, in material space [m]."""
        u = self.verts[self.face_verts]
        return np.stack([u[:, 1] - u[:, 0], u[:, 2] - u[:, 0]], axis=-1)

    @cached_property
    def face_area(self) -> FloatArray:
        """[F] area in material space [m²]."""
        return 0.5 * np.linalg.det(self.material_edges)

    @cached_property
    def smallest_height(self) -> float:
        """Smallest height of all triangles in material space [m]."""
        corner = self.verts[self.face_verts]
        longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=-1).max(axis=1)
        return float((2 * self.face_area / longest).min())

    @cached_property
    def node_area(self) -> FloatArray:
        """[V] a third of the area of the adjacent faces, in material space [m²]."""
        return np.bincount(self.faces.ravel(), np.repeat(self.face_area / 3, 3), len(self.nodes)).astype(np.float64)

    @cached_property
    def edges(self) -> tuple[IntArray, IntArray]:
        """Edges [E, 2] in face order, and the faces [E, 2] at each edge, -1 if there is none.

        An edge has the direction of the first face that uses it. Column 0 has the face that traverses it forwards, column 1
        the one that traverses it backwards. If two faces traverse it in the same direction, the later one replaces the
        other, and the edge counts as boundary, as in ARCSim. The published band mesh has two such edges.
        """
        return directed_edges(self.faces)

    @cached_property
    def hinges(self) -> Hinges:
        """All edges with a face on both sides."""
        edges, faces = self.edges
        inner = (faces != _MISSING).all(axis=1)
        edge, pair = edges[inner], faces[inner]
        opposite = np.stack([_opposite_node(self.faces[pair[:, side]], edge) for side in (0, 1)], axis=1)
        along = np.stack([self._material_edge(pair[:, side], edge) for side in (0, 1)], axis=1)
        return Hinges(
            nodes=np.concatenate([edge, opposite], axis=1),
            faces=pair,
            length=np.linalg.norm(along, axis=-1).mean(axis=1),
            angle=np.arctan2(along[..., 1], along[..., 0]),
        )

    @cached_property
    def size(self) -> float:
        """Largest distance between two nodes along edges, in material space [m]. Computed from the farthest node of node 0,
        and the farthest node of that one. This is exact for cloths without long arms."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import dijkstra  # slow to import

        sides = self.face_verts[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        pairs, first = np.unique(np.sort(self.vert_node[sides], axis=1), axis=0, return_index=True)
        lengths = np.linalg.norm(self.verts[sides[first, 0]] - self.verts[sides[first, 1]], axis=1)
        graph = coo_array((lengths, pairs.T), shape=(len(self.nodes),) * 2).tocsr()
        ways = dijkstra(graph, directed=False, indices=0)
        ways = dijkstra(graph, directed=False, indices=int(np.where(np.isfinite(ways), ways, -1).argmax()))
        return float(ways[np.isfinite(ways)].max())

    def _material_edge(self, face: IntArray, edge: IntArray) -> FloatArray:
        """Edge vectors u(n1) - u(n0) [H, 2] in the material space of the given face of each edge."""
        corners, verts = self.faces[face], self.face_verts[face]
        start = verts[np.arange(len(face)), np.argmax(corners == edge[:, :1], axis=1)]
        end = verts[np.arange(len(face)), np.argmax(corners == edge[:, 1:], axis=1)]
        return self.verts[end] - self.verts[start]

    def _refuse_degenerate_faces(self) -> None:
        repeated = np.flatnonzero((self.faces == np.roll(self.faces, 1, axis=1)).any(axis=1))
        if len(repeated):
            raise MeshError(f"Face {repeated[0]} uses a node twice ({self.faces[repeated[0]].tolist()}); remove it.")
        smallest = _SMALLEST_AREA * float(np.ptp(self.verts, axis=0).max()) ** 2
        flat = np.flatnonzero(np.abs(self.face_area) <= smallest)
        if len(flat):
            raise MeshError(
                f"Face {flat[0]} has no area in material space (vt), which defines the rest shape of the cloth. "
                "Unwrap the mesh again."
            )
        turned = np.flatnonzero(self.face_area < 0)
        if len(turned):
            raise MeshError(
                f"{len(turned)} faces are turned over in material space (first: face {turned[0]}, area "
                f"{self.face_area[turned[0]]:.3g}); their corners must run counter-clockwise in vt. Flip them."
            )

    def _refuse_crowded_edges(self) -> None:
        half = np.sort(self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, count = np.unique(half, axis=0, return_counts=True)
        if count.max() > 2:
            worst = edges[count.argmax()].tolist()
            raise MeshError(
                f"The edge between nodes {worst[0]} and {worst[1]} belongs to {count.max()} faces; a cloth is a manifold, "
                "where an edge has one or two. Split the mesh there."
            )


def directed_edges(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Edges [E, 2] and their faces [E, 2] for triangles [F, 3], with the conventions of `ClothMesh.edges`."""
    half = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    key = np.sort(half, axis=1)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    edge_of_half = rank[inverse.ravel()]
    edges = half[np.sort(first)]
    slot = (half[:, 0] != edges[edge_of_half, 0]).astype(np.int64)
    sides = np.full((len(edges), 2), _MISSING, dtype=np.int64)
    sides[edge_of_half, slot] = np.repeat(np.arange(len(faces)), 3)
    return edges, sides


def _opposite_node(corners: IntArray, edge: IntArray) -> IntArray:
    """[H] the corner of each face that is not on its edge."""
    return corners.sum(axis=1) - edge.sum(axis=1)
