"""Everything that can touch: points, edges and faces of the cloth and of all obstacles, in one numbering of points.

Points 0..V-1 are the cloth's nodes; those of the obstacles follow, obstacle by obstacle. An *owner* is 0 for the cloth
(one mesh may hold several cloths) and 1, 2, ... for the obstacles.

Edges and points of an obstacle where the surface is flat or concave are left out by default: nothing straight can meet
them before it meets a face, a point or another edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffcloud.compiled import kernel
from diffcloud.mesh.topology import ClothMesh, SurfaceMesh, directed_edges
from diffcloud.sim.compiled.box import Box, BoxType, define
from diffcloud.sim.compiled.data import Floats, Ints
from diffcloud.sim.contact.rest import near_at_rest

_FLAT = 1e-6
"""Sine of the dihedral angle below which an obstacle's edge counts as flat."""


class Surface(NamedTuple):
    """Points, edges and faces that can touch."""

    cloth_points: int
    """V"""
    point_count: int
    """N = V + points of all obstacles."""
    points: Ints
    """[P] points that take part in point-face pairs."""
    edges: Ints
    """[E, 2] points."""
    edge_faces: Ints
    """[E, 2] the face on each side of an edge (`ClothMesh.edges`), -1 where none."""
    faces: Ints
    """[F, 3] points."""
    owner: Ints
    """[N] of each point."""
    point_area: Floats
    """[P] a third of the area of the faces around [m²]; the cloth's in material space, as everywhere."""
    edge_area: Floats
    """[E] [m²]"""
    face_area: Floats
    """[F] [m²]"""
    typical_face_area: Floats
    """[owners] mean over the faces of each [m²]."""
    edge_share: Floats
    """[F, 3] what each face takes off for its edges 01, 12, 20: a half where two faces meet (see `barrier`)."""
    corner_share: Floats
    """[F, 3] what each face adds for its corners: one over the faces around an inner point."""
    movable: NDArray[np.bool_]
    """[owners]: the cloth, and bodies that contact can move."""
    touches_itself: bool
    """Whether the cloth's own parts are paired with each other."""
    rest_faces: Ints
    """Faces that are near each node of the cloth at rest (`rest.Lists.members`)."""
    rest_face_starts: Ints
    """[V + 1]"""
    rest_edges: Ints
    """Edges that are near each edge of the cloth at rest, those with a larger number."""
    rest_edge_starts: Ints
    """[edges of the cloth + 1]"""


class SurfaceBoxType(BoxType):  # type: ignore[misc]
    """Numba type of `SurfaceBox`."""


class SurfaceBox(Box):  # type: ignore[misc]
    """A surface inside kernels, with the same fields."""


define(SurfaceBox, SurfaceBoxType, Surface._fields)


@kernel
def boxed(surface: Surface) -> SurfaceBox:
    """The surface as kernels pass it on."""
    return SurfaceBox(
        surface.cloth_points,
        surface.point_count,
        surface.points,
        surface.edges,
        surface.edge_faces,
        surface.faces,
        surface.owner,
        surface.point_area,
        surface.edge_area,
        surface.face_area,
        surface.typical_face_area,
        surface.edge_share,
        surface.corner_share,
        surface.movable,
        surface.touches_itself,
        surface.rest_faces,
        surface.rest_face_starts,
        surface.rest_edges,
        surface.rest_edge_starts,
    )


