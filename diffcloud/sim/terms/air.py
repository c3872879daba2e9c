"""Air drag and wind on each face.

    f = ρ_air a |u_n| v_n N + drag a v_t + linear a v,   v = v_wind - mean corner velocity

with a the material-space area; a third of f acts on each corner. The speed u_n of the pressure is that before the step, the
velocities it multiplies are those after it: drag then damps however light the cloth and however long the step. ARCSim takes
all of it before the step (`lagged_air`), where a light cloth in dense air is thrown back harder than it came, and explodes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffcloud.sim.compiled.trace import Vector, absolute, cross, dot, norm, total, where
from diffcloud.sim.terms.term import Element, Elements, Setup, Term


def force(face: Element) -> Sequence[Vector]:
    """A third of f on each corner."""
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
    """All faces."""
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
"""Constants: area in material space [m²]; velocity of the air [m/s]; 1 where velocities before the step count."""
