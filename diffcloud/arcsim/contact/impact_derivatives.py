"""Derivatives of the passes of the impact zones (`impact_zones.resolve`).

A pass moves the points of a zone to x = x̂ + c M⁻¹ Wᵀ λ. The active rows satisfy (G + ε diag G) λ = h - W x̂, where
G = W M⁻¹ Wᵀ. The choice of active rows and zones is not differentiated. Weights and normal of a row come from the pass
that found it. They are those at the time when its four points meet, on straight paths from the start of the step to their
positions before this pass.
"""

from __future__ import annotations

import numpy as np

from diffcloud.arcsim.contact.dual import gram
from diffcloud.arcsim.contact.impact_zones import Impacts, Projection, move, take_zone, zones
from diffcloud.arcsim.terms import kernels
from diffcloud.compiled import kernel
from diffcloud.sim.compiled.copying import copy_to
from diffcloud.sim.compiled.data import Floats, Ints
from diffcloud.sim.compiled.dense import lu, lu_solve

_point_face_reverse, _edge_edge_reverse = kernels.point_face_meeting_reverse, kernels.edge_edge_meeting_reverse
_point_face_tangent, _edge_edge_tangent = kernels.point_face_meeting_tangent, kernels.edge_edge_meeting_tangent


@kernel
def resolve_reverse(
    choices: Projection,
    record: Impacts,
    begin: Ints,
    end: Ints,
    start: Floats,
    candidate: Floats,
    inverse_mass: Floats,
    places: Floats,
    start_gradient: Floats,
    mass_gradient: Floats,
) -> None:
    """Propagate gradients backwards through the passes of one step.

    Args:
        begin, end: [5] rows of `Kept.begins` for this step and the next one.
        start, candidate: [N, 3] points at the start of the step, and before its impacts [m].
        inverse_mass: [N] as used for the impacts [1/kg].
        places: [N, 3] gradient of the positions after the impacts; receives that of the candidate.
        start_gradient, mass_gradient: [N, 3], [N] receive additions for the start and the inverse masses.
    """
    first, passes = begin[1], end[2] - begin[2]
    history = _replayed(choices, record, begin, passes, candidate, inverse_mass)
    known = end[1] - first
    row_gradient = np.zeros((known, 7))
    before = np.zeros(places.shape)  # gradient of the candidate
    force_row = end[3]
    inputs, time, slopes, part = np.empty(24), np.empty(1), np.empty(24), np.empty(7)
    for p in range(passes - 1, -1, -1):
        count, fresh = record.passes[begin[2] + p, 0], record.passes[begin[2] + p, 1]
        force_row -= count
        zone = zones(record.met[first : first + count], inverse_mass)
        for j in range(count - fresh, count):
            if zone[j] < 0:
                continue
            chosen = take_zone(zone, j)
            points, rows, force = _rows_of(record, first, chosen, force_row)
            slope = _zone_reverse(
                points,
                rows,
                force,
                record.forces[force_row + chosen[0], 1],
                1 - choices.residue,
                candidate,
                inverse_mass,
                places,
                before,
                mass_gradient,
            )
            for m in range(len(chosen)):
                for k in range(7):
                    row_gradient[chosen[m], k] += slope[m, k]
        for j in range(count - fresh, count):
            row = first + j
            _meeting_inputs(record, row, start, history[p], inputs)
            time[0] = record.places[row, 7]
            for k in range(7):
                part[k] = row_gradient[j, k] * (record.places[row, 8] if k > 3 else 1.0)
            slopes[:] = 0.0
            if record.met[row, 0] > 0:
                _edge_edge_reverse(inputs, time, part, slopes)
            else:
                _point_face_reverse(inputs, time, part, slopes)
            for k in range(4):
                for axis in range(3):
                    start_gradient[record.met[row, 1 + k], axis] += slopes[3 * k + axis]
                    places[record.met[row, 1 + k], axis] += slopes[12 + 3 * k + axis]
    for i in range(len(places)):
        for axis in range(3):
            places[i, axis] += before[i, axis]


