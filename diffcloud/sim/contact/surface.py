"""Contact surface: points, edges and faces of the cloth and of all obstacles, with one numbering of points.

Points 0..V-1 are the cloth's nodes, followed by those of each obstacle. The *owner* of a primitive is 0 for the cloth (one
mesh can contain several cloths) and 1, 2, ... for the obstacles.

By default, flat and concave edges and points of obstacles are omitted: any straight primitive meets a face, a point or
another edge first.
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
"""An obstacle's edge is flat if the sine of its dihedral angle is below this value."""


class Surface(NamedTuple):
    """Points, edges and faces that can touch."""

    cloth_points: int
    """Number V of cloth nodes."""
    point_count: int
    """Number N of points: V plus the points of all obstacles."""
    points: Ints
    """[P] indices of the points that take part in point-face pairs."""
    edges: Ints
    """[E, 2] points of each edge."""
    edge_faces: Ints
    """[E, 2] the face on each side of an edge (`ClothMesh.edges`); -1 if there is none."""
    faces: Ints
    """[F, 3] points of each face."""
    owner: Ints
    """[N] owner of each point."""
    point_area: Floats
    """[P] a third of the area of the adjacent faces [m²]. Areas of the cloth are in material space."""
    edge_area: Floats
    """[E] a third of the area of the adjacent faces [m²]."""
    face_area: Floats
    """[F] area of each face [m²]."""
    typical_face_area: Floats
    """[owners] mean area of an owner's faces [m²]."""
    edge_share: Floats
    """[F, 3] fraction that each face subtracts for its edges 01, 12, 20: 1/2 if two faces meet there (see `barrier`)."""
    corner_share: Floats
    """[F, 3] fraction that each face adds for its corners: 1 / (number of adjacent faces) at an inner point."""
    movable: NDArray[np.bool_]
    """[owners] True for the cloth and for bodies that contact can move."""
    touches_itself: bool
    """Whether contact of the cloth with itself is detected."""
    rest_faces: Ints
    """Faces that are close to each cloth node at rest (`rest.Lists.members`)."""
    rest_face_starts: Ints
    """[V + 1] starts of the lists in `rest_faces`."""
    rest_edges: Ints
    """Edges that are close to each cloth edge at rest, those with a larger index only."""
    rest_edge_starts: Ints
    """[edges of the cloth + 1] starts of the lists in `rest_edges`."""


class SurfaceBoxType(BoxType):  # type: ignore[misc]
    """Numba type of `SurfaceBox`."""


class SurfaceBox(Box):  # type: ignore[misc]
    """A surface inside kernels, with the same fields."""


define(SurfaceBox, SurfaceBoxType, Surface._fields)


@kernel
def boxed(surface: Surface) -> SurfaceBox:
    """Convert the surface to a box for kernels."""
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
    """Join a cloth and its obstacles to one contact surface.

    Args:
        movable: whether contact can move each obstacle; default none.
        all_edges: keep the flat and concave edges and points of obstacles, as ARCSim does.
        touches_itself: whether contact of the cloth with itself is detected.
        near_at_rest_below: list pairs of cloth primitives as close at rest if their distance along the cloth is below this
            [m].
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
    """Area of each edge [E]: a third of the area of the adjacent faces; a missing face (-1) has none."""
    padded = np.append(face_area, 0.0)
    return np.asarray(padded[edge_faces].sum(axis=1) / 3)


def _shares(faces: NDArray[np.int64], point_count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (`Surface.edge_share` [F, 3], `Surface.corner_share` [F, 3]) of a mesh. The share is 1/2 at an inner edge,
    1 / (number of faces around the point) at an inner point, and zero at the boundary."""
    half = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    edges, inverse, count = np.unique(half, axis=0, return_inverse=True, return_counts=True)
    inner_edge = (count == 2)[inverse.ravel()].reshape(-1, 3)
    around = np.bincount(faces.ravel(), minlength=point_count)
    on_border = np.zeros(point_count, dtype=bool)
    on_border[edges[count != 2]] = True
    return 0.5 * inner_edge, np.where(on_border, 0.0, 1.0 / np.maximum(around, 1))[faces]


def _sharp_edges(mesh: SurfaceMesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Edges [E, 2] of an obstacle that are convex or border one face only, and their faces [E, 2], -1 if there is none."""
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
    opposite = mesh.faces[sides[:, 1]].sum(axis=1) - edges.sum(axis=1)  # meaningless for edges with one face
    arm = mesh.nodes[np.where(paired, opposite, 0)] - mesh.nodes[edges[:, 0]]
    height = np.einsum("ij,ij->i", arm, normal[sides[:, 0]]) / np.maximum(np.linalg.norm(arm, axis=1), 1e-300)
    same_way = np.zeros(len(edges), dtype=bool)  # convexity is unknown with inconsistent orientation, so the edge is kept
    pair = order[first[paired]], order[first[paired] + 1]
    same_way[paired] = half[pair[0], 0] == half[pair[1], 0]
    keep = ~paired | same_way | (height < -_FLAT)
    return edges[keep], sides[keep]