def contact_surface(
    cloth: ClothMesh,
    obstacles: Sequence[SurfaceMesh],
    *,
    movable: Sequence[bool] | None = None,
    all_edges: bool = False,
    touches_itself: bool = True,
    near_at_rest_below: float = 0.0,
) -> Surface:
    """Join a cloth and its obstacles.

    Args:
        near_at_rest_below: primitives of the cloth that are nearer than this at rest, measured on the cloth, are listed as
            near [m].
        movable: of each obstacle; default none.
        touches_itself: whether the cloth's own parts are paired with each other.
        all_edges: keep the flat and concave edges and points of obstacles, as ARCSim does.
    """
    movable = [False] * len(obstacles) if movable is None else list(movable)
    points = [np.arange(len(cloth.nodes))]
    edges, faces = [cloth.edges[0]], [cloth.faces]
    edge_area = [_spread(cloth.edges[1], cloth.face_area)]
    edge_faces: list[NDArray[np.int64]] = [cloth.edges[1]]
    face_area, point_area = [cloth.face_area], [cloth.node_area]
    owner = [np.zeros(len(cloth.nodes), dtype=np.int64)]
    shares = [_shares(cloth.faces, len(cloth.nodes))]
    count, face_count = len(cloth.nodes), len(cloth.faces)
    for index, mesh in enumerate(obstacles):
        corner = mesh.nodes[mesh.faces]
        area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
        kept, sides = directed_edges(mesh.faces) if all_edges else _sharp_edges(mesh)
        used = np.unique(kept)
        per_point = np.bincount(mesh.faces.ravel(), np.repeat(area / 3, 3), len(mesh.nodes)).astype(np.float64)
        points.append(used + count)
        point_area.append(per_point[used])
        edges.append(kept + count)
        edge_faces.append(np.where(sides < 0, -1, sides + face_count))
        edge_area.append(_spread(sides, area))
        faces.append(mesh.faces + count)
        face_area.append(area)
        shares.append(_shares(mesh.faces, len(mesh.nodes)))
        owner.append(np.full(len(mesh.nodes), index + 1, dtype=np.int64))
        count, face_count = count + len(mesh.nodes), face_count + len(mesh.faces)

    rest = near_at_rest(cloth, near_at_rest_below if touches_itself else 0.0)

    def whole(parts: list[NDArray[np.int64]]) -> Ints:
        return np.ascontiguousarray(np.concatenate(parts), dtype=np.int64)

    def real(parts: list[NDArray[np.float64]]) -> Floats:
        return np.ascontiguousarray(np.concatenate(parts), dtype=np.float64)

    return Surface(
        cloth_points=len(cloth.nodes),
        point_count=count,
        points=whole(points),
        edges=whole(edges),
        edge_faces=whole(edge_faces),
        faces=whole(faces),
        owner=whole(owner),
        point_area=real(point_area),
        edge_area=real(edge_area),
        face_area=real(face_area),
        typical_face_area=np.array([area.mean() for area in face_area]),
        edge_share=real([edge for edge, _ in shares]),
        corner_share=real([corner for _, corner in shares]),
        movable=np.array([True, *movable]),
        touches_itself=touches_itself,
        rest_faces=rest.faces.members,
        rest_face_starts=rest.faces.starts,
        rest_edges=rest.edges.members,
        rest_edge_starts=rest.edges.starts,
    )


def _spread(edge_faces: NDArray[np.int64], face_area: NDArray[np.float64]) -> NDArray[np.float64]:
    """[E] a third of the area of the faces at each edge; a missing face (-1) has none."""
    padded = np.append(face_area, 0.0)
    return np.asarray(padded[edge_faces].sum(axis=1) / 3)


def _shares(faces: NDArray[np.int64], point_count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (`Surface.edge_share` [F, 3], `Surface.corner_share` [F, 3]) of a mesh.

    The share is 1/2 at an inner edge, 1 / (number of faces around the point) at an inner point, and zero at the boundary.
    """
    half = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    edges, inverse, count = np.unique(half, axis=0, return_inverse=True, return_counts=True)
    inner_edge = (count == 2)[inverse.ravel()].reshape(-1, 3)
    around = np.bincount(faces.ravel(), minlength=point_count)
    on_border = np.zeros(point_count, dtype=bool)
    on_border[edges[count != 2]] = True
    return 0.5 * inner_edge, np.where(on_border, 0.0, 1.0 / np.maximum(around, 1))[faces]


def _sharp_edges(mesh: SurfaceMesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(edges [E, 2], faces [E, 2] with -1 where none) of an obstacle that are convex, or border one face only."""
    half = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    face = np.repeat(np.arange(len(mesh.faces)), 3)
    edges, inverse, count = np.unique(np.sort(half, axis=1), axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(inverse.ravel(), kind="stable")
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    sides = np.full((len(edges), 2), -1)
    sides[:, 0] = face[order[first]]
    paired = count == 2
    sides[paired, 1] = face[order[first[paired] + 1]]

    corner = mesh.nodes[mesh.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    opposite = mesh.faces[sides[:, 1]].sum(axis=1) - edges.sum(axis=1)  # meaningless where unpaired
    arm = mesh.nodes[np.where(paired, opposite, 0)] - mesh.nodes[edges[:, 0]]
    height = np.einsum("ij,ij->i", arm, normal[sides[:, 0]]) / np.maximum(np.linalg.norm(arm, axis=1), 1e-300)
    same_way = np.zeros(len(edges), dtype=bool)  # inconsistent orientation tells nothing about convexity: keep
    pair = order[first[paired]], order[first[paired] + 1]
    same_way[paired] = half[pair[0], 0] == half[pair[1], 0]
    keep = ~paired | same_way | (height < -_FLAT)
    return edges[keep], sides[keep]
