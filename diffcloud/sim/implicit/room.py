"""List of primitive pairs that can come into contact in a step.

Valid while all points stay within a distance, the room, of their straight predicted paths.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.box import Box, BoxType, define
from diffcloud.sim.compiled.data import Floats, Ints
from diffcloud.sim.contact.additive_ccd import approach, path_lengths, reach, safe_fraction
from diffcloud.sim.contact.broad_phase import candidates, corners_of
from diffcloud.sim.contact.distance import closest
from diffcloud.sim.contact.places import gap_of
from diffcloud.sim.implicit.scene import Work

_ROOM = 0.1
"""Initial size of the room, as a fraction of the contact thickness and of the path length."""
_SPARE = 1.25
"""When points leave a room, the new size is this multiple of their distance from the path."""
_LONGEST = 5.0
"""Largest size of the room, in multiples of thickness plus path length. Newton's steps stay within it."""
_CLOSEST = 1e-6
"""Smallest allowed distance, as a fraction of the contact thickness."""
_LEFT = 0.2
"""Fraction of the distance to a half-space that remains after a step."""


class RoomType(BoxType):  # type: ignore[misc]
    """Numba type of `Room`."""


class Room(Box):  # type: ignore[misc]
    """A predicted path, and the pairs that can touch near it.

    Fields:
        begin, predicted: [N, 3] start and predicted end of the path [m].
        size: current limit of the distance from the path, as `away` measures it [m].
        longest: absolute limit of this distance [m].
        pairs: [C, 8] kind (1: two edges), four points, two primitives, and 1 if the pair is close at rest.
        distances: [C] distances at `begin` [m].
    """


define(Room, RoomType, ["begin", "predicted", "size", "longest", "pairs", "distances"])


@kernel
def room_around(work: Work, begin: Floats, predicted: Floats) -> Room:
    """Create the room around the path between two sets of points [N, 3]."""
    law = work.law
    path = 0.0
    for i in range(len(begin)):
        for axis in range(3):
            path = max(path, abs(begin[i, axis] - predicted[i, axis]))
    thickness = law[0, 1]
    size = max(_ROOM * (thickness + 0.2 * path), _SPARE * work.left_path)
    none = np.empty((0, 8), np.int64)
    room = Room(begin, predicted, size, _LONGEST * (thickness + path), none, np.empty(0))
    _list(work, room)
    return room


@kernel
def cover(work: Work, room: Room, distance: float) -> None:
    """Enlarge the room to include points at this distance from the path [m]."""
    room.size = min(_SPARE * distance, room.longest)
    _list(work, room)


@kernel
def away(room: Room, points: Floats) -> float:
    """Largest distance of a point from its path, if all points had covered the same fraction of their paths [m]. The
    fraction is the best fit. So points between two such sets are at most as far away as in the worse of both."""
    begin, predicted = room.begin, room.predicted
    along, path = 0.0, 1e-300
    for i in range(len(points)):
        for axis in range(3):
            way = predicted[i, axis] - begin[i, axis]
            along += way * (points[i, axis] - begin[i, axis])
            path += way * way
    part, most = min(max(along / path, 0.0), 1.0), 0.0
    for i in range(len(points)):
        square = 0.0
        for axis in range(3):
            a = begin[i, axis]
            square += (points[i, axis] - a - part * (predicted[i, axis] - a)) ** 2
        most = max(most, square)
    return sqrt(most)


@kernel
def prescribed(
    work: Work,
) -> Ints:
    """[N] 1 for points with prescribed motion. All are zero if no node is prescribed."""
    moves, holder = work.moves, work.holder
    found = np.zeros(len(moves), np.int64)
    some = False
    for i in range(len(holder)):
        if holder[i] >= 0:
            found[i], some = 1, True
    if some:
        for i in range(len(found)):
            if not moves[i]:
                found[i] = 1
    return found


@kernel
def _list(work: Work, room: Room) -> None:
    """List the room's pairs: those that can come closer than the thickness within it. Pairs whose points are all prescribed
    are omitted."""
    surface, law = work.surface, work.law
    begin, predicted, reached = room.begin, room.predicted, 2 * room.size
    point_face, edge_edge = candidates(surface, begin, predicted, reached + law[0, 1])
    pairs = np.empty((len(point_face) + len(edge_edge), 8), np.int64)
    distances = np.empty(len(pairs))
    fixed = prescribed(work)
    x, motion, found = np.empty((4, 3)), np.empty((4, 3)), np.empty(6)
    count = 0
    for kind in range(2):
        listed = edge_edge if kind > 0 else point_face
        for c in range(len(listed)):
            i, j, k, l = corners_of(surface, kind, listed[c, 0], listed[c, 1])
            if fixed[i] + fixed[j] + fixed[k] + fixed[l] == 4:
                continue
            row = pairs[count]
            row[0], row[1], row[2], row[3], row[4] = kind, i, j, k, l
            row[5], row[6], row[7] = listed[c, 0], listed[c, 1], listed[c, 2]
            distances[count] = distance_of(pairs, count, begin, x, found)
            # Common motion of a pair does not change its distance: neighbours on a moving cloth stay at the same distance.
            if distances[count] - approach(pairs, count, begin, predicted, x, motion) < reached + law[row[7], 1]:
                count += 1
    room.pairs, room.distances = pairs[:count], distances[:count]


@kernel
def distance_of(pairs: Ints, c: int, points: Floats, x: Floats, found: Floats) -> float:
    """Distance between the primitives of a pair [m]. `x` [4, 3] and `found` [6] are scratch space."""
    for k in range(4):
        for axis in range(3):
            x[k, axis] = points[pairs[c, 1 + k], axis]
    return closest(pairs[c, 0], x, found)


@kernel
def distances_at(work: Work, room: Room, points: Floats) -> Floats:
    """Return distances [C] [m] of the listed pairs at points [N, 3]. Above the contact thickness they are lower bounds."""
    law = work.law
    pairs, begin, old = room.pairs, room.begin, room.distances
    distances = np.empty(len(pairs))
    if len(distances) == 0:
        return distances
    moved = path_lengths(begin, points)
    x, found = np.empty((4, 3)), np.empty(6)
    for c in range(len(distances)):
        # The points' displacement bounds the change of distance. For most pairs, this avoids the exact computation.
        distances[c] = old[c] - reach(pairs, c, moved)
        if distances[c] < law[pairs[c, 7], 1]:
            distances[c] = distance_of(pairs, c, points, x, found)
    return distances


@kernel
def free_way(work: Work, room: Room, distances: Floats, points: Floats, ends: Floats) -> float:
    """Fraction in [0, 1] of the straight path from `points` to `ends` [N, 3] that is free of collisions. `distances` [C]
    are those of the room's pairs at `points`."""
    planes, law = work.planes, work.law
    allowed = 1.0
    if len(planes.offsets) > 0:
        fixed = prescribed(work)
        for q in range(len(planes.points)):
            i = planes.points[q]
            for w in range(len(planes.offsets)):
                before, after = gap_of(planes, w, points, i), gap_of(planes, w, ends, i)
                if after < 0.5 * _LEFT * before and fixed[i] == 0:
                    allowed = min(allowed, (1 - _LEFT) * before / max(before - after, 1e-300))
    return safe_fraction(room.pairs, distances, points, ends, allowed, _CLOSEST * law[0, 1])