@kernel
def resolve_tangent(
    choices: Projection,
    record: Impacts,
    begin: Ints,
    end: Ints,
    start: Floats,
    candidate: Floats,
    inverse_mass: Floats,
    start_rates: Floats,
    mass_rates: Floats,
    places: Floats,
) -> None:
    """Propagate derivatives [K, N, 3] of the candidate, in `places`, through the passes of one step, in place.

    Args:
        start_rates, mass_rates: [K, N, 3], [K, N] derivatives of the start and of the inverse masses. Others as above.
    """
    first, passes = begin[1], end[2] - begin[2]
    history = _replayed(choices, record, begin, passes, candidate, inverse_mass)
    before = places.copy()
    directions = len(places)
    row_rates = np.zeros((directions, end[1] - first, 7))
    force_row = begin[3]
    inputs, time = np.empty(24), np.empty(1)
    rates, found = np.empty((directions, 24)), np.empty((directions, 7))
    for p in range(passes):
        count, fresh = record.passes[begin[2] + p, 0], record.passes[begin[2] + p, 1]
        for j in range(count - fresh, count):
            row = first + j
            _meeting_inputs(record, row, start, history[p], inputs)
            time[0] = record.places[row, 7]
            for d in range(directions):
                for k in range(4):
                    for axis in range(3):
                        rates[d, 3 * k + axis] = start_rates[d, record.met[row, 1 + k], axis]
                        rates[d, 12 + 3 * k + axis] = places[d, record.met[row, 1 + k], axis]
            if record.met[row, 0] > 0:
                _edge_edge_tangent(inputs, time, rates, found)
            else:
                _point_face_tangent(inputs, time, rates, found)
            for d in range(directions):
                for k in range(7):
                    row_rates[d, j, k] = found[d, k] * (record.places[row, 8] if k > 3 else 1.0)
        zone = zones(record.met[first : first + count], inverse_mass)
        for j in range(count - fresh, count):
            if zone[j] < 0:
                continue
            chosen = take_zone(zone, j)
            points, rows, force = _rows_of(record, first, chosen, force_row)
            regular = record.forces[force_row + chosen[0], 1]
            matrix, pivots, active = _factorised(points, rows, force, regular, inverse_mass)
            for d in range(directions):
                _zone_tangent(
                    points,
                    rows,
                    force,
                    1 - choices.residue,
                    (matrix, pivots, active),
                    row_rates[d],
                    chosen,
                    candidate,
                    inverse_mass,
                    before[d],
                    mass_rates[d],
                    places[d],
                )
        force_row += count


@kernel
def _replayed(
    choices: Projection, record: Impacts, begin: Ints, passes: int, candidate: Floats, inverse_mass: Floats
) -> Floats:
    """Positions [P + 1, N, 3] before each pass, and after the last one."""
    history = np.empty((passes + 1, len(candidate), 3))
    copy_to(history[0], candidate)
    first, force_row = begin[1], begin[3]
    for p in range(passes):
        copy_to(history[p + 1], history[p])
        count, fresh = record.passes[begin[2] + p, 0], record.passes[begin[2] + p, 1]
        zone = zones(record.met[first : first + count], inverse_mass)
        for j in range(count - fresh, count):
            if zone[j] >= 0:
                points, rows, force = _rows_of(record, first, take_zone(zone, j), force_row)
                move(points, rows, force, 1 - choices.residue, inverse_mass, candidate, history[p + 1])
        force_row += count
    return history


@kernel
def _rows_of(record: Impacts, first: int, chosen: Ints, force_row: int):  # type: ignore[no-untyped-def]
    """Points [m, 4], places [m, 9] and λ [m] of the rows of a zone."""
    count = len(chosen)
    points, rows, force = np.empty((count, 4), np.int64), np.empty((count, 9)), np.empty(count)
    for m in range(count):
        for k in range(4):
            points[m, k] = record.met[first + chosen[m], 1 + k]
        for k in range(9):
            rows[m, k] = record.places[first + chosen[m], k]
        force[m] = record.forces[force_row + chosen[m], 0]
    return points, rows, force


@kernel
def _meeting_inputs(record: Impacts, row: int, start: Floats, places: Floats, inputs: Floats) -> None:
    """Write the start and end positions of a row's four points to `inputs` [24]."""
    for k in range(4):
        for axis in range(3):
            inputs[3 * k + axis] = start[record.met[row, 1 + k], axis]
            inputs[12 + 3 * k + axis] = places[record.met[row, 1 + k], axis]


@kernel
def _factorised(points: Ints, rows: Floats, force: Floats, regular: float, inverse_mass: Floats):  # type: ignore[no-untyped-def]
    """Factor, pivots and active rows of G + ε diag G, where the active rows are those with a positive force."""
    count = 0
    for m in range(len(force)):
        if force[m] > 0:
            count += 1
    active = np.empty(count, np.int64)
    place = 0
    for m in range(len(force)):
        if force[m] > 0:
            active[place] = m
            place += 1
    whole = gram(points, rows, inverse_mass)
    matrix, pivots = np.empty((count, count)), np.empty(count, np.int64)
    for a in range(count):
        for b in range(count):
            matrix[a, b] = whole[active[a], active[b]]
        matrix[a, a] *= 1 + regular
    lu(matrix, pivots)
    return matrix, pivots, active


