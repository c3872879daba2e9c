"""Nearest points on triangle meshes, and occlusion by meshes, computed exactly in kernels.

Faces are grouped by eight neighbours. A group is skipped unless its bounding sphere is close enough. For the nearest point,
it must be closer than the best point so far, which starts with a guess or the face of the previous query. For occlusion, it
must touch the line of sight. Within a group, bounds from a face's plane and edges skip more faces.

A point on an edge or corner belongs to several faces, whose normals differ. It is assigned to the first of these faces, not
to the one that rounding favours. So a result depends neither on its guess nor on other queries.
"""

from __future__ import annotations

import numpy as np

from diffcloud.clouds.curve import Floats, Ints, curve_order
from diffcloud.compiled import kernel

NO_GUESS: Ints = np.empty((0, 0), np.int64)
_GROUP = 8
_SAFE = 1 - 1e-12
"""Factor that makes a computed lower bound safe against rounding."""
_EQUAL, _TOGETHER = 1e-9, 1e-24
"""Relative and absolute [m²] difference of squared distances up to which faces count as equally near."""


@kernel
def nearest_on_triangle(x: float, y: float, z: float, nodes: Floats, i: int, j: int, k: int, place: Floats) -> float:
    """Squared distance of a point from the triangle of nodes i, j, k [m²] (Ericson 2005, section 5.1.5). `nodes` is [V, 3].
    `place` [3] receives the barycentric coordinates of the nearest point."""
    a0, a1, a2 = nodes[i, 0], nodes[i, 1], nodes[i, 2]
    b0, b1, b2 = nodes[j, 0], nodes[j, 1], nodes[j, 2]
    c0, c1, c2 = nodes[k, 0], nodes[k, 1], nodes[k, 2]
    e0, e1, e2, f0, f1, f2 = b0 - a0, b1 - a1, b2 - a2, c0 - a0, c1 - a1, c2 - a2
    d1 = e0 * (x - a0) + e1 * (y - a1) + e2 * (z - a2)
    d2 = f0 * (x - a0) + f1 * (y - a1) + f2 * (z - a2)
    d3 = e0 * (x - b0) + e1 * (y - b1) + e2 * (z - b2)
    d4 = f0 * (x - b0) + f1 * (y - b1) + f2 * (z - b2)
    d5 = e0 * (x - c0) + e1 * (y - c1) + e2 * (z - c2)
    d6 = f0 * (x - c0) + f1 * (y - c1) + f2 * (z - c2)
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
    u = 1.0 - v - w
    place[0], place[1], place[2] = u, v, w
    g0, g1, g2 = x - (u * a0 + v * b0 + w * c0), y - (u * a1 + v * b1 + w * c1), z - (u * a2 + v * b2 + w * c2)
    return g0 * g0 + g1 * g1 + g2 * g2


