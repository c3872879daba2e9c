"""Positive semidefinite contact stiffness for cautious Newton steps, with contact points and normals held constant."""

from __future__ import annotations

from math import log, sqrt

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats, Ints
from diffcloud.sim.contact.distance import closest, on_segment
from diffcloud.sim.contact.places import EDGE_EDGE, PLANE, POINT_EDGE, POINT_POINT, Planes, corners

_PARALLEL = 1e-3
"""Same as in `barrier`."""
_TINY = 1e-30


@kernel
def resistance(
    planes: Planes,
    law: Floats,
    friction: tuple[float, float],
    points: Floats,
    velocities: Floats,
    listed: Ints,
    numbers: Floats,
    e: int,
    x: Floats,
    found: Floats,
    local: Floats,
) -> bool:
    """Compute the stiffness w_a w_b S of contact e. Return False if it is zero.

    Args:
        friction: coefficients of the cloth with obstacles and with itself.
        points, velocities: [N, 3] [m], [m/s].
        listed, numbers: results of `places`.
        x: [4, 3] scratch space.
        found: [6] receives the weights w.
        local: [18] receives S of the barrier [N/m], then S of friction [N·s/m].
    """
    kind, count = listed[e, 0], corners(listed, e)
    share = numbers[e, 0] if kind == EDGE_EDGE else numbers[e, 2]  # negative shares are ignored
    if not share > 0:
        return False
    for k in range(count):
        for axis in range(3):
            x[k, axis] = points[listed[e, 1 + k], axis]
    found[0], found[1], found[2], found[3] = 1.0, 0.0, 0.0, 0.0
    if kind == POINT_POINT:
        found[1] = -1.0
    elif kind == POINT_EDGE:
        _, fraction, _ = on_segment(x, 0, 1, 2)
        found[1], found[2] = fraction - 1, -fraction
    elif kind != PLANE:
        closest(1 if kind == EDGE_EDGE else 0, x, found)
    if kind == EDGE_EDGE:
        share *= _faded(x)
    n0 = n1 = n2 = v0 = v1 = v2 = 0.0
    for k in range(count):
        w, i = found[k], listed[e, 1 + k]
        n0, n1, n2 = n0 + w * x[k, 0], n1 + w * x[k, 1], n2 + w * x[k, 2]
        v0, v1, v2 = v0 + w * velocities[i, 0], v1 + w * velocities[i, 1], v2 + w * velocities[i, 2]
    if kind == PLANE:
        normal = planes.normals[listed[e, 2]]
        distance = n0 * normal[0] + n1 * normal[1] + n2 * normal[2] - planes.offsets[listed[e, 2]]
        n0, n1, n2 = normal[0], normal[1], normal[2]
    else:
        distance = sqrt(max(n0 * n0 + n1 * n1 + n2 * n2, _TINY))
        n0, n1, n2 = n0 / distance, n1 / distance, n2 / distance
    row = 1 if kind != PLANE and numbers[e, 1] < 0 else 0
    thickness = law[row, 1]
    ratio = distance / thickness
    if not ratio < 1:
        return False
    along = n0 * v0 + n1 * v1 + n2 * v2
    v0, v1, v2 = v0 - along * n0, v1 - along * n1, v2 - along * n2
    speed = sqrt(max(v0 * v0 + v1 * v1 + v2 * v2, _TINY))
    sticking, part = law[0, 2], (ratio - 1) / ratio
    per_speed = (2 - speed / sticking) / sticking if speed < sticking else 1 / speed
    pressure = law[0, 0] / 6 * thickness * (2 * (ratio - 1) * log(ratio) + (ratio - 1) * part)
    stiffness = share * law[0, 0] / 6 * (part * part - 2 * log(ratio) - 4 * part)
    rubbing = share * pressure * (friction[0] if numbers[e, 1] > 0 else friction[1]) * per_speed
    normal3 = (n0, n1, n2)
    for r in range(3):
        for c in range(3):
            both = normal3[r] * normal3[c]
            local[3 * r + c] = stiffness * both
            local[9 + 3 * r + c] = rubbing * ((1.0 if r == c else 0.0) - both)
    return True


@kernel
def _faded(x: Floats) -> float:
    """Factor by which the force of two almost parallel edges x [4, 3] fades."""
    u0, u1, u2 = x[1, 0] - x[0, 0], x[1, 1] - x[0, 1], x[1, 2] - x[0, 2]
    v0, v1, v2 = x[3, 0] - x[2, 0], x[3, 1] - x[2, 1], x[3, 2] - x[2, 2]
    a, b, c = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    sides = (u0 * u0 + u1 * u1 + u2 * u2) * (v0 * v0 + v1 * v1 + v2 * v2)
    ratio = (a * a + b * b + c * c) / (_PARALLEL * sides)
    return ratio * (2 - ratio) if ratio < 1 else 1.0
