"""Sparse LU of nonsymmetric matrices with a symmetric pattern, in 3 x 3 blocks, with dense LU as a fallback.

    A = L U,   L_jj = I,   U_jj = D_j

Both factors are stored in the pattern of the lower one: L with D_j⁻¹ on its diagonal, and U transposed. There is no
pivoting beyond the blocks, which is accurate for matrices with a strong diagonal. The residual of the first solution is
checked. If it is large, dense LU with pivoting solves all systems with this matrix.
"""

from __future__ import annotations

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.box import Box, BoxType, define
from diffcloud.sim.compiled.data import Floats
from diffcloud.sim.compiled.dense import lu, lu_solve, lu_solve_transposed
from diffcloud.sim.compiled.sparse import Pattern, _await_next, _take_off

_GOOD = 1e-9
"""Largest acceptable residual of a solution, relative to the sizes of the matrix and of both sides."""


class GeneralType(BoxType):  # type: ignore[misc]
    """Numba type of `General`."""


class General(Box):  # type: ignore[misc]
    """A nonsymmetric matrix and its factors.

    Fields:
        pattern: `sparse.Pattern`
        lower: [A + 1, 9] blocks of the lower half and the diagonal.
        upper: [A + 1, 9] blocks of the upper half, transposed; its diagonal is unused.
        below: [L, 9] L, with D⁻¹ on its diagonal.
        above: [L, 9] U transposed, without its diagonal.
        sound: 1 if a solution by the factors was checked and is accurate; -1 if it is not; 0 before the check.
    """


define(General, GeneralType, ["pattern", "lower", "upper", "below", "above", "sound"])


@kernel
def factorised(of: Pattern, lower: Floats, upper: Floats) -> General:
    """Factorise a matrix. If a pivot is singular, the factors contain non-finite numbers."""
    count = len(of.place)
    starts, rows = of.factor_starts, of.factor_rows
    below, above = np.empty((len(rows), 9)), np.empty((len(rows), 9))
    work, other = np.zeros((count, 9)), np.zeros((count, 9))
    reached = np.empty(count, np.int64)  # as in `sparse.cholesky`
    waiting = np.full(count, -1, np.int64)
    following = np.empty(count, np.int64)
    for j in range(count):
        for p in range(of.starts[j], of.starts[j + 1]):
            for k9 in range(9):
                work[of.rows[p], k9], other[of.rows[p], k9] = lower[p, k9], upper[p, k9]
        k = waiting[j]
        while k >= 0:
            after = following[k]
            _take_off(work, below, above, rows, reached[k], starts[k + 1])
            _take_off(other, above, below, rows, reached[k], starts[k + 1])
            _await_next(k, reached, waiting, following, rows, starts)
            k = after
        begin = starts[j]
        _invert(work, j, below, begin)
        for k9 in range(9):
            work[j, k9] = other[j, k9] = above[begin, k9] = 0.0
        d0, d1, d2 = below[begin, 0], below[begin, 1], below[begin, 2]
        d3, d4, d5 = below[begin, 3], below[begin, 4], below[begin, 5]
        d6, d7, d8 = below[begin, 6], below[begin, 7], below[begin, 8]
        for p in range(begin + 1, starts[j + 1]):
            i = rows[p]
            for r in range(0, 9, 3):
                a, b, c = work[i, r], work[i, r + 1], work[i, r + 2]
                below[p, r] = a * d0 + b * d3 + c * d6
                below[p, r + 1] = a * d1 + b * d4 + c * d7
                below[p, r + 2] = a * d2 + b * d5 + c * d8
            for k9 in range(9):
                above[p, k9] = other[i, k9]
                work[i, k9] = other[i, k9] = 0.0
        reached[j] = begin
        _await_next(j, reached, waiting, following, rows, starts)
    return General(of, lower, upper, below, above, 0)


@kernel
def _invert(blocks: Floats, given: int, inverses: Floats, taken: int) -> None:
    """Write the inverse of block `given` [., 9] to block `taken` of `inverses`."""
    m, n, o = blocks[given, 0], blocks[given, 1], blocks[given, 2]
    p, q, r = blocks[given, 3], blocks[given, 4], blocks[given, 5]
    s, t, u = blocks[given, 6], blocks[given, 7], blocks[given, 8]
    a, b, c = q * u - r * t, r * s - p * u, p * t - q * s
    scale = 1.0 / (m * a + n * b + o * c)
    found = (a, o * t - n * u, n * r - o * q, b, m * u - o * s, o * p - m * r, c, n * s - m * t, m * q - n * p)
    for k in range(9):
        inverses[taken, k] = found[k] * scale


@kernel
def solve_general(of: General, right: Floats, transposed: int, solution: Floats) -> bool:
    """Solve A x = right or Aᵀ x = right into `solution` [V, 3]. Return False if the matrix is singular."""
    if transposed > 0:
        _substitute(of.pattern, of.below, of.above, of.below, right, 1, solution)
    else:
        _substitute(of.pattern, of.below, of.below, of.above, right, 0, solution)
    if of.sound == 0:
        of.sound = _judged(of, right, transposed, solution)
        if of.sound == 0:
            return True
    return True if of.sound > 0 else _dense(of, right, transposed, solution)