@kernel
def grouped(nodes: Floats, faces: Ints) -> Ints:
    """Groups [G, 8] of neighbouring faces, for node positions [V, 3]. The last group is padded with its last face."""
    centres = np.empty((len(faces), 3))
    for face in range(len(faces)):
        for axis in range(3):
            first, second, third = nodes[faces[face, 0], axis], nodes[faces[face, 1], axis], nodes[faces[face, 2], axis]
            centres[face, axis] = first + second + third
    order = curve_order(centres)
    found = np.zeros(((len(faces) + _GROUP - 1) // _GROUP, _GROUP), np.int64)
    if len(order) < len(faces):  # if node positions are not finite, any groups are correct
        order = np.arange(len(faces))
    for place in range(len(found) * _GROUP):
        found[place // _GROUP, place % _GROUP] = order[min(place, len(faces) - 1)]
    return found


@kernel
def _spheres(nodes: Floats, faces: Ints, groups: Ints, spheres: Floats) -> None:
    """Compute the centre and radius of a sphere around all faces of each group [G, n], into `spheres` [G, 4] [m]."""
    for g in range(len(groups)):
        count = 3 * groups.shape[1]
        x = y = z = 0.0
        for k in range(count):
            i = faces[groups[g, k // 3], k % 3]
            x, y, z = x + nodes[i, 0], y + nodes[i, 1], z + nodes[i, 2]
        x, y, z = x / count, y / count, z / count
        reach = 0.0
        for k in range(count):
            i = faces[groups[g, k // 3], k % 3]
            reach = max(reach, (nodes[i, 0] - x) ** 2 + (nodes[i, 1] - y) ** 2 + (nodes[i, 2] - z) ** 2)
        spheres[g, 0], spheres[g, 1], spheres[g, 2], spheres[g, 3] = x, y, z, np.sqrt(reach)


@kernel
def _sides(nodes: Floats, faces: Ints, groups: Ints, sides: Floats) -> None:
    """Compute four planes of each face into `sides` [G, 16, 8]: normal and offset of the face, then those of its edges.
    Normals of edges are in the plane of the face and point outwards. All are zero for a face without area."""
    sides[:] = 0.0
    for g in range(len(groups)):
        for lane in range(_GROUP):
            face = groups[g, lane]
            i, j, k = faces[face, 0], faces[face, 1], faces[face, 2]
            e0, e1, e2 = nodes[j, 0] - nodes[i, 0], nodes[j, 1] - nodes[i, 1], nodes[j, 2] - nodes[i, 2]
            f0, f1, f2 = nodes[k, 0] - nodes[i, 0], nodes[k, 1] - nodes[i, 1], nodes[k, 2] - nodes[i, 2]
            n0, n1, n2 = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
            area = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
            if not area > 0.0:
                continue
            n0, n1, n2 = n0 / area, n1 / area, n2 / area
            sides[g, 0, lane], sides[g, 1, lane], sides[g, 2, lane] = n0, n1, n2
            sides[g, 3, lane] = n0 * nodes[i, 0] + n1 * nodes[i, 1] + n2 * nodes[i, 2]
            for corner in range(3):
                a, b = faces[face, corner], faces[face, (corner + 1) % 3]
                d0, d1, d2 = nodes[b, 0] - nodes[a, 0], nodes[b, 1] - nodes[a, 1], nodes[b, 2] - nodes[a, 2]
                length = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
                o0, o1, o2 = (d1 * n2 - d2 * n1) / length, (d2 * n0 - d0 * n2) / length, (d0 * n1 - d1 * n0) / length
                row = 4 * (corner + 1)
                sides[g, row, lane], sides[g, row + 1, lane], sides[g, row + 2, lane] = o0, o1, o2
                sides[g, row + 3, lane] = o0 * nodes[a, 0] + o1 * nodes[a, 1] + o2 * nodes[a, 2]


@kernel
def _bounds(x: float, y: float, z: float, sides: Floats, begin: int, bounds: Floats) -> None:
    """Lower bounds of the squared distances of a point from the eight faces of a group, into `bounds` [8] [m²].

    They combine the distance from the plane with the largest distance outside an edge. `begin` is the group's start in
    `sides`.
    """
    for lane in range(begin, begin + _GROUP):
        above = sides[lane] * x + sides[lane + 8] * y + sides[lane + 16] * z - sides[lane + 24]
        first = sides[lane + 32] * x + sides[lane + 40] * y + sides[lane + 48] * z - sides[lane + 56]
        second = sides[lane + 64] * x + sides[lane + 72] * y + sides[lane + 80] * z - sides[lane + 88]
        third = sides[lane + 96] * x + sides[lane + 104] * y + sides[lane + 112] * z - sides[lane + 120]
        beside = first if first > 0.0 else 0.0
        beside = second if second > beside else beside
        beside = third if third > beside else beside
        bounds[lane - begin] = _SAFE * (above * above + beside * beside)


@kernel
def find_on_surface(queries: Floats, guesses: Ints, nodes: Floats, faces: Ints) -> tuple[Ints, Floats]:
    """Find the nearest points on M states of a mesh.

    Args:
        queries: [M, Q, 3] [m].
        guesses: [M, Q] faces that may be near; [0, 0] for none.
        nodes: [M, V, 3] [m].
        faces: [F, 3], at least one.

    Returns:
        The nearest face of each query [M, Q], the first of equally near ones, and barycentric coordinates on it [M, Q, 3].
        For positions that are not finite: the first corner of face 0.
    """
    states, count = queries.shape[0], queries.shape[1]
    found, places = np.zeros((states, count), np.int64), np.zeros((states, count, 3))
    groups = grouped(nodes[0], faces)
    spheres, sides, bounds = np.empty((len(groups), 4)), np.empty((len(groups), 16, _GROUP)), np.empty(_GROUP)
    flat, place = sides.reshape(-1), np.empty(3)
    for state in range(states):
        corners = nodes[state]
        _spheres(corners, faces, groups, spheres)
        _sides(corners, faces, groups, sides)
        last = 0
        for query in range(count):
            x, y, z = queries[state, query, 0], queries[state, query, 1], queries[state, query, 2]
            face = guesses[state, query] if len(guesses) > 0 else last
            best = nearest_on_triangle(x, y, z, corners, faces[face, 0], faces[face, 1], faces[face, 2], place)
            if not best < np.inf:
                best, face, place[0], place[1], place[2] = np.inf, 0, 1.0, 0.0, 0.0
            equal = best * (1.0 + _EQUAL) + _TOGETHER
            bound = np.sqrt(equal)
            places[state, query, 0], places[state, query, 1], places[state, query, 2] = place[0], place[1], place[2]
            for g in range(len(groups)):
                dx, dy, dz = x - spheres[g, 0], y - spheres[g, 1], z - spheres[g, 2]
                if dx * dx + dy * dy + dz * dz > (bound + spheres[g, 3]) ** 2:
                    continue
                _bounds(x, y, z, flat, 16 * _GROUP * g, bounds)
                for lane in range(_GROUP):
                    other = groups[g, lane]
                    if bounds[lane] > equal or other == face:
                        continue
                    i, j, k = faces[other, 0], faces[other, 1], faces[other, 2]
                    squared = nearest_on_triangle(x, y, z, corners, i, j, k, place)
                    if (squared < best and best - squared > equal - best) or (squared <= equal and other < face):
                        best, face = squared, other
                        equal = best * (1.0 + _EQUAL) + _TOGETHER
                        bound = np.sqrt(equal)
                        for axis in range(3):
                            places[state, query, axis] = place[axis]
            found[state, query] = last = face
    return found, places


@kernel
def meets_triangle(start: Floats, way: Floats, nodes: Floats, i: int, j: int, k: int) -> float:
    """Distance along a unit direction `way` [3] at which a ray meets the triangle of nodes i, j, k [m]; negative if it does
    not. `nodes` is [V, 3] (Möller and Trumbore 1997)."""
    a0, a1, a2 = nodes[i, 0], nodes[i, 1], nodes[i, 2]
    e1x, e1y, e1z = nodes[j, 0] - a0, nodes[j, 1] - a1, nodes[j, 2] - a2
    e2x, e2y, e2z = nodes[k, 0] - a0, nodes[k, 1] - a1, nodes[k, 2] - a2
    px, py, pz = way[1] * e2z - way[2] * e2y, way[2] * e2x - way[0] * e2z, way[0] * e2y - way[1] * e2x
    determinant = e1x * px + e1y * py + e1z * pz
    if abs(determinant) < 1e-300:
        return -1.0
    sx, sy, sz = start[0] - a0, start[1] - a1, start[2] - a2
    u = (sx * px + sy * py + sz * pz) / determinant
    if u < 0.0 or u > 1.0:
        return -1.0
    qx, qy, qz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
    v = (way[0] * qx + way[1] * qy + way[2] * qz) / determinant
    if v < 0.0 or u + v > 1.0:
        return -1.0
    return (e2x * qx + e2y * qy + e2z * qz) / determinant


@kernel
def find_hidden(points: Floats, eyes: Floats, blind: Ints, nodes: Floats, faces: Ints, near: float) -> Ints:
    """Find the points that M states of a mesh hide from all viewpoints: [M, N] 1 if hidden, else 0.

    Args:
        points: [M, N, 3] [m].
        eyes: [M, C, 3] viewpoints [m].
        blind: [M, N, C] 1 if a viewpoint cannot see a point anyway.
        nodes: [M, V, 3] [m].
        faces: [F, 3].
        near: faces closer than this to a point do not hide it, such as its own face or an adjacent layer [m].
    """
    states, count = points.shape[0], points.shape[1]
    found = np.ones((states, count), np.int64)
    groups = grouped(nodes[0], faces)
    single = groups.reshape(-1, 1)
    around, spheres, way = np.empty((len(groups), 4)), np.empty((len(single), 4)), np.empty(3)
    for state in range(states):
        corners = nodes[state]
        _spheres(corners, faces, groups, around)
        _spheres(corners, faces, single, spheres)
        for index in range(count):
            point = points[state, index]
            for eye in range(eyes.shape[1]):
                if blind[state, index, eye]:
                    continue
                length = 0.0
                for axis in range(3):
                    way[axis] = eyes[state, eye, axis] - point[axis]
                    length += way[axis] ** 2
                length = np.sqrt(length)
                for axis in range(3):
                    way[axis] /= length
                if not _is_hidden(point, way, length, near, corners, faces, single, around, spheres):
                    found[state, index] = 0
                    break
    return found


@kernel
def _is_hidden(
    point: Floats,
    way: Floats,
    length: float,
    near: float,
    nodes: Floats,
    faces: Ints,
    listed: Ints,
    around: Floats,
    spheres: Floats,
) -> bool:
    """Whether a face blocks the line of sight from a point along the unit direction `way` [3], between `near` and `length`
    [m]."""
    for g in range(len(around)):
        if _is_beside(point, way, length, near, around, g):
            continue
        for place in range(_GROUP * g, _GROUP * (g + 1)):
            if _is_beside(point, way, length, near, spheres, place):
                continue
            face = listed[place, 0]
            if near < meets_triangle(point, way, nodes, faces[face, 0], faces[face, 1], faces[face, 2]) < length:
                return True
    return False


@kernel
def _is_beside(point: Floats, way: Floats, length: float, near: float, spheres: Floats, index: int) -> bool:
    """Whether a sphere is outside the line of sight from a point, between `near` and `length` [m]."""
    x, y, z = spheres[index, 0] - point[0], spheres[index, 1] - point[1], spheres[index, 2] - point[2]
    along, reach = x * way[0] + y * way[1] + z * way[2], spheres[index, 3]
    if along < near - reach or along > length + reach:
        return True
    return x * x + y * y + z * z - along * along > reach * reach


def compile_surface() -> None:
    """Compile the kernels for queries."""
    points, nodes, faces = np.zeros((1, 1, 3)), np.zeros((1, 3, 3)), np.array([[0, 1, 2]])
    find_on_surface(points, NO_GUESS, nodes, faces)
    find_hidden(points, points + 1.0, np.zeros((1, 1, 1), np.int64), nodes, faces, 0.01)
