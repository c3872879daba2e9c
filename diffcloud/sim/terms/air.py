"""Air drag and wind on each face.

    f = ρ_air a |u_n| v_n N + drag a v_t + linear a v,   v = v_wind - mean corner velocity

a is the area in material space. v_n and v_t are the normal and tangential parts of v, and N is the unit normal. A third of
f acts on each corner. The speed u_n is v_n at the start of the step, but v is taken at its end. So drag damps for any mass
and any step length. With `lagged_air`, v is taken at the start of the step, as in ARCSim. Light cloth in dense air is then
unstable.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffcloud.sim.compiled.trace import Vector, absolute, cross, dot, norm, total, where
from diffcloud.sim.terms.term import Element, Elements, Setup, Term


def force(face: Element) -> Sequence[Vector]:
    """Force on each corner: a third of f [N]."""
    a, b, c = face.positions
    normal = cross(b - a, c - a)
    unit = normal / norm(normal)
    wind = face.vector("wind")
    before, after = (wind - total(field) / 3.0 for field in (face.before, face.after))
    lagged = face.constant("lagged") > 0.0
    relative = Vector(*(where(lagged, before[axis], after[axis]) for axis in range(3)))
    speed = dot(relative, unit)
    drag, linear = face.parameter("air_drag"), face.parameter("linear_drag")
    pressure = (face.parameter("air_density") * absolute(dot(before, unit)) - drag) * speed
    third = face.constant("area") / 3.0
    pushed = third * (pressure * unit + (drag + linear) * relative)
    return [pushed] * 3


def build(setup: Setup) -> Elements:
    """Elements: all faces."""
    mesh, surrounding = setup.mesh, setup.surrounding
    count = len(mesh.faces)
    return Elements(
        mesh.faces,
        {
            "area": mesh.face_area,
            "wind": np.tile(np.array(surrounding.wind, dtype=np.float64), (count, 1)),
            "lagged": np.full(count, float(surrounding.lagged_air)),
        },
    )


TERM = Term(
    "air",
    corners=3,
    force=force,
    build=build,
    constants={"area": (), "wind": (3,), "lagged": ()},
    parameters={"air_density": "episode", "air_drag": "episode", "linear_drag": "episode"},
)
"""Constants: area in material space [m²]; air velocity [m/s]; 1 to use the velocities at the start of the step."""
