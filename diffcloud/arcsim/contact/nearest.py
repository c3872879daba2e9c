"""Selection of the pairs that repel in a step: for each point, edge and face the nearest one on either side (as in
ARCSim)."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from diffcloud.arcsim.contact.frames import covers, cross3, dot3, frame_at, height
from diffcloud.arcsim.contact.neighbours import Neighbours, meeting, neighbours_of, no_neighbours
from diffcloud.compiled import kernel
from diffcloud.sim.compiled.copying import copy_to
from diffcloud.sim.compiled.data import Floats, Ints
from diffcloud.sim.compiled.pool import with_room
from diffcloud.sim.contact.surface import Surface, SurfaceBox, boxed

_OUTSIDE = 1e-6
_PARALLEL = 1e-12
"""Squared sine of the angle between two edges below which they never repel. Such edges have no common normal, and unbounded
derivatives. Points and faces keep them apart."""
_TINY = 1e-30
_TINIEST = 1e-300


class Repulsion(NamedTuple):
    """Parameters of the repulsion. A *slot* is one side of a primitive, and keeps its nearest pair only."""

    stiffness: float
    """k_c [N/m³]. Multiplied by the smaller area of a pair, it gives the pair's K [N/m] (`proximity`)."""
    thickness: float
    """Distance τ at which repulsion begins [m]."""
    smallest: float
    """Pairs with |a × b|² below this do not repel [m⁴] (ARCSim: 1e-6)."""
    count_once: bool
    """Whether a pair that has the slots of both its primitives counts once (ARCSim: twice)."""
    held: Floats
    """[2 (P + F + E)] for each slot, the distance of the nearest pair of two obstacles, infinite if there is none [m]. More
    distant pairs with the cloth do not get the slot."""


@kernel
def nearest_pairs(surface: SurfaceBox, near: Neighbours, repulsion: Repulsion, points: Floats) -> tuple[Ints, Floats]:
    """Select the pairs that repel at points [N, 3]; `near` lists those that can come within the thickness.

    Returns:
        Kind and points [C, 5], with kind 0 for a point and a face, 1 for two edges. Constants [C, 4]: sign, count,
        stiffness and 1 if an obstacle takes part.
    """
    pairs, found = _near(surface, near, repulsion, points)
    count = len(pairs)
    shortest = repulsion.held.copy()
    first = np.full(len(shortest), -1, np.int64)
    for c in range(count):
        for side in range(2):
            slot = pairs[c, 7 + side]
            if found[c, 0] < shortest[slot] or (
                found[c, 0] == shortest[slot] and (first[slot] < 0 or _comes_before(pairs, c, first[slot]))
            ):
                shortest[slot], first[slot] = found[c, 0], c
    corners = np.empty((count, 5), np.int64)
    constants = np.empty((count, 4))
    kept = 0
    for c in range(count):
        wins = (1 if first[pairs[c, 7]] == c else 0) + (1 if first[pairs[c, 8]] == c else 0)
        if wins == 0:
            continue
        copy_to(corners[kept], pairs[c, :5])
        constants[kept, 0] = found[c, 1]
        constants[kept, 1] = 1.0 if repulsion.count_once else wins
        constants[kept, 2] = repulsion.stiffness * found[c, 2]
        mixed = 0.0
        for k in range(1, 5):
            if pairs[c, k] >= surface.cloth_points:
                mixed = 1.0
        constants[kept, 3] = mixed
        kept += 1
    return corners[:kept], constants[:kept]


@kernel
def pairs_at(surface: Surface, repulsion: Repulsion, points: Floats) -> tuple[Ints, Floats]:
    """Return `nearest_pairs`, for callers outside of kernels."""
    box = boxed(surface)
    return nearest_pairs(box, no_neighbours(box, repulsion.thickness), repulsion, points)


def held_slots(surface: Surface, repulsion: Repulsion, points: Floats) -> Floats:
    """Compute `Repulsion.held` for static obstacles."""
    everything = surface._replace(movable=np.ones_like(surface.movable))  # otherwise pairs of two obstacles are omitted
    return _held_slots(everything, repulsion, points)


@kernel
def _held_slots(surface: Surface, repulsion: Repulsion, points: Floats) -> Floats:
    box = boxed(surface)
    pairs, found = _near(box, no_neighbours(box, repulsion.thickness), repulsion, points)
    held = np.full(2 * (len(surface.points) + len(surface.faces) + len(surface.edges)), np.inf)
    for c in range(len(pairs)):
        first, second = surface.owner[pairs[c, 1]], surface.owner[pairs[c, 4]]
        if first > 0 and second > 0 and first != second:
            for side in range(2):
                held[pairs[c, 7 + side]] = min(held[pairs[c, 7 + side]], found[c, 0])
    return held


@kernel
def _comes_before(pairs: Ints, c: int, other: int) -> bool:
    """Whether a pair precedes another one: points and faces first, then by the primitives' indices."""
    if pairs[c, 0] != pairs[other, 0]:
        return pairs[c, 0] < pairs[other, 0]
    if pairs[c, 5] != pairs[other, 5]:
        return pairs[c, 5] < pairs[other, 5]
    return pairs[c, 6] < pairs[other, 6]


