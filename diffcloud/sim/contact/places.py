"""Find the contacts of near pairs, as elements of the barrier's terms.

A point and a face can have up to seven contacts: with the face, its three edges and its three corners (inclusion and
exclusion, see `barrier`). Contacts of a point with the same point, edge or face are merged, and their shares of the area
are added. Most of these sums vanish.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.box import Box, BoxType, define
from diffcloud.sim.compiled.data import Floats, Ints
from diffcloud.sim.contact.distance import closest, on_segment
from diffcloud.sim.contact.surface import SurfaceBox
from diffcloud.sim.implicit.terms import kernels

POINT_POINT, POINT_EDGE, POINT_FACE, EDGE_EDGE, PLANE = range(5)
_VANISHING = 1e-12
"""Area shares below this fraction of the summed magnitudes are rounding errors."""

_PointPoint, _PointEdge = kernels.BarrierPointPoint, kernels.BarrierPointEdge
_PointFace, _EdgeEdge, _Plane = kernels.BarrierPointFace, kernels.BarrierEdgeEdge, kernels.BarrierPlane


class Planes(NamedTuple):
    """Half-spaces n · x >= offset, and the points that can touch them."""

    normals: Floats
    """[P, 3] unit normals."""
    offsets: Floats
    """[P] offsets [m]."""
    points: Ints
    """[Q] indices of the points."""
    areas: Floats
    """[Q] area of each point [m²]."""


class TouchingType(BoxType):  # type: ignore[misc]
    """Numba type of `Touching`."""


class Touching(Box):  # type: ignore[misc]
    """The active contacts, as one set of elements for each kind of contact."""


define(Touching, TouchingType, ["point_point", "point_edge", "point_face", "edge_edge", "plane"])


@kernel
def places(
    surface: SurfaceBox, planes: Planes, law: Floats, pairs: Ints, distances: Floats, points: Floats, holder: Ints
) -> tuple[Ints, Floats]:
    """Find the contacts below the thickness, for points [N, 3].

    Args:
        law: [2, 3] contact parameters, with the thickness in the second column [m]. The second row is for pairs close at
            rest.
        pairs: [C, 8] kind (1: two edges), points, primitives, and 1 if close at rest.
        distances: [C] distances of the pairs [m].
        holder: [V] not negative for prescribed nodes. They can pass through half-spaces, where the barrier is undefined,
            and forces on them have no effect.

    Returns:
        Kind and points [E, 5]; for a half-space its index replaces the second point. Numbers [E, 4]: the area [m²]; 1 if an
        obstacle takes part, -1 if the pair is close at rest; then for two edges the fractions along them, for points
        the area before subtraction [m²]. Contacts with zero area are listed for the cautious matrix, but are not
        elements.
    """
    room = len(planes.points) * len(planes.offsets)
    for c in range(len(pairs)):
        if distances[c] < law[pairs[c, 7], 1]:
            room += 7
    listed, numbers = np.empty((room, 5), np.int64), np.zeros((room, 4))
    last, previous = np.full(len(points) if len(pairs) > 0 else 0, -1, np.int64), np.empty(room, np.int64)
    x, found = np.empty((4, 3)), np.empty(6)
    count = 0
    for c in range(len(pairs)):
        thickness = law[pairs[c, 7], 1]
        if not distances[c] < thickness:
            continue
        p, second = pairs[c, 1], pairs[c, 3] if pairs[c, 0] > 0 else pairs[c, 2]
        mixed = 1.0 if surface.owner[p] > 0 or surface.owner[second] > 0 else -float(pairs[c, 7])
        for k in range(4):
            for axis in range(3):
                x[k, axis] = points[pairs[c, 1 + k], axis]
        closest(pairs[c, 0], x, found)
        if pairs[c, 0] > 0:
            listed[count, 0] = EDGE_EDGE
            for k in range(1, 5):
                listed[count, k] = pairs[c, k]
            area = min(surface.edge_area[pairs[c, 5]], surface.edge_area[pairs[c, 6]])
            numbers[count, 0], numbers[count, 1], numbers[count, 2], numbers[count, 3] = area, mixed, found[4], found[5]
            count += 1
        else:
            # With one area for all faces of an owner, double counting cancels exactly.
            area = min(surface.point_area[pairs[c, 5]], surface.typical_face_area[surface.owner[second]])
            count = _point_face(
                surface, pairs, c, area, mixed, thickness, x, int(found[4]), listed, numbers, last, previous, count
            )
    kept = 0
    for e in range(count):
        if listed[e, 0] != EDGE_EDGE:
            if abs(numbers[e, 0]) < _VANISHING * numbers[e, 2]:
                numbers[e, 0] = 0.0
            numbers[e, 2] = 0.5 * (numbers[e, 0] + numbers[e, 2])  # sum of the added areas only
            if numbers[e, 2] == 0 and numbers[e, 0] == 0:
                continue
        for k in range(5):
            listed[kept, k] = listed[e, k]
        for k in range(4):
            numbers[kept, k] = numbers[e, k]
        kept += 1
    for q in range(len(planes.points)):
        i = planes.points[q]
        if i < len(holder) and holder[i] >= 0:
            continue
        for w in range(len(planes.offsets)):
            if gap_of(planes, w, points, i) < law[0, 1]:
                listed[kept, 0], listed[kept, 1], listed[kept, 2], listed[kept, 3], listed[kept, 4] = PLANE, i, w, i, i
                numbers[kept, 0], numbers[kept, 1], numbers[kept, 2] = planes.areas[q], 1.0, planes.areas[q]
                kept += 1
    return listed[:kept], numbers[:kept]


@kernel
def gap_of(planes: Planes, w: int, points: Floats, i: int) -> float:
    """Distance of a point from a plane [m]."""
    n = planes.normals[w]
    return n[0] * points[i, 0] + n[1] * points[i, 1] + n[2] * points[i, 2] - planes.offsets[w]


@kernel
def _point_face(  # type: ignore[no-untyped-def]
    surface, pairs, c, area, mixed, thickness, x, region, listed, numbers, last, previous, count
):
    """Append the contacts of a point and a face to the list. Return the new number of contacts."""
    point, face = pairs[c, 1], pairs[c, 6]
    for place in range(7):
        if place == 0:
            share, here = area, region
        elif place < 4:
            a, b = place, 1 + place % 3
            _, fraction, square = on_segment(x, 0, a, b)
            share = -area * surface.edge_share[face, place - 1]
            here = 3 + a if fraction < 0 else (3 + b if fraction > 1 else place)
            if not square < thickness * thickness:
                continue
        else:
            share, here = area * surface.corner_share[face, place - 4], place
            square = 0.0
            for axis in range(3):
                square += (x[place - 3, axis] - x[0, axis]) ** 2
            if not square < thickness * thickness:
                continue
        if share == 0:
            continue
        first, second, third = pairs[c, 2], pairs[c, 3], pairs[c, 4]
        kind = POINT_FACE
        if here >= 4:
            kind = POINT_POINT
            first = second = third = pairs[c, here - 2]
        elif here >= 1:
            kind = POINT_EDGE
            a, b = pairs[c, 1 + here], pairs[c, 2 + here % 3]
            first, second, third = min(a, b), max(a, b), max(a, b)
        e = last[point] if kind != POINT_FACE else -1
        while e >= 0 and not (
            listed[e, 0] == kind and listed[e, 2] == first and listed[e, 3] == second and numbers[e, 1] == mixed
        ):
            e = previous[e]
        if e < 0:
            e = count
            count += 1
            listed[e, 0], listed[e, 1], listed[e, 2], listed[e, 3], listed[e, 4] = kind, point, first, second, third
            numbers[e, 1] = mixed
            previous[e], last[point] = last[point], e
        numbers[e, 0] += share
        numbers[e, 2] += abs(share)
    return count


@kernel
def corners(listed: Ints, e: int) -> int:
    """Number of points of a contact."""
    kind = listed[e, 0]
    return 1 if kind == PLANE else (4 if kind == EDGE_EDGE else kind + 2)


@kernel
def as_elements(planes: Planes, law: Floats, listed: Ints, numbers: Floats):  # type: ignore[no-untyped-def]
    """Convert contacts to elements (`Touching`), with law [2, 3]: k_c, d̂ and v_s."""
    none = np.empty((0, 0), np.int64)
    n0, _, c0 = _of_kind(listed, numbers, POINT_POINT, 2)
    n1, _, c1 = _of_kind(listed, numbers, POINT_EDGE, 3)
    n2, _, c2 = _of_kind(listed, numbers, POINT_FACE, 4)
    n3, _, c3 = _of_kind(listed, numbers, EDGE_EDGE, 4)
    n4, which, c4 = _of_kind(listed, numbers, PLANE, 1)
    normals, offsets = np.empty((len(which), 3)), np.empty(len(which))
    for e in range(len(which)):
        offsets[e] = planes.offsets[which[e]]
        for axis in range(3):
            normals[e, axis] = planes.normals[which[e], axis]
    return Touching(
        _PointPoint(n0, none, c0[0], c0[1], law),
        _PointEdge(n1, none, c1[0], c1[1], law),
        _PointFace(n2, none, c2[0], c2[1], law),
        _EdgeEdge(n3, none, c3[0], c3[1], c3[2], c3[3], law),
        _Plane(n4, none, c4[0], normals, offsets, law),
    )


@kernel
def _of_kind(listed: Ints, numbers: Floats, kind: int, width: int) -> tuple[Ints, Ints, Floats]:
    """Points [E, width], second column [E] and numbers [4, E] of the contacts of one kind."""
    count = 0
    for e in range(len(listed)):
        if listed[e, 0] == kind and numbers[e, 0] != 0:
            count += 1
    nodes, second, found = np.empty((count, width), np.int64), np.empty(count, np.int64), np.empty((4, count))
    count = 0
    for e in range(len(listed)):
        if listed[e, 0] == kind and numbers[e, 0] != 0:
            for k in range(width):
                nodes[count, k] = listed[e, 1 + k]
            second[count] = listed[e, 2]
            for k in range(4):
                found[k, count] = numbers[e, k]
            count += 1
    return nodes, second, found
