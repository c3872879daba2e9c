"""A brute-force search for penetrations, independent of the simulator: all pairs, exact predicates' signs in float64.

A cloth is free of penetration between two step ends if

1. no node is inside a closed obstacle or behind a table,
2. no edge passes through a face (cloth and cloth, cloth and obstacle, both ways) that it did not pass through at the start,
3. nothing went through and out again within the step: no node ended on the other side of a cloth face that it met on
   its straight path, and no node's path and no edge on its way passed through opposite sides of an obstacle.

Signed volumes decide; an edge that only ends on a face does not cross it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from diffcloud.mesh.topology import ClothMesh, FloatArray, IntArray, SurfaceMesh

Kind = Literal["inside", "crossing", "through"]
_PAIRS_AT_ONCE = 2_000_000
"""Bounds the memory of all-pairs tests."""
_TIMES_BETWEEN = 7
"""States on the straight path between two step ends whose edges are looked at."""
_OPPOSITE = -0.1
"""Cosine between outward normals below which two faces of a body are on opposite sides of it."""


@dataclass(frozen=True)
class Penetration:
    """One finding."""

    kind: Kind
    step: int
    """Step end at which it was seen; 0 is the start."""
    first: tuple[int, ...]
    """Nodes of the cloth's node or of the edge."""
    second: tuple[int, ...]
    """Nodes of the face, or () for the inside of a whole obstacle."""
    place: str
    """What met what: `cloth edge, cloth face`, `obstacle 0`, ..."""


def find_penetrations(
    positions: FloatArray, mesh: ClothMesh, obstacles: Sequence[SurfaceMesh] = (), *, limit: int = 20
) -> list[Penetration]:
    """Search a trajectory.

    Args:
        positions: [S + 1, V, 3] of the cloth at the start and at each step end [m].
        obstacles: planar ones are half-spaces on the side where most of the cloth starts; all others must be closed.
        limit: stop after the step in which this many were found.
    """
    cloth_faces, cloth_edges = mesh.faces, mesh.edges[0]
    tables = [plane for plane in (_halfspace(obstacle, positions[0]) for obstacle in obstacles) if plane is not None]
    bodies = [(index, obstacle) for index, obstacle in enumerate(obstacles) if obstacle.plane() is None]
    at_start = {(first, second) for first, second, _ in _crossings(positions[0], cloth_edges, cloth_faces, bodies)}
    found: list[Penetration] = []
    for step, now in enumerate(positions):
        for node in np.flatnonzero(np.any([now @ normal < offset for normal, offset in tables], axis=0) if tables else []):
            found.append(Penetration("inside", step, (int(node),), (), "table"))
        for index, body in bodies:
            for node in np.flatnonzero(inside(now, body)):
                found.append(Penetration("inside", step, (int(node),), (), f"obstacle {index}"))
        crossings = _crossings(now, cloth_edges, cloth_faces, bodies)
        found += [
            Penetration("crossing", step, first, second, place)
            for first, second, place in crossings
            if (first, second) not in at_start
        ]
        if step > 0:
            found += _passages(step, positions[step - 1], now, mesh, bodies)
        if len(found) >= limit:
            break
    return found


