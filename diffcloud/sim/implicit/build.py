"""The kernels' scene from a cloth and its surrounding."""

from __future__ import annotations

from typing import Any

import numpy as np

from diffcloud.sim.compiled.sparse import Pattern, pattern, slots
from diffcloud.sim.contact.places import Planes
from diffcloud.sim.contact.surface import contact_surface
from diffcloud.sim.implicit.scene import Rigid, Scene
from diffcloud.sim.rigid.bodies import Bodies
from diffcloud.sim.terms import TERMS, kernels
from diffcloud.sim.terms.planes import half_spaces
from diffcloud.sim.terms.term import Setup


def build_scene(setup: Setup, time_step: float) -> Scene:
    """Everything constant in a run with steps so long [s]."""
    surrounding, mesh = setup.surrounding, setup.mesh
    bodies = Bodies.build(surrounding.bodies)
    fixed = [o for o in surrounding.obstacles if o.plane() is None] + [o.mesh for o in surrounding.moving]
    meshes = [*fixed, *(body.mesh for body in surrounding.bodies)]
    surface = contact_surface(
        mesh,
        meshes,
        movable=[False] * len(fixed) + [True] * len(bodies),
        touches_itself=surrounding.self_contact,
    )
    nodes, others = len(mesh.nodes), sum(len(obstacle.nodes) for obstacle in fixed)
    normals, offsets = half_spaces(mesh, surrounding)
    meets = (surface.points < nodes) | (surface.points >= nodes + others)
    if not len(offsets):
        meets[:] = False
    settings = surrounding.contact
    terms, of = _elements(setup, len(bodies))
    return Scene(
        terms=terms,
        pattern=of,
        time_step=float(time_step),
        gravity=np.array(surrounding.gravity, dtype=np.float64),
        surface=surface,
        planes=Planes(
            np.ascontiguousarray(normals), np.ascontiguousarray(offsets), surface.points[meets], surface.point_area[meets]
        ),
        law=np.array([[settings.stiffness, settings.repulsion_thickness, settings.sticking_speed]], dtype=np.float64),
        moves=surface.movable[surface.owner],
        rigid=Rigid(bodies.points, bodies.body, bodies.gyration.reshape(-1, 9)),
        obstacle_points=others,
    )


def _elements(setup: Setup, bodies: int) -> tuple[Any, Pattern]:
    """(`kernels.Terms`, the pattern of the matrix: cloth nodes, then the centre and the rotation of each body)."""
    found = [term.build(setup) for term in TERMS]
    nodes = [
        np.zeros((0, term.corners), np.int64) if one is None else np.ascontiguousarray(one.nodes, dtype=np.int64)
        for term, one in zip(TERMS, found, strict=True)
    ]
    count = len(setup.mesh.nodes)
    own = count + np.arange(2 * bodies, dtype=np.int64).reshape(-1, 2)
    of = pattern(count + 2 * bodies, [*nodes, own])
    parts = []
    for term, one, group in zip(TERMS, found, nodes, strict=True):
        numbers = [
            np.zeros((0, *shape)) if one is None else np.ascontiguousarray(one.constants[name], dtype=np.float64)
            for name, shape in term.constants.items()
        ]
        numbers += [
            np.zeros((0,) * axes) if one is None else np.ascontiguousarray(one.tables[name], dtype=np.float64)
            for name, axes in term.tables.items()
        ]
        parts.append(getattr(kernels, term.class_name)(group, slots(of, group), *numbers))
    return kernels.Terms(*parts), of
