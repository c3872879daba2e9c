"""Sparse direct solvers for the matrices of a step, in 3 x 3 blocks, one for each pair of nodes that share an element.

Nodes are renumbered: the *place* of a node is its position in an elimination order that keeps the factors small (minimum
degree, computed by SuperLU). The lower half is stored by columns. The *slots* of an element are the precomputed positions
of its blocks. Contact between parts of the cloth that share no element adds blocks temporarily. Then the pattern of the
factor is computed again, and also the order if the factor has grown too much (`ordering`).

ARCSim's step uses Cholesky. The exact Jacobian of the implicit step is not symmetric, but its pattern is. It uses block LU,
with the upper half stored transposed in the pattern of the lower one. There is no pivoting beyond the blocks.
`solve_general` checks the residual and falls back to a dense factorisation.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.copying import copy_to
from diffcloud.sim.compiled.data import Floats, Ints
from diffcloud.sim.compiled.ordering import minimum_degree
from diffcloud.sim.compiled.sorting import sort_part


class Pattern(NamedTuple):
    """Positions of the blocks of a symmetric matrix, and of its factor."""

    place: Ints
    """[V] position of each node in the elimination order."""
    starts: Ints
    """[V + 1] start of each column of the lower half in `rows`."""
    rows: Ints
    """[A] places, ascending within a column, the diagonal first."""
    factor_starts: Ints
    """[V + 1] start of each column of the factor in `factor_rows`."""
    factor_rows: Ints
    """[L] places, as `rows`."""


def pattern(node_count: int, groups: Sequence[Ints]) -> Pattern:
    """Build the pattern that couples the nodes of each element, from groups of elements [E, n]."""
    first = np.concatenate([np.arange(node_count), *(np.repeat(nodes, nodes.shape[1], axis=1).ravel() for nodes in groups)])
    second = np.concatenate([np.arange(node_count), *(np.tile(nodes, nodes.shape[1]).ravel() for nodes in groups)])
    place = _fill_reducing(node_count, first, second)
    row, column = np.maximum(place[first], place[second]), np.minimum(place[first], place[second])
    key = np.unique(column * node_count + row)
    starts = np.searchsorted(key // node_count, np.arange(node_count + 1)).astype(np.int64)
    rows = key % node_count
    factor_starts, factor_rows = factor_pattern(starts, rows)
    return Pattern(place, starts, rows, factor_starts, factor_rows)


def slots(of: Pattern, nodes: Ints) -> Ints:
    """Position [E, pairs] of the block of each pair (a, b >= a) of an element's nodes: s, or ~s if it is stored
    transposed."""
    count = len(of.place)
    column_of = np.repeat(np.arange(count), np.diff(of.starts))
    key = column_of * count + of.rows
    first, second = np.triu_indices(nodes.shape[1])
    row, column = of.place[nodes[:, first]], of.place[nodes[:, second]]
    found = np.searchsorted(key, np.minimum(row, column) * count + np.maximum(row, column))
    return np.where(row >= column, found, ~found).astype(np.int64)


def _fill_reducing(node_count: int, first: Ints, second: Ints) -> Ints:
    """Places [V] by minimum degree."""
    graph = csc_matrix(coo_matrix((np.ones(len(first)), (first, second)), shape=(node_count, node_count)))
    graph.data[:] = 1.0
    graph += csc_matrix((np.full(node_count, 2.0 * node_count), (np.arange(node_count),) * 2), shape=graph.shape)
    found = splu(graph, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return found.perm_c.astype(np.int64)


@kernel
def factor_pattern(starts: Ints, rows: Ints) -> tuple[Ints, Ints]:
    """Starts and rows of the factor. Each column inherits the rows of the columns whose first off-diagonal row it is."""
    count = len(starts) - 1
    first_child = np.full(count, -1, np.int64)
    next_child = np.full(count, -1, np.int64)
    seen = np.full(count, -1, np.int64)
    found = np.empty(4 * len(rows) + count, np.int64)
    found_starts = np.zeros(count + 1, np.int64)
    used = 0
    for j in range(count):
        begin = used
        if used + count > len(found):
            longer = np.empty(2 * len(found) + count, np.int64)
            for p in range(used):
                longer[p] = found[p]
            found = longer
        seen[j] = j
        found[used] = j
        used += 1
        for p in range(starts[j], starts[j + 1]):
            i = rows[p]
            if seen[i] != j:
                seen[i] = j
                found[used] = i
                used += 1
        child = first_child[j]
        while child >= 0:
            for p in range(found_starts[child] + 1, found_starts[child + 1]):
                i = found[p]
                if seen[i] != j:
                    seen[i] = j
                    found[used] = i
                    used += 1
            child = next_child[child]
        sort_part(found, begin, used)
        found_starts[j + 1] = used
        if used > begin + 1:
            parent = found[begin + 1]
            next_child[j] = first_child[parent]
            first_child[parent] = j
    return found_starts, found[:used]


@kernel
def add_assemble(slots: Ints, blocks: Floats, matrix: Floats) -> None:
    """Add the symmetric blocks [E, pairs, 9] of elements to the stored half of a matrix."""
    for e in range(len(slots)):
        for p in range(slots.shape[1]):
            _add_block(slots[e, p], blocks, e, p, matrix, matrix)


@kernel
def add_jacobian(slots: Ints, blocks: Floats, lower: Floats, upper: Floats) -> None:
    """Add nonsymmetric blocks [E, n², 9] of elements to the lower half and to the upper half, which is stored
    transposed."""
    corners = int(sqrt(blocks.shape[1]))
    for e in range(len(slots)):
        p = 0
        for a in range(corners):
            for b in range(a, corners):
                slot = slots[e, p]
                _add_block(slot, blocks, e, a * corners + b, lower, upper)
                if b > a:
                    _add_block(~slot, blocks, e, b * corners + a, lower, upper)
                p += 1


@kernel
def _add_block(slot, blocks, e, p, lower, upper):  # type: ignore[no-untyped-def]
    """Add block p of element e to its half."""
    b0, b1, b2 = blocks[e, p, 0], blocks[e, p, 1], blocks[e, p, 2]
    b3, b4, b5 = blocks[e, p, 3], blocks[e, p, 4], blocks[e, p, 5]
    b6, b7, b8 = blocks[e, p, 6], blocks[e, p, 7], blocks[e, p, 8]
    half, place = lower, slot
    if slot < 0:
        half, place = upper, ~slot
        b1, b2, b3, b5, b6, b7 = b3, b6, b1, b7, b2, b5
    a0, a1, a2 = half[place, 0], half[place, 1], half[place, 2]
    a3, a4, a5 = half[place, 3], half[place, 4], half[place, 5]
    a6, a7, a8 = half[place, 6], half[place, 7], half[place, 8]
    half[place, 0], half[place, 1], half[place, 2] = a0 + b0, a1 + b1, a2 + b2
    half[place, 3], half[place, 4], half[place, 5] = a3 + b3, a4 + b4, a5 + b5
    half[place, 6], half[place, 7], half[place, 8] = a6 + b6, a7 + b7, a8 + b8


@kernel
def find_slot(of: Pattern, first: int, second: int) -> int:
    """Slot of the block (first, second) of two nodes, as in `slots`.

    Returns the spare slot after the last one if the pattern has no such block, or if a number is not a node.
    """
    spare = len(of.rows)
    if first >= len(of.place) or second >= len(of.place):
        return spare
    row, column = max(of.place[first], of.place[second]), min(of.place[first], of.place[second])
    low, high = of.starts[column], of.starts[column + 1]
    while low < high:
        middle = (low + high) // 2
        if of.rows[middle] < row:
            low = middle + 1
        else:
            high = middle
    if low == of.starts[column + 1] or of.rows[low] != row:
        return spare
    return low if of.place[first] >= of.place[second] else ~low


@kernel
def hold(of: Pattern, holder: Ints, mass: Floats, matrix: Floats) -> None:
    """Decouple nodes [V] that a handle prescribes (holder >= 0). Their diagonal becomes their mass."""
    free = np.ones(len(of.place), np.bool_)
    any_held = False
    for i in range(len(of.place)):
        if holder[i] >= 0:
            free[of.place[i]], any_held = False, True
    if not any_held:
        return
    for j in range(len(of.place)):
        for p in range(of.starts[j], of.starts[j + 1]):
            if not (free[j] and free[of.rows[p]]):
                matrix[p] = 0.0
    for i in range(len(of.place)):
        if holder[i] >= 0:
            block = matrix[of.starts[of.place[i]]]
            block[0] = block[4] = block[8] = mass[i]


@kernel
def widened(of: Pattern, first: Ints, second: Ints, place: Ints) -> tuple[Pattern, Ints]:
    """Extend a pattern by pairs of nodes, with a given elimination order.

    Args:
        first, second: nodes of the added pairs; duplicates are allowed.
        place: [V] position of each node in the elimination order; `of.place` keeps the old order.

    Returns:
        The pattern, and the new position [A] of each old block: s, or ~s if it is stored transposed.
    """
    count, known = len(place), len(of.rows)
    node = np.empty(count, np.int64)
    for i in range(count):
        node[of.place[i]] = i
    row, flipped = np.empty(known + len(first), np.int64), np.zeros(known, np.bool_)
    last, following = np.full(count, -1, np.int64), np.empty(len(row), np.int64)  # linked list of the blocks of each column
    for j in range(count):
        for p in range(of.starts[j], of.starts[j + 1]):
            a, b = place[node[of.rows[p]]], place[node[j]]
            flipped[p], row[p] = a < b, max(a, b)
            following[p], last[min(a, b)] = last[min(a, b)], p
    for e in range(len(first)):
        a, b = place[first[e]], place[second[e]]
        row[known + e] = max(a, b)
        following[known + e], last[min(a, b)] = last[min(a, b)], known + e
    starts, rows = np.zeros(count + 1, np.int64), np.empty(len(row), np.int64)
    moved, at = np.empty(known, np.int64), np.full(count, -1, np.int64)
    used = 0
    for j in range(count):
        begin, e = used, last[j]
        while e >= 0:
            if at[row[e]] < begin:
                at[row[e]], rows[used] = used, row[e]
                used += 1
            e = following[e]
        sort_part(rows, begin, used)
        for p in range(begin, used):
            at[rows[p]] = p
        e = last[j]
        while e >= 0:
            if e < known:
                moved[e] = ~at[row[e]] if flipped[e] else at[row[e]]
            e = following[e]
        starts[j + 1] = used
    rows = rows[:used].copy()
    factor_starts, factor_rows = factor_pattern(starts, rows)
    return Pattern(place, starts, rows, factor_starts, factor_rows), moved


@kernel
def reordered(of: Pattern) -> Ints:
    """Places [V] of the nodes in a new elimination order for this pattern, by `minimum_degree`."""
    count = len(of.place)
    starts = np.zeros(count + 1, np.int64)
    for j in range(count):
        for p in range(of.starts[j] + 1, of.starts[j + 1]):
            starts[j + 1] += 1
            starts[of.rows[p] + 1] += 1
    for j in range(count):
        starts[j + 1] += starts[j]
    neighbours, filled = np.empty(starts[count], np.int64), starts[:count].copy()
    for j in range(count):
        for p in range(of.starts[j] + 1, of.starts[j + 1]):
            i = of.rows[p]
            neighbours[filled[i]], neighbours[filled[j]] = j, i
            filled[i] += 1
            filled[j] += 1
    order, place = minimum_degree(starts, neighbours), np.empty(count, np.int64)
    for i in range(count):
        place[i] = order[of.place[i]]
    return place


@kernel
def cholesky(of: Pattern, matrix: Floats, factor: Floats) -> bool:
    """Cholesky factor [L, 9] of a matrix [A, 9] (left-looking). Return False if the matrix is not positive definite.
    Diagonal blocks of the factor store the inverses of their own diagonals."""
    count = len(of.place)
    starts, rows = of.factor_starts, of.factor_rows
    work = np.zeros((count, 9))
    reached = np.empty(count, np.int64)  # first unused entry of each finished column
    waiting = np.full(count, -1, np.int64)  # for each row, the finished columns that contribute to it next
    following = np.empty(count, np.int64)
    for j in range(count):
        for p in range(of.starts[j], of.starts[j + 1]):
            copy_to(work[of.rows[p]], matrix[p])
        k = waiting[j]
        while k >= 0:
            after = following[k]
            _take_off(work, factor, factor, rows, reached[k], starts[k + 1])
            _await_next(k, reached, waiting, following, rows, starts)
            k = after
        begin = starts[j]
        block = work[j]
        if not block[0] > 0:
            return False
        i0 = 1 / sqrt(block[0])
        l10, l20 = block[3] * i0, block[6] * i0
        pivot = block[4] - l10 * l10
        if not pivot > 0:
            return False
        i1 = 1 / sqrt(pivot)
        l21 = (block[7] - l20 * l10) * i1
        pivot = block[8] - l20 * l20 - l21 * l21
        if not pivot > 0:
            return False
        i2 = 1 / sqrt(pivot)
        diagonal = factor[begin]
        diagonal[0], diagonal[3], diagonal[4] = i0, l10, i1
        diagonal[6], diagonal[7], diagonal[8] = l20, l21, i2
        block[:] = 0.0
        for p in range(begin + 1, starts[j + 1]):
            block, found = work[rows[p]], factor[p]
            for r in range(0, 9, 3):
                a = block[r] * i0
                b = (block[r + 1] - a * l10) * i1
                found[r], found[r + 1] = a, b
                found[r + 2] = (block[r + 2] - a * l20 - b * l21) * i2
            block[:] = 0.0
        reached[j] = begin
        _await_next(j, reached, waiting, following, rows, starts)
    return True


@kernel
def _await_next(column, reached, waiting, following, rows, starts):  # type: ignore[no-untyped-def]
    """Queue a finished column for its next row."""
    reached[column] += 1
    if reached[column] < starts[column + 1]:
        row = rows[reached[column]]
        following[column] = waiting[row]
        waiting[row] = column


@kernel
def _take_off(work, left, right, rows, begin, end):  # type: ignore[no-untyped-def]
    """work[i] -= left[i, k] right[j, k]ᵀ for the rows i of column k from j = rows[begin] on."""
    t0, t1, t2 = right[begin, 0], right[begin, 1], right[begin, 2]
    t3, t4, t5 = right[begin, 3], right[begin, 4], right[begin, 5]
    t6, t7, t8 = right[begin, 6], right[begin, 7], right[begin, 8]
    for p in range(begin, end):
        i = rows[p]
        a0, a1, a2 = left[p, 0], left[p, 1], left[p, 2]
        b0, b1, b2 = left[p, 3], left[p, 4], left[p, 5]
        c0, c1, c2 = left[p, 6], left[p, 7], left[p, 8]
        w0, w1, w2 = work[i, 0], work[i, 1], work[i, 2]
        w3, w4, w5 = work[i, 3], work[i, 4], work[i, 5]
        w6, w7, w8 = work[i, 6], work[i, 7], work[i, 8]
        # All reads come before all writes, so that the compiler can vectorise.
        w0 -= a0 * t0 + a1 * t1 + a2 * t2
        w1 -= a0 * t3 + a1 * t4 + a2 * t5
        w2 -= a0 * t6 + a1 * t7 + a2 * t8
        w3 -= b0 * t0 + b1 * t1 + b2 * t2
        w4 -= b0 * t3 + b1 * t4 + b2 * t5
        w5 -= b0 * t6 + b1 * t7 + b2 * t8
        w6 -= c0 * t0 + c1 * t1 + c2 * t2
        w7 -= c0 * t3 + c1 * t4 + c2 * t5
        w8 -= c0 * t6 + c1 * t7 + c2 * t8
        work[i, 0], work[i, 1], work[i, 2] = w0, w1, w2
        work[i, 3], work[i, 4], work[i, 5] = w3, w4, w5
        work[i, 6], work[i, 7], work[i, 8] = w6, w7, w8


@kernel
def solve(of: Pattern, factor: Floats, right: Floats, solution: Floats) -> None:
    """solution [V, 3] = A⁻¹ right, with a Cholesky factor."""
    count = len(of.place)
    starts, rows = of.factor_starts, of.factor_rows
    work = np.empty((count, 3))
    for node in range(count):
        copy_to(work[of.place[node]], right[node])
    for j in range(count):
        d = factor[starts[j]]
        a = work[j, 0] * d[0]
        b = (work[j, 1] - d[3] * a) * d[4]
        c = (work[j, 2] - d[6] * a - d[7] * b) * d[8]
        work[j, 0], work[j, 1], work[j, 2] = a, b, c
        for p in range(starts[j] + 1, starts[j + 1]):
            f, w = factor[p], work[rows[p]]
            w[0] -= f[0] * a + f[1] * b + f[2] * c
            w[1] -= f[3] * a + f[4] * b + f[5] * c
            w[2] -= f[6] * a + f[7] * b + f[8] * c
    for j in range(count - 1, -1, -1):
        a, b, c = work[j, 0], work[j, 1], work[j, 2]
        for p in range(starts[j] + 1, starts[j + 1]):
            f, w = factor[p], work[rows[p]]
            a -= f[0] * w[0] + f[3] * w[1] + f[6] * w[2]
            b -= f[1] * w[0] + f[4] * w[1] + f[7] * w[2]
            c -= f[2] * w[0] + f[5] * w[1] + f[8] * w[2]
        d = factor[starts[j]]
        c *= d[8]
        b = (b - d[7] * c) * d[4]
        work[j, 0], work[j, 1], work[j, 2] = (a - d[3] * b - d[6] * c) * d[0], b, c
    for node in range(count):
        copy_to(solution[node], work[of.place[node]])