def inside(points: FloatArray, body: SurfaceMesh) -> NDArray[np.bool_]:
    """[N] whether points [N, 3] are inside a closed surface: the winding number, a sum of solid angles, is not zero."""
    result = np.zeros(len(points), dtype=bool)
    box = (points > body.nodes.min(axis=0)) & (points < body.nodes.max(axis=0))
    near = np.flatnonzero(box.all(axis=1))
    chunk = max(1, _PAIRS_AT_ONCE // len(body.faces))
    for begin in range(0, len(near), chunk):
        index = near[begin : begin + chunk]
        a, b, c = np.moveaxis(body.nodes[body.faces][None] - points[index, None, None], 2, 0)  # [n, F, 3]
        la, lb, lc = (np.linalg.norm(corner, axis=-1) for corner in (a, b, c))
        volume = (a * np.cross(b, c)).sum(-1)
        # van Oosterom and Strackee (1983)
        cosine = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
        winding = np.arctan2(volume, cosine).sum(axis=1) / (2 * np.pi)
        result[index] = np.abs(winding) > 0.5
    return result


def edge_face_crossings(ends: FloatArray, corners: FloatArray) -> NDArray[np.bool_]:
    """[E, F] whether segments ends [E, 2, 3] pass through triangles corners [F, 3, 3].

    The segment's ends lie strictly on different sides of the triangle's plane, and its line passes none of the three
    edges on the other side than the rest; a hit of the rim counts, so no ridge between two faces lets anything through.
    """
    result = np.zeros((len(ends), len(corners)), dtype=bool)
    first, second = _overlapping(ends, corners)
    result[first, second] = _pierces(ends[first], corners[second])
    return result


def minimal_distance(
    first: tuple[FloatArray, IntArray], second: tuple[FloatArray, IntArray], *, apart: bool = False
) -> float:
    """Smallest distance of two triangle meshes (positions [V, 3], faces [F, 3]) that do not intersect [m].

    Args:
        apart: both are the same mesh, and only faces without a common node count.
    """
    (nodes, faces), (others, other_faces) = first, second
    pairs = np.ones((len(faces), len(other_faces)), dtype=bool)
    if apart:
        pairs = ~(faces[:, None, :, None] == other_faces[None, :, None, :]).any(axis=(2, 3))
    smallest = np.inf
    i, j = np.nonzero(pairs)
    for begin in range(0, len(i), _PAIRS_AT_ONCE // 10):
        part = slice(begin, begin + _PAIRS_AT_ONCE // 10)
        p, q = nodes[faces[i[part]]], others[other_faces[j[part]]]
        for corner in range(3):
            smallest = min(smallest, _point_face_distance(p[:, corner], q).min())
            smallest = min(smallest, _point_face_distance(q[:, corner], p).min())
            for other in range(3):
                edge, against = p[:, [corner, (corner + 1) % 3]], q[:, [other, (other + 1) % 3]]
                smallest = min(smallest, _edge_edge_distance(edge, against).min())
    return float(smallest)


def _halfspace(obstacle: SurfaceMesh, start: FloatArray) -> tuple[FloatArray, float] | None:
    """(normal towards most of the cloth, offset)."""
    plane = obstacle.plane()
    if plane is None:
        return None
    normal, offset = plane
    side = -1.0 if np.median(start @ normal - offset) < 0 else 1.0
    return side * normal, side * offset


def _crossings(
    cloth: FloatArray, edges: IntArray, faces: IntArray, bodies: Sequence[tuple[int, SurfaceMesh]]
) -> list[tuple[tuple[int, ...], tuple[int, ...], str]]:
    """(edge, face, place) of every edge that passes through a face; edges and faces that share a node cannot."""
    found = []
    hits = edge_face_crossings(cloth[edges], cloth[faces])
    for e, f in np.argwhere(hits):
        if not set(edges[e]) & set(faces[f]):
            found.append((tuple(edges[e].tolist()), tuple(faces[f].tolist()), "cloth edge, cloth face"))
    for index, body in bodies:
        for e, f in np.argwhere(edge_face_crossings(cloth[edges], body.nodes[body.faces])):
            found.append((tuple(edges[e].tolist()), tuple(body.faces[f].tolist()), f"cloth edge, face of obstacle {index}"))
        body_edges = _edges(body.faces)
        for e, f in np.argwhere(edge_face_crossings(body.nodes[body_edges], cloth[faces])):
            found.append((tuple(body_edges[e].tolist()), tuple(faces[f].tolist()), f"edge of obstacle {index}, cloth face"))
    return found


def _passages(
    step: int, before: FloatArray, now: FloatArray, mesh: ClothMesh, bodies: Sequence[tuple[int, SurfaceMesh]]
) -> list[Penetration]:
    """What went through a face between two step ends, on straight paths, and out on its other side."""
    found = []
    faces, inner = mesh.faces, _inner_faces(mesh)
    for node, face in _met(before, now, before[faces[inner]], now[faces[inner]]):
        corners = faces[inner[face]]
        if node not in corners:
            found.append(Penetration("through", step, (int(node),), tuple(corners.tolist()), "cloth node, cloth face"))
    edges = mesh.edges[0]
    for index, body in bodies:
        for node in _spanning(np.stack([before, now], axis=1), body):
            found.append(Penetration("through", step, (int(node),), (), f"obstacle {index}"))
        # a body thinner than the mesh slips between the nodes: then edges span it on the way
        for time in np.linspace(0, 1, _TIMES_BETWEEN + 2)[1:-1]:
            for edge in _spanning((before + time * (now - before))[edges], body):
                found.append(Penetration("through", step, tuple(edges[edge].tolist()), (), f"obstacle {index}"))
    return found


def _spanning(segments: FloatArray, body: SurfaceMesh) -> IntArray:
    """Segments [K, 2, 3] that pass through two faces of a body which look away from each other.

    The states between two step ends lie on a curve, and the straight line may cut a corner that the curve went around.
    Then the two faces meet at a right angle or less sharply; they are opposite only where the body was passed through.
    """
    corners = body.nodes[body.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    segment, face = np.nonzero(edge_face_crossings(segments, corners))
    found = [k for k in np.unique(segment) if (normal[face[segment == k]] @ normal[face[segment == k]].T).min() < _OPPOSITE]
    return np.array(found, dtype=np.int64)


def _inner_faces(mesh: ClothMesh) -> IntArray:
    """Faces without a boundary edge: within a step a node may go around the rim, and its straight path through it."""
    edge_faces = mesh.edges[1]
    rim = edge_faces[(edge_faces < 0).any(axis=1)].max(axis=1)
    return np.setdiff1d(np.arange(len(mesh.faces)), rim)


def _met(before: FloatArray, now: FloatArray, corners: FloatArray, corners_now: FloatArray) -> NDArray[np.int64]:
    """[K, 2] (point, face) where the point passed through the face while both moved in straight lines.

    The side changes when the signed volume of point and face does. The cubic of time that this volume is has its roots
    searched by sign changes on a fine grid, refined by bisection; there the point must lie on the face.
    """
    path = np.stack([before, now], axis=1)
    swept = np.concatenate([corners, corners_now], axis=1)
    point, face = _overlapping(path, swept)
    start = (before[point], corners[face])
    change = (now[point] - before[point], corners_now[face] - corners[face])
    opposite = np.sign(_side(*start)) * np.sign(_side(start[0] + change[0], start[1] + change[1])) < 0
    point, face = point[opposite], face[opposite]
    if not len(point):
        return np.zeros((0, 2), dtype=np.int64)
    start = (start[0][opposite], start[1][opposite])
    change = (change[0][opposite], change[1][opposite])

    def at(time: FloatArray) -> tuple[FloatArray, FloatArray]:
        return start[0] + time[:, None] * change[0], start[1] + time[:, None, None] * change[1]

    met = np.zeros(len(point), dtype=bool)
    grid = np.linspace(0, 1, 17)
    above = np.stack([_side(*at(np.full(len(point), time))) > 0 for time in grid])
    for k in range(len(grid) - 1):
        changes = np.flatnonzero(above[k] != above[k + 1])
        low, high = np.full(len(point), grid[k]), np.full(len(point), grid[k + 1])
        for _ in range(50):
            middle = (low + high) / 2
            same = (_side(*at(middle)) > 0) == above[k]
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        place, triangle = at((low + high) / 2)
        met[changes] ^= _over(place[changes], triangle[changes])  # through and back again is no passage
    return np.stack([point[met], face[met]], axis=1)


def _side(points: FloatArray, corners: FloatArray) -> FloatArray:
    """[K] six times the signed volume of points [K, 3] over triangles [K, 3, 3]."""
    edge = corners[:, 1:] - corners[:, :1]
    return np.asarray(((points - corners[:, 0]) * np.cross(edge[:, 0], edge[:, 1])).sum(-1))


def _over(points: FloatArray, corners: FloatArray) -> NDArray[np.bool_]:
    """[K] whether points in the planes of triangles lie in them."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    turns = [
        (np.cross(corners[:, (k + 1) % 3] - corners[:, k], points - corners[:, k]) * normal).sum(-1) >= 0 for k in range(3)
    ]
    return np.logical_and.reduce(turns)


def _pierces(ends: FloatArray, corners: FloatArray) -> NDArray[np.bool_]:
    """[K] whether segments [K, 2, 3] pass through triangles [K, 3, 3]."""
    sides = [np.sign(_side(ends[:, end], corners)) for end in (0, 1)]
    direction = ends[:, 1] - ends[:, 0]
    turns = np.stack(
        [
            np.sign((direction * np.cross(corners[:, k] - ends[:, 0], corners[:, (k + 1) % 3] - ends[:, 0])).sum(-1))
            for k in range(3)
        ]
    )
    return (sides[0] * sides[1] < 0) & ((turns >= 0).all(axis=0) | (turns <= 0).all(axis=0))


def _overlapping(first: FloatArray, second: FloatArray) -> tuple[IntArray, IntArray]:
    """Pairs whose bounding boxes touch, of groups of points [A, m, 3] and [B, n, 3]; every pair is looked at."""
    low, high = first.min(axis=1), first.max(axis=1)
    other_low, other_high = second.min(axis=1), second.max(axis=1)
    left, right = [], []
    chunk = max(1, _PAIRS_AT_ONCE // max(1, len(second)))
    for begin in range(0, len(first), chunk):
        part = slice(begin, begin + chunk)
        touch = (low[part, None] <= other_high) & (other_low <= high[part, None])
        i, j = np.nonzero(touch.all(axis=-1))
        left.append(i + begin)
        right.append(j)
    return np.concatenate(left), np.concatenate(right)


def _edges(faces: IntArray) -> IntArray:
    return np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)


def _point_face_distance(points: FloatArray, corners: FloatArray) -> FloatArray:
    """[K] distance of points [K, 3] from triangles [K, 3, 3]."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    height = ((points - corners[:, 0]) * normal).sum(-1)
    rim = np.min([_point_edge_distance(points, corners[:, [k, (k + 1) % 3]]) for k in range(3)], axis=0)
    return np.where(_over(points - height[:, None] * normal, corners), np.abs(height), rim)


def _point_edge_distance(points: FloatArray, ends: FloatArray) -> FloatArray:
    along = ends[:, 1] - ends[:, 0]
    fraction = np.clip(((points - ends[:, 0]) * along).sum(-1) / (along**2).sum(-1), 0, 1)
    return np.linalg.norm(points - ends[:, 0] - fraction[:, None] * along, axis=-1)


def _edge_edge_distance(first: FloatArray, second: FloatArray) -> FloatArray:
    """[K] distance of segments [K, 2, 3]: of their lines where the feet lie on both, else of an end from the other."""
    u, v, w = first[:, 1] - first[:, 0], second[:, 1] - second[:, 0], first[:, 0] - second[:, 0]
    a, b, c, d, e = (np.sum(x * y, axis=-1) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    determinant = a * c - b * b
    crossing = determinant > 1e-12 * a * c
    safe = np.where(crossing, determinant, 1.0)
    s, t = (b * e - c * d) / safe, (a * e - b * d) / safe
    between = crossing & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    lines = np.linalg.norm(w + s[:, None] * u - t[:, None] * v, axis=-1)
    ends = [_point_edge_distance(first[:, k], second) for k in (0, 1)]
    ends += [_point_edge_distance(second[:, k], first) for k in (0, 1)]
    return np.where(between, lines, np.min(ends, axis=0))
