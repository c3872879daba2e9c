"""Solver for the smallest correction that satisfies constraints: min ½ Σ m_i |x_i - x̂_i|² subject to W x >= h. By its
dual,

    x = x̂ + M⁻¹ Wᵀ λ,   λ >= 0,   W x >= h,   λ·(W x - h) = 0 .

A row of W is n_j · Σ w_jk x_k over the four points of a pair. All functions treat one zone: rows that share points.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Flags, Floats, Ints
from diffcloud.sim.compiled.dense import lu, lu_solve

_EXCHANGES = 10
"""Maximum number of exchanges of the active set. After that, a slower but reliable solver is used. Of 10,000 problems of
folded cloths, none needed more than 7 exchanges, except for 1 % that cycled."""
_ROUNDING = 2.0**-52
REGULAR = 500 * _ROUNDING
"""Added to the unit diagonal of the dual problem, so that redundant constraints (a point with two impacts) share their
force."""
HARD = 1e-7
"""Added instead if constraints contradict each other. They are then satisfied in the least-squares sense."""
_CONTRADICTION = 1e-6
"""A zone counts as contradictory if a constraint is violated by more than this fraction of the largest correction."""
_TINY = 1e-300


@kernel
def gram(points: Ints, places: Floats, inverse_mass: Floats) -> Floats:
    """Matrix W M⁻¹ Wᵀ [m, m] of rows with points [m, 4] and places [m, 7] (weights, then normal)."""
    count = len(points)
    found = np.zeros((count, count))
    for i in range(count):
        for j in range(i, count):
            total = 0.0
            for a in range(4):
                for b in range(4):
                    if points[i, a] == points[j, b]:
                        total += places[i, a] * places[j, b] * inverse_mass[points[i, a]]
            if total != 0:
                total *= places[i, 4] * places[j, 4] + places[i, 5] * places[j, 5] + places[i, 6] * places[j, 6]
            found[i, j] = found[j, i] = total
    return found


@kernel
def applied(points: Ints, places: Floats, x: Floats) -> Floats:
    """Product W x [m] for positions x [N, 3]."""
    found = np.zeros(len(points))
    for j in range(len(points)):
        for k in range(4):
            i = points[j, k]
            found[j] += places[j, k] * (places[j, 4] * x[i, 0] + places[j, 5] * x[i, 1] + places[j, 6] * x[i, 2])
    return found


@kernel
def solve_dual(matrix: Floats, target: Floats, force: Floats) -> float:
    """Solve matrix λ >= target with λ >= 0 and complementarity, by a primal-dual active set method.

    The method (Hintermüller, Ito & Kunisch 2002) exchanges all wrong rows at once. It mostly converges after a few
    exchanges, but can cycle. Then non-negative least squares is used (Lawson & Hanson 1974).

    Args:
        force: [m] positive for rows that were active before; receives λ.

    Returns:
        The regularisation that was added to the unit diagonal.
    """
    count = len(target)
    scale, right, unit = np.empty(count), np.empty(count), np.empty((count, count))
    largest = 0.0
    for i in range(count):
        scale[i] = 1 / sqrt(max(matrix[i, i], _TINY))
        right[i] = target[i] * scale[i]
        largest = max(largest, abs(right[i]))
    for i in range(count):
        for j in range(count):
            unit[i, j] = matrix[i, j] * scale[i] * scale[j]
    active = np.empty(count, np.bool_)
    for i in range(count):
        active[i] = right[i] > 0 or force[i] > 0
    tolerance, regular = 10 * REGULAR * largest, REGULAR
    found = np.zeros(count)
    settled = False
    for _ in range(_EXCHANGES):
        found = solve_active(unit, right, active, regular)
        settled = True
        for i in range(count):
            following = found[i] > 0 if active[i] else _lacking(unit, right, found, i) > tolerance
            if following != active[i]:
                active[i], settled = following, False
        if settled:
            break
    for i in range(count):
        if _lacking(unit, right, found, i) > _CONTRADICTION * largest:
            settled = False
    if not settled:  # rare: the active set cycles, or there is no solution
        regular = REGULAR
        active = least_distance(unit, right, 10 * REGULAR)
        found = solve_active(unit, right, active, 10 * REGULAR)
        for i in range(count):
            if _lacking(unit, right, found, i) > _CONTRADICTION * largest:
                regular = HARD
        if regular == HARD:
            active = least_distance(unit, right, HARD)
        found = solve_active(unit, right, active, regular)
    for i in range(count):
        force[i] = max(found[i], 0.0) * scale[i]
    return regular


@kernel
def _lacking(matrix: Floats, right: Floats, force: Floats, row: int) -> float:
    """Violation of a row."""
    missing = right[row]
    for j in range(len(force)):
        missing -= matrix[row, j] * force[j]
    return missing


@kernel
def solve_active(matrix: Floats, right: Floats, active: Flags, regular: float) -> Floats:
    """λ [m] of the active rows of a problem with unit diagonal; zero for the others."""
    count = 0
    for i in range(len(right)):
        count += active[i]
    rows, part, found = np.empty(count, np.int64), np.empty((count, count)), np.zeros(len(right))
    place = 0
    for i in range(len(right)):
        if active[i]:
            rows[place] = i
            place += 1
    solution, pivots = np.empty(count), np.empty(count, np.int64)
    for i in range(count):
        for j in range(count):
            part[i, j] = matrix[rows[i], rows[j]]
        part[i, i] += regular
        solution[i] = right[rows[i]]
    lu(part, pivots)
    lu_solve(part, pivots, solution)
    for i in range(count):
        found[rows[i]] = solution[i]
    return found


@kernel
def least_distance(matrix: Floats, right: Floats, regular: float) -> Flags:
    """Active set, bool [m], of min ½ λᵀ A λ - rightᵀ λ over λ >= 0, by the method of Lawson and Hanson."""
    count, largest = len(right), 0.0
    for i in range(count):
        largest = max(largest, abs(right[i]))
    active, force = np.zeros(count, np.bool_), np.zeros(count)
    for _ in range(30 * count):
        best, most = -1, 0.0
        for i in range(count):
            lacking = _lacking(matrix, right, force, i) - regular * force[i]
            if not active[i] and lacking > most:
                best, most = i, lacking
        if best < 0 or most <= regular * largest:
            break
        active[best] = True
        while True:
            found = solve_active(matrix, right, active, regular)
            part, limiting = 1.0, -1
            for i in range(count):
                if active[i] and found[i] <= 0:
                    reach = force[i] / (force[i] - found[i]) if force[i] > found[i] else 0.0
                    if limiting < 0 or reach < part:
                        part, limiting = reach, i
            for i in range(count):
                force[i] += part * (found[i] - force[i])
            if limiting < 0:
                break
            active[limiting], force[limiting] = False, 0.0
    return active
