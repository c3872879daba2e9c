"""Dense linear systems inside kernels: LU with partial pivoting."""

from __future__ import annotations

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats, Ints


@kernel
def lu(matrix: Floats, pivots: Ints) -> bool:
    """Factorise a matrix [n, n] in place; `pivots` [n] receives the row with which each row was swapped. Return False if
    the matrix is singular."""
    count = len(matrix)
    for k in range(count):
        best = k
        for i in range(k + 1, count):
            if abs(matrix[i, k]) > abs(matrix[best, k]):
                best = i
        pivots[k] = best
        if not abs(matrix[best, k]) > 0:
            return False
        if best != k:
            for j in range(count):
                matrix[k, j], matrix[best, j] = matrix[best, j], matrix[k, j]
        for i in range(k + 1, count):
            factor = matrix[i, k] / matrix[k, k]
            matrix[i, k] = factor
            if factor != 0:
                for j in range(k + 1, count):
                    matrix[i, j] -= factor * matrix[k, j]
    return True


@kernel
def lu_solve(matrix: Floats, pivots: Ints, right: Floats) -> None:
    """Solve a linear system with a factorised matrix; `right` [n] is replaced by the solution."""
    count = len(matrix)
    for k in range(count):  # all row swaps first: later swaps also permuted the rows of the factor
        right[k], right[pivots[k]] = right[pivots[k]], right[k]
    for k in range(count):
        for i in range(k + 1, count):
            right[i] -= matrix[i, k] * right[k]
    for k in range(count - 1, -1, -1):
        for j in range(k + 1, count):
            right[k] -= matrix[k, j] * right[j]
        right[k] /= matrix[k, k]


@kernel
def lu_solve_transposed(matrix: Floats, pivots: Ints, right: Floats) -> None:
    """Solve the system with the transposed matrix; `right` [n] is replaced by the solution."""
    count = len(matrix)
    for k in range(count):
        for j in range(k):
            right[k] -= matrix[j, k] * right[j]
        right[k] /= matrix[k, k]
    for k in range(count - 1, -1, -1):
        for i in range(k + 1, count):
            right[k] -= matrix[i, k] * right[i]
    for k in range(count - 1, -1, -1):
        right[k], right[pivots[k]] = right[pivots[k]], right[k]
