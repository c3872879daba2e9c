"""The place on a triangle mesh nearest to a point, exactly, in kernels.

A face is looked at only where the sphere around it comes nearer than the nearest place found so far, which begins with the
face of the query before.
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
def find_on_surface(queries: Floats, nodes: Floats, faces: Ints) -> tuple[Ints, Floats]:
    """[M, Q, 3] queries at M states of a mesh, [M, V, 3] its nodes, [F, 3] faces, at least one -> [M, Q] the nearest face
    of each, [M, Q, 3] the barycentric place on it; the first corner of the first face where a position is no number."""
    states, count = queries.shape[0], queries.shape[1]
    found, places = np.zeros((states, count), np.int64), np.zeros((states, count, 3))
    places[:, :, 0] = 1.0
    spheres, place = np.empty((len(faces), 4)), np.empty(3)
    for state in range(states):
        corners = nodes[state]
        for face in range(len(faces)):
            a, b, c = corners[faces[face, 0]], corners[faces[face, 1]], corners[faces[face, 2]]
            reach = 0.0
            for axis in range(3):
                spheres[face, axis] = (a[axis] + b[axis] + c[axis]) / 3.0
            for corner in (a, b, c):
                away = 0.0
                for axis in range(3):
                    away += (corner[axis] - spheres[face, axis]) ** 2
                reach = max(reach, away)
            spheres[face, 3] = np.sqrt(reach)
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


def compile_surface() -> None:
    """Compile what queries need."""
    find_on_surface(np.zeros((1, 1, 3)), np.zeros((1, 3, 3)), np.array([[0, 1, 2]]))