@kernel
def _zone_reverse(
    points: Ints,
    rows: Floats,
    force: Floats,
    regular: float,
    part: float,
    candidate: Floats,
    inverse_mass: Floats,
    places: Floats,
    before: Floats,
    mass_gradient: Floats,
) -> Floats:
    """Backward pass through one zone of one pass.

    Moves the gradient of its points to those of the candidate and the inverse masses. Returns the gradient of the rows'
    weights and normals [m, 7]. Let q be the gradient of the positions, μ the adjoint of λ, z = Wᵀ λ, s = Wᵀ μ, and
    Q = c q - s. Then the sums over rows are those of λ_j W_j M⁻¹ Q - μ_j W_j (x̂ + M⁻¹ z).
    """
    matrix, pivots, active = _factorised(points, rows, force, regular, inverse_mass)
    adjoint = np.zeros(len(force))
    right = np.empty(len(active))
    for a in range(len(active)):
        m = active[a]
        right[a] = 0.0
        for k in range(4):
            i = points[m, k]
            for axis in range(3):
                right[a] += part * rows[m, k] * rows[m, 4 + axis] * inverse_mass[i] * places[i, axis]
    lu_solve(matrix, pivots, right)
    for a in range(len(active)):
        adjoint[active[a]] = right[a]
    pushed, pulled = np.zeros(candidate.shape), np.zeros(candidate.shape)  # z and s
    for m in range(len(force)):
        for k in range(4):
            for axis in range(3):
                pushed[points[m, k], axis] += force[m] * rows[m, k] * rows[m, 4 + axis]
                pulled[points[m, k], axis] += adjoint[m] * rows[m, k] * rows[m, 4 + axis]
    found = np.zeros((len(force), 7))
    for m in range(len(force)):
        for k in range(4):
            i = points[m, k]
            for axis in range(3):
                slope = force[m] * inverse_mass[i] * (part * places[i, axis] - pulled[i, axis])
                slope -= adjoint[m] * (candidate[i, axis] + inverse_mass[i] * pushed[i, axis])
                found[m, k] += slope * rows[m, 4 + axis]
                found[m, 4 + axis] += slope * rows[m, k]
    for m in range(len(force)):
        for k in range(4):
            i = points[m, k]
            for axis in range(3):  # each point once, so its sums are cleared afterwards
                before[i, axis] -= pulled[i, axis]
                if inverse_mass[i] > 0:
                    mass_gradient[i] += (part * places[i, axis] - pulled[i, axis]) * pushed[i, axis]
                    before[i, axis] += places[i, axis]
                    places[i, axis] = 0.0
                pulled[i, axis] = pushed[i, axis] = 0.0
    return found


@kernel
def _zone_tangent(  # type: ignore[no-untyped-def]
    points: Ints,
    rows: Floats,
    force: Floats,
    part: float,
    factor,
    row_rates: Floats,
    chosen: Ints,
    candidate: Floats,
    inverse_mass: Floats,
    before: Floats,
    mass_rates: Floats,
    places: Floats,
) -> None:
    """Forward pass through one zone of one pass, along one direction: updates the derivatives of its points."""
    matrix, pivots, active = factor
    pushed, change = np.zeros(candidate.shape), np.zeros(candidate.shape)  # z and its derivative
    for m in range(len(force)):
        rate = row_rates[chosen[m]]
        for k in range(4):
            for axis in range(3):
                pushed[points[m, k], axis] += force[m] * rows[m, k] * rows[m, 4 + axis]
                change[points[m, k], axis] += force[m] * (rate[k] * rows[m, 4 + axis] + rows[m, k] * rate[4 + axis])
    right = np.zeros(len(active))
    for a in range(len(active)):
        m = active[a]
        rate = row_rates[chosen[m]]
        for k in range(4):
            i = points[m, k]
            mobility = mass_rates[i] if inverse_mass[i] > 0 else 0.0
            for axis in range(3):
                right[a] -= (rate[k] * rows[m, 4 + axis] + rows[m, k] * rate[4 + axis]) * (
                    candidate[i, axis] + inverse_mass[i] * pushed[i, axis]
                )
                right[a] -= (rows[m, k] * rows[m, 4 + axis]) * (
                    before[i, axis] + mobility * pushed[i, axis] + inverse_mass[i] * change[i, axis]
                )
    lu_solve(matrix, pivots, right)
    for a in range(len(active)):
        m = active[a]
        for k in range(4):
            for axis in range(3):
                change[points[m, k], axis] += right[a] * rows[m, k] * rows[m, 4 + axis]
    for m in range(len(force)):
        for k in range(4):
            i = points[m, k]
            if inverse_mass[i] > 0:
                for axis in range(3):
                    places[i, axis] = before[i, axis] + part * (
                        mass_rates[i] * pushed[i, axis] + inverse_mass[i] * change[i, axis]
                    )