@kernel
def _near(surface: SurfaceBox, near: Neighbours, repulsion: Repulsion, points: Floats) -> tuple[Ints, Floats]:
    """Pairs closer than the thickness: kind, points, primitives and slots [C, 9]; distance, sign and area [C, 3]."""
    listed = neighbours_of(surface, near, points, points)
    pairs, found = np.empty((64, 9), np.int64), np.empty((64, 3))
    count = 0
    if len(listed) == 0:
        return pairs[:0], found[:0]
    faces, around = _normals(surface, points)
    x, place = np.empty((4, 3)), np.empty(7)
    for c in meeting(surface, listed, points, points, repulsion.thickness):
        edges, a, b = listed[c, 0], listed[c, 5], listed[c, 6]
        for k in range(4):
            for axis in range(3):
                x[k, axis] = points[listed[c, 1 + k], axis]
        square = frame_at(edges, x, place)
        distance = height(place, x)
        # In ARCSim, pairs between one and two thicknesses also take slots, but have no force, and never displace a closer
        # pair.
        if not (square > _PARALLEL * _spanned(edges, x) and square >= repulsion.smallest):
            continue
        if not abs(distance) < repulsion.thickness:
            continue
        if not covers(edges, place, _OUTSIDE):
            continue
        if edges > 0 and not (
            _on_outer_side(surface, b, x, 2, 0, place, faces) and _on_outer_side(surface, a, x, 0, 2, place, faces)
        ):
            continue
        pairs, found = with_room(pairs, count, 1), with_room(found, count, 1)
        for k in range(7):
            pairs[count, k] = listed[c, k]
        _set_slots(surface, pairs, count, place, around)
        area = (
            min(surface.edge_area[a], surface.edge_area[b])
            if edges > 0
            else min(surface.point_area[a], surface.face_area[b])
        )
        found[count, 0], found[count, 1], found[count, 2] = abs(distance), (-1.0 if distance < 0 else 1.0), area
        count += 1
    return pairs[:count], found[:count]


@kernel
def _spanned(edges: int, x: Floats) -> float:
    """|a|² |b|² of a pair's two edge vectors [m⁴], for x [4, 3]."""
    found = 1.0
    for side in range(2):
        first = 2 * side if edges > 0 else 1
        last = first + 1 if edges > 0 else 2 + side
        square = 0.0
        for axis in range(3):
            square += (x[last, axis] - x[first, axis]) ** 2
        found *= square
    return found


@kernel
def _set_slots(surface: SurfaceBox, pairs: Ints, c: int, place: Floats, around: Floats) -> None:
    """Write the slots that pair `c` takes at its two primitives to columns 7 and 8 of `pairs`."""
    normal = (place[4], place[5], place[6])
    points, faces = len(surface.points), len(surface.faces)
    if pairs[c, 0] > 0:
        first = dot3(normal, around[pairs[c, 1]]) + dot3(normal, around[pairs[c, 2]])
        second = dot3(normal, around[pairs[c, 3]]) + dot3(normal, around[pairs[c, 4]])
        offset, other = points + faces, points + faces
    else:
        first = dot3(normal, around[pairs[c, 1]])
        second = 1.0  # a face's own normal is the pair's normal, so the first slot of faces stays empty
        offset, other = 0, points
    pairs[c, 7] = 2 * (pairs[c, 5] + offset) + (1 if first < 0 else 0)
    pairs[c, 8] = 2 * (pairs[c, 6] + other) + (1 if second > 0 else 0)


@kernel
def _on_outer_side(surface: SurfaceBox, edge: int, x: Floats, ends: int, others: int, place: Floats, faces: Floats) -> bool:
    """Whether the contact point on the other edge is beyond this edge, as seen from each of its faces. `ends` and `others`
    are the first rows of this edge and of the other edge in x [4, 3]."""
    s, t = abs(place[others]), abs(place[others + 1])
    for side in range(2):
        face = surface.edge_faces[edge, side]
        if face < 0:
            continue
        begin, end = (ends, ends + 1) if side == 0 else (ends + 1, ends)
        along = (x[end, 0] - x[begin, 0], x[end, 1] - x[begin, 1], x[end, 2] - x[begin, 2])
        outward = cross3(along, faces[face])
        beyond = 0.0
        for axis in range(3):
            beyond += outward[axis] * (s * x[others, axis] + t * x[others + 1, axis] - x[begin, axis])
        if not beyond >= 0:
            return False
    return True


@kernel
def _normals(surface: SurfaceBox, points: Floats) -> tuple[Floats, Floats]:
    """Unit normals of faces [F, 3] and points [N, 3]. Normals of points follow Max 1999: the direction of the sum over
    corners of (e1 × e2)/(|e1|² |e2|²)."""
    faces, around = np.empty((len(surface.faces), 3)), np.zeros((len(points), 3))
    for f in range(len(surface.faces)):
        for corner in range(3):
            i, j, k = surface.faces[f, corner], surface.faces[f, (corner + 1) % 3], surface.faces[f, (corner + 2) % 3]
            e1 = (points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2])
            e2 = (points[k, 0] - points[i, 0], points[k, 1] - points[i, 1], points[k, 2] - points[i, 2])
            cross = cross3(e1, e2)
            weight = max(dot3(e1, e1) * dot3(e2, e2), _TINIEST)
            for axis in range(3):
                around[i, axis] += cross[axis] / weight
            if corner == 0:
                length = sqrt(max(dot3(cross, cross), _TINY))
                for axis in range(3):
                    faces[f, axis] = cross[axis] / length
    for i in range(len(points)):
        length = sqrt(max(dot3(around[i], around[i]), _TINY))
        for axis in range(3):
            around[i, axis] /= length
    return faces, around
