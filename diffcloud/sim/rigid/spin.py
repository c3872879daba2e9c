"""Rotation of a rigid body in one step, as a formula with generated derivatives.

    R₁ = exp(Δt ω₁) R₀,      (L₁ - L₀)/M = R₁ G R₁ᵀ ω₁ - R₀ G R₀ᵀ ω₀

R is the orientation, ω the angular velocity, L the angular momentum, and M the mass. G is the inertia per mass in the body
frame.
"""

from __future__ import annotations

from collections.abc import Sequence

from diffcloud.sim.compiled.function import Function
from diffcloud.sim.compiled.trace import Scalar, Vector, cosine, cross, dot, sine, squareroot, where

_SMALL = 1e-8
"""Squared angle [rad²] below which a series replaces sin(x)/x and similar quotients. Its error is below 1e-16."""


def _spin(inputs: Sequence[Scalar], constants: Sequence[Scalar]) -> list[Scalar]:
    """Return R₁ [9] and the change of angular momentum per mass [m²/s], for inputs (R₀ [9], ω₀ [3], ω₁ [3]) and constants
    (Δt, G [9])."""
    before = [Vector(*inputs[3 * row : 3 * row + 3]) for row in range(3)]
    first, last = Vector(*inputs[9:12]), Vector(*inputs[12:15])
    gyration = [Vector(*constants[1 + 3 * row : 4 + 3 * row]) for row in range(3)]
    turn = constants[0] * last
    squared = dot(turn, turn)
    small = squared < _SMALL
    safe = where(small, 1.0, squared)
    angle = squareroot(safe)
    along = where(small, 1 - squared / 6.0, sine(angle) / angle)
    across = where(small, 0.5 - squared / 24.0, (1 - cosine(angle)) / safe)
    columns = []
    for axis in range(3):
        column = Vector(*(row[axis] for row in before))
        moved = cross(turn, column)
        columns.append(column + along * moved + across * cross(turn, moved))
    after = [Vector(*(column[row] for column in columns)) for row in range(3)]
    change = _momentum(after, gyration, last) - _momentum(before, gyration, first)
    return [number for row in (*after, change) for number in (row.x, row.y, row.z)]


def _momentum(rows: Sequence[Vector], gyration: Sequence[Vector], turning: Vector) -> Vector:
    """R G Rᵀ ω, from the rows of R."""
    local = turning.x * rows[0] + turning.y * rows[1] + turning.z * rows[2]
    own = Vector(*(dot(row, local) for row in gyration))
    return Vector(*(dot(row, own) for row in rows))


SPIN = Function("spin", 15, 10, _spin)