@kernel
def _substitute(
    of: Pattern, below: Floats, first: Floats, second: Floats, right: Floats, transposed: int, solution: Floats
) -> None:
    """Forward substitution with one factor, then backward substitution with the other."""
    place, starts, rows = of.place, of.factor_starts, of.factor_rows
    count = len(place)
    work = np.empty((count, 3))
    for node in range(count):
        for axis in range(3):
            work[place[node], axis] = right[node, axis]
    for j in range(count):
        own, d = work[j], below[starts[j]]
        a, b, c = own[0], own[1], own[2]
        if transposed > 0:  # the diagonal blocks belong to U, which comes first here
            own[0], own[1], own[2] = (
                d[0] * a + d[3] * b + d[6] * c,
                d[1] * a + d[4] * b + d[7] * c,
                d[2] * a + d[5] * b + d[8] * c,
            )
            a, b, c = own[0], own[1], own[2]
        for p in range(starts[j] + 1, starts[j + 1]):
            f, w = first[p], work[rows[p]]
            w[0] -= f[0] * a + f[1] * b + f[2] * c
            w[1] -= f[3] * a + f[4] * b + f[5] * c
            w[2] -= f[6] * a + f[7] * b + f[8] * c
    for j in range(count - 1, -1, -1):
        own, d = work[j], below[starts[j]]
        a, b, c = own[0], own[1], own[2]
        for p in range(starts[j] + 1, starts[j + 1]):
            f, w = second[p], work[rows[p]]
            a -= f[0] * w[0] + f[3] * w[1] + f[6] * w[2]
            b -= f[1] * w[0] + f[4] * w[1] + f[7] * w[2]
            c -= f[2] * w[0] + f[5] * w[1] + f[8] * w[2]
        if transposed > 0:
            own[0], own[1], own[2] = a, b, c
        else:
            own[0], own[1], own[2] = (
                d[0] * a + d[1] * b + d[2] * c,
                d[3] * a + d[4] * b + d[5] * c,
                d[6] * a + d[7] * b + d[8] * c,
            )
    for node in range(count):
        for axis in range(3):
            solution[node, axis] = work[place[node], axis]


@kernel
def _judged(of: General, right: Floats, transposed: int, solution: Floats) -> int:
    """Check a solution's residual. Return 1: small; -1: large; 0: unknown, because all terms are zero."""
    pattern, low, high = of.pattern, of.lower, of.upper
    count = len(pattern.place)
    node = np.empty(count, np.int64)
    for i in range(count):
        node[pattern.place[i]] = i
    left, size = np.zeros((count, 3)), np.zeros((count, 3))
    for i in range(count):
        for axis in range(3):
            left[i, axis], size[i, axis] = right[i, axis], abs(right[i, axis])
    for j in range(count):
        for p in range(pattern.starts[j], pattern.starts[j + 1]):
            i = pattern.rows[p]
            row, column = node[i], node[j]
            lower, upper = (high[p], low[p]) if transposed > 0 and i != j else (low[p], high[p])
            for r in range(3):
                for c in range(3):
                    place = 3 * c + r if transposed > 0 and i == j else 3 * r + c
                    part = lower[place] * solution[column, c]
                    left[row, r] -= part
                    size[row, r] += abs(part)
                    if i != j:
                        part = upper[3 * r + c] * solution[row, r]  # block (j, i), transposed
                        left[column, c] -= part
                        size[column, c] += abs(part)
    worst, largest = 0.0, 0.0
    for i in range(count):
        for axis in range(3):
            if not np.isfinite(left[i, axis]):
                return -1
            worst, largest = max(worst, abs(left[i, axis])), max(largest, size[i, axis])
    if largest == 0:
        return 0
    return 1 if worst <= _GOOD * largest else -1


@kernel
def _dense(of: General, right: Floats, transposed: int, solution: Floats) -> bool:
    """Solve by dense LU. Return False, with NaN or inf in the solution, if the matrix is singular."""
    pattern, low, high = of.pattern, of.lower, of.upper
    count = len(pattern.place)
    matrix = np.zeros((3 * count, 3 * count))
    for j in range(count):
        for p in range(pattern.starts[j], pattern.starts[j + 1]):
            i = pattern.rows[p]
            for r in range(3):
                for c in range(3):
                    matrix[3 * i + r, 3 * j + c] = low[p, 3 * r + c]
                    if i != j:
                        matrix[3 * j + c, 3 * i + r] = high[p, 3 * r + c]
    pivots, work = np.empty(3 * count, np.int64), np.empty(3 * count)
    if not lu(matrix, pivots):
        solution[:] = np.nan
        return False
    for i in range(count):
        for axis in range(3):
            work[3 * pattern.place[i] + axis] = right[i, axis]
    if transposed > 0:
        lu_solve_transposed(matrix, pivots, work)
    else:
        lu_solve(matrix, pivots, work)
    finite = True
    for i in range(count):
        for axis in range(3):
            solution[i, axis] = work[3 * pattern.place[i] + axis]
            finite = finite and np.isfinite(solution[i, axis])
    return finite
