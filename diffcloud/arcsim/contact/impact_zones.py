"""Impact zones (Harmon et al. 2008, "Robust treatment of simultaneous collisions").

The candidate positions of a step are moved so that nothing has passed through anything. The correction is the smallest one,
weighted by the masses. Passes of detection and projection alternate until a pass finds no impact. An impact j at time t_j
is the linear constraint n_j · Σ w_jk x_k >= thickness, with the normal and weights at that time. All constraints of a step
remain. Those that share movable points form a zone, which `dual` solves.
"""

from __future__ import annotations

from math import floor
from typing import NamedTuple

import numpy as np

from diffcloud.arcsim.contact.dual import applied, gram, solve_dual
from diffcloud.arcsim.contact.impact_times import NEVER, first_impact
from diffcloud.arcsim.contact.neighbours import Neighbours, meeting, neighbours_of
from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats, Ints
from diffcloud.sim.compiled.pool import with_room
from diffcloud.sim.compiled.sorting import ascending
from diffcloud.sim.contact.surface import SurfaceBox

PASSES = 100
_TIME_TIE = 1e-4
"""Impacts in one interval of this length, relative to the step, count as simultaneous. They are ordered by their
primitives."""
TOUCH = 1e-5
"""Margin of the boxes, which covers the tolerances of the detection [m]."""


class Projection(NamedTuple):
    """Options of the impact stage."""

    thickness: float
    """τ_p: distance between primitives after the projection [m]."""
    smallest: float
    """Pairs with |a × b|² below this never meet [m⁴] (ARCSim: 1e-6)."""
    residue: float
    """Fraction of each correction that is omitted. ARCSim's iterative solver leaves a larger gap for a smaller correction,
    which decides ties in the next step. 1e-9 reproduces this."""


class Impacts(NamedTuple):
    """Record of the impacts of an episode, for its derivatives. `used` counts the rows of the other fields."""

    met: Ints
    """[J, 5] kind and four points of each impact."""
    places: Floats
    """[J, 9] weights, normal against the approach, time, and sign of the normal."""
    passes: Ints
    """[P, 2] for each pass, the number of known impacts in its step, and how many of them are new."""
    forces: Floats
    """[., 2] λ and regularisation of every known impact, for each pass in turn."""
    used: Ints
    """[3] number of rows of `met` (and `places`), `passes`, `forces`."""


@kernel
def no_impacts() -> Impacts:
    """Create an empty record."""
    ints, floats = np.empty((16, 5), np.int64), np.empty((16, 9))
    return Impacts(ints, floats, np.empty((16, 2), np.int64), np.empty((16, 2)), np.zeros(3, np.int64))


@kernel
def resolve(
    surface: SurfaceBox,
    near: Neighbours,
    choices: Projection,
    start: Floats,
    places: Floats,
    inverse_mass: Floats,
    record: Impacts,
) -> tuple[bool, Impacts]:
    """Resolve the impacts of a step, in place.

    Args:
        near: pairs that come within `TOUCH` of each other.
        start: [N, 3] points at the start of the step, free of intersections.
        places: [N, 3] points at the end of the step before contact; receives those after contact.
        inverse_mass: [N] [1/kg]; zero for points that cannot move.

    Returns:
        Whether `PASSES` passes were sufficient, and the record with the passes of this step.
    """
    candidate, before = places.copy(), places.copy()
    changed = np.ones(len(places), np.bool_)
    first = record.used[0]
    for _ in range(PASSES):
        pairs = neighbours_of(surface, near, start, places)
        fresh, record = _impacts(surface, choices, pairs, start, places, changed, inverse_mass, record)
        if fresh == 0:
            return True, record
        record = _project(choices, candidate, places, inverse_mass, record, first, fresh)
        for i in range(len(places)):
            changed[i] = False
            for axis in range(3):
                changed[i] = changed[i] or places[i, axis] != before[i, axis]
                before[i, axis] = places[i, axis]
    return False, record


