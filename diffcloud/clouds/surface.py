"""The place on a triangle mesh nearest to a point, and whether a mesh hides a point, exactly, in kernels.

A face is looked at only where the sphere around it comes near enough: nearer than the nearest place found so far, which
begins with the face of the query before; or as near to the line of sight as its radius.
"""

from __future__ import annotations

import numpy as np

from diffcloud.clouds.curve import Floats, Ints
from diffcloud.compiled import kernel


@kernel
def nearest_on_triangle(point: Floats, a: Floats, b: Floats, c: Floats, place: Floats) -> float:
    """Squared distance [m²]; writes the barycentric place [3]. (Ericson 2005, section 5.1.5.)"""
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for axis in range(3):
        ab, ac = b[axis] - a[axis], c[axis] - a[axis]
        ap, bp, cp = point[axis] - a[axis], point[axis] - b[axis], point[axis] - c[axis]
        d1 += ab * ap
        d2 += ac * ap
        d3 += ab * bp
        d4 += ac * bp
        d5 += ab * cp
        d6 += ac * cp
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    if d1 <= 0.0 and d2 <= 0.0:
        v, w = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        v, w = 1.0, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        v, w = 0.0, 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v, w = d1 / (d1 - d3), 0.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        v, w = 0.0, d2 / (d2 - d6)
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1.0 - w
    else:
        v, w = vb / (va + vb + vc), vc / (va + vb + vc)
    place[0], place[1], place[2] = 1.0 - v - w, v, w
    squared = 0.0
    for axis in range(3):
        gap = point[axis] - (place[0] * a[axis] + v * b[axis] + w * c[axis])
        squared += gap * gap
    return squared


@kernel
def bounding_spheres(corners: Floats, faces: Ints, spheres: Floats) -> None:
    """[V, 3] node positions -> spheres [F, 4]: centre and radius around each face [m]."""
    for face in range(len(faces)):
        reach = 0.0
        for axis in range(3):
            spheres[face, axis] = 0.0
            for corner in range(3):
                spheres[face, axis] += corners[faces[face, corner], axis] / 3.0
        for corner in range(3):
            away = 0.0
            for axis in range(3):
                away += (corners[faces[face, corner], axis] - spheres[face, axis]) ** 2
            reach = max(reach, away)
        spheres[face, 3] = np.sqrt(reach)


@kernel
def find_on_surface(queries: Floats, nodes: Floats, faces: Ints) -> tuple[Ints, Floats]:
    """[M, Q, 3] queries at M states of a mesh, [M, V, 3] its nodes, [F, 3] faces, at least one -> [M, Q] the nearest face
    of each, [M, Q, 3] the barycentric place on it; the first corner of the first face where a position is no number."""
    states, count = queries.shape[0], queries.shape[1]
    found, places = np.zeros((states, count), np.int64), np.zeros((states, count, 3))
    places[:, :, 0] = 1.0
    spheres, place = np.empty((len(faces), 4)), np.empty(3)
    for state in range(states):
        corners = nodes[state]
        bounding_spheres(corners, faces, spheres)
        last = 0
        for query in range(count):
            point = queries[state, query]
            best, bound = np.inf, np.inf
            for turn in range(len(faces) + 1):
                face = last if turn == 0 else turn - 1
                away = 0.0
                for axis in range(3):
                    away += (point[axis] - spheres[face, axis]) ** 2
                if away > (bound + spheres[face, 3]) ** 2:
                    continue
                squared = nearest_on_triangle(
                    point, corners[faces[face, 0]], corners[faces[face, 1]], corners[faces[face, 2]], place
                )
                if squared < best:
                    best, bound, found[state, query] = squared, np.sqrt(squared), face
                    places[state, query] = place
            last = found[state, query]
    return found, places


@kernel
def meets_triangle(start: Floats, way: Floats, a: Floats, b: Floats, c: Floats) -> float:
    """How far along a unit way [3] a ray meets a triangle [m]; negative where it does not. (Möller and Trumbore 1997.)"""
    e1x, e1y, e1z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    e2x, e2y, e2z = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    px, py, pz = way[1] * e2z - way[2] * e2y, way[2] * e2x - way[0] * e2z, way[0] * e2y - way[1] * e2x
    determinant = e1x * px + e1y * py + e1z * pz
    if abs(determinant) < 1e-300:
        return -1.0
    sx, sy, sz = start[0] - a[0], start[1] - a[1], start[2] - a[2]
    u = (sx * px + sy * py + sz * pz) / determinant
    if u < 0.0 or u > 1.0:
        return -1.0
    qx, qy, qz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
    v = (way[0] * qx + way[1] * qy + way[2] * qz) / determinant
    if v < 0.0 or u + v > 1.0:
        return -1.0
    return (e2x * qx + e2y * qy + e2z * qz) / determinant


@kernel
def find_hidden(points: Floats, eyes: Floats, nodes: Floats, faces: Ints, near: float) -> Ints:
    """[M, N, 3] points beside M states of a mesh, [M, C, 3] eyes, [M, V, 3] nodes, [F, 3] faces -> [M, N] 1 where a face
    stands before a point for every eye. What is nearer to a point than `near` [m] does not hide it: its own face, a layer
    that it lies on."""
    states, count = points.shape[0], points.shape[1]
    found = np.ones((states, count), np.int64)
    spheres, way = np.empty((len(faces), 4)), np.empty(3)
    for state in range(states):
        corners = nodes[state]
        bounding_spheres(corners, faces, spheres)
        for index in range(count):
            point = points[state, index]
            for eye in range(eyes.shape[1]):
                length = 0.0
                for axis in range(3):
                    way[axis] = eyes[state, eye, axis] - point[axis]
                    length += way[axis] ** 2
                length = np.sqrt(length)
                for axis in range(3):
                    way[axis] /= length
                free = True
                for face in range(len(faces)):
                    along, away = 0.0, 0.0
                    for axis in range(3):
                        gap = spheres[face, axis] - point[axis]
                        along += gap * way[axis]
                        away += gap * gap
                    reach = spheres[face, 3]
                    if along < near - reach or along > length + reach or away - along * along > reach * reach:
                        continue
                    a, b, c = corners[faces[face, 0]], corners[faces[face, 1]], corners[faces[face, 2]]
                    if near < meets_triangle(point, way, a, b, c) < length:
                        free = False
                        break
                if free:
                    found[state, index] = 0
                    break
    return found


def compile_surface() -> None:
    """Compile what queries need."""
    points, nodes, faces = np.zeros((1, 1, 3)), np.zeros((1, 3, 3)), np.array([[0, 1, 2]])
    find_on_surface(points, nodes, faces)
    find_hidden(points, points + 1.0, nodes, faces, 0.01)