@kernel
def _impacts(  # type: ignore[no-untyped-def]
    surface: SurfaceBox,
    choices: Projection,
    pairs: Ints,
    start: Floats,
    places: Floats,
    changed,
    inverse_mass: Floats,
    record: Impacts,
) -> tuple[int, Impacts]:
    """Detect the impacts of this pass. In order of time, keep each one that shares no movable point with an earlier one."""
    hits, times, found = np.empty((16, 1), np.int64), np.empty((16, 2)), np.empty((16, 7))
    count = 0
    x, y, place = np.empty((4, 3)), np.empty((4, 3)), np.empty(7)
    for c in meeting(surface, pairs, start, places, TOUCH):
        if not (changed[pairs[c, 1]] or changed[pairs[c, 2]] or changed[pairs[c, 3]] or changed[pairs[c, 4]]):
            continue
        for k in range(4):
            for axis in range(3):
                x[k, axis], y[k, axis] = start[pairs[c, 1 + k], axis], places[pairs[c, 1 + k], axis]
        time = first_impact(pairs[c, 0], x, y, choices.smallest, place)
        if time == NEVER:
            continue
        hits, times, found = with_room(hits, count, 1), with_room(times, count, 1), with_room(found, count, 1)
        hits[count, 0] = c
        times[count, 0], times[count, 1] = floor(time / _TIME_TIE), time
        for k in range(7):
            found[count, k] = place[k]
        count += 1
    if count == 0:
        return 0, record
    faces, edges = float(len(surface.faces)), float(len(surface.edges))
    number = np.empty(count)  # position in the list of all pairs
    for h in range(count):
        c = hits[h, 0]
        number[h] = pairs[c, 5] * faces + pairs[c, 6] if pairs[c, 0] == 0 else 1e15 + pairs[c, 5] * edges + pairs[c, 6]
    order = ascending(number)
    order = order[ascending(times[:count, 0][order])]
    taken = np.zeros(len(places), np.bool_)
    met, stored = with_room(record.met, record.used[0], count), with_room(record.places, record.used[0], count)
    fresh = 0
    for h in order:
        c = hits[h, 0]
        free, movable = True, False
        for k in range(4):
            i = pairs[c, 1 + k]
            if inverse_mass[i] > 0:
                movable, free = True, free and not taken[i]
        if not (free and movable):
            continue
        row = record.used[0] + fresh
        approach = 0.0
        for k in range(4):
            i = pairs[c, 1 + k]
            taken[i] = True
            met[row, 1 + k] = i
            for axis in range(3):
                approach += found[h, k] * found[h, 4 + axis] * (places[i, axis] - start[i, axis])
        sign = -1.0 if approach > 0 else 1.0
        met[row, 0] = pairs[c, 0]
        for k in range(4):
            stored[row, k] = found[h, k]
        for axis in range(3):
            stored[row, 4 + axis] = sign * found[h, 4 + axis]
        stored[row, 7], stored[row, 8] = times[h, 1], sign
        fresh += 1
    record.used[0] += fresh
    return fresh, Impacts(met, stored, record.passes, record.forces, record.used)


@kernel
def _project(
    choices: Projection, candidate: Floats, places: Floats, inverse_mass: Floats, record: Impacts, first: int, fresh: int
) -> Impacts:
    """Solve the zones that have new impacts, move their points, and record the pass."""
    count = record.used[0] - first
    met, rows = record.met[first : first + count], record.places[first : first + count]
    passes = with_room(record.passes, record.used[1], 1)
    forces = with_room(record.forces, record.used[2], count)
    begin, known = record.used[2], 0
    if count > fresh:  # known from the previous pass
        known = passes[record.used[1] - 1, 0]
        for j in range(known):
            forces[begin + j, 0], forces[begin + j, 1] = forces[begin - known + j, 0], forces[begin - known + j, 1]
    for j in range(known, count):
        forces[begin + j, 0] = forces[begin + j, 1] = 0.0
    zone = zones(met, inverse_mass)
    for j in range(count - fresh, count):
        if zone[j] < 0:
            continue
        chosen = take_zone(zone, j)
        size = len(chosen)
        points, own = met[chosen][:, 1:5].copy(), rows[chosen]
        matrix, target = gram(points, own, inverse_mass), applied(points, own, candidate)
        force = np.empty(size)
        for m in range(size):
            target[m] = choices.thickness - target[m]
            force[m] = forces[begin + chosen[m], 0]
        regular = solve_dual(matrix, target, force)
        for m in range(size):
            forces[begin + chosen[m], 0], forces[begin + chosen[m], 1] = force[m], regular
        move(points, own, force, 1 - choices.residue, inverse_mass, candidate, places)
    passes[record.used[1], 0], passes[record.used[1], 1] = count, fresh
    record.used[1] += 1
    record.used[2] += count
    return Impacts(record.met, record.places, passes, forces, record.used)


@kernel
def take_zone(zone: Ints, row: int) -> Ints:
    """Rows of the zone that contains `row`. They are removed from the list `zone`."""
    label, size = zone[row], 0
    members = np.empty(len(zone), np.int64)
    for other in range(len(zone)):
        if zone[other] == label:
            members[size], zone[other] = other, -1
            size += 1
    return members[:size]


@kernel
def zones(met: Ints, inverse_mass: Floats) -> Ints:
    """Zone number [J] of each impact. Impacts that share movable points have the same zone."""
    parent = np.arange(len(inverse_mass))
    for j in range(len(met)):
        root = -1
        for k in range(1, 5):
            i = met[j, k]
            if inverse_mass[i] > 0:
                while parent[i] != i:
                    parent[i] = parent[parent[i]]
                    i = parent[i]
                if root < 0:
                    root = i
                else:
                    parent[max(i, root)] = min(i, root)
                    root = min(i, root)
    found = np.full(len(met), -1, np.int64)
    for j in range(len(met)):
        for k in range(1, 5):
            i = met[j, k]
            if inverse_mass[i] > 0:
                while parent[i] != i:
                    i = parent[i]
                found[j] = i
    return found


@kernel
def move(
    points: Ints, rows: Floats, force: Floats, part: float, inverse_mass: Floats, candidate: Floats, places: Floats
) -> None:
    """Set places = candidate + part · M⁻¹ Wᵀ λ for the movable points of the rows."""
    for j in range(len(points)):
        for k in range(4):
            i = points[j, k]
            if inverse_mass[i] > 0:
                for axis in range(3):
                    places[i, axis] = candidate[i, axis]
    for j in range(len(points)):
        for k in range(4):
            i = points[j, k]
            for axis in range(3):
                places[i, axis] += part * inverse_mass[i] * rows[j, k] * rows[j, 4 + axis] * force[j]
