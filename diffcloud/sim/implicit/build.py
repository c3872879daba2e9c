"""Builds the constant scene data for the kernels."""

from __future__ import annotations

import numpy as np

from diffcloud.sim.contact.half_spaces import half_spaces
from diffcloud.sim.contact.places import Planes
from diffcloud.sim.contact.rest import CREASE, NEAR_PART
from diffcloud.sim.contact.surface import contact_surface
from diffcloud.sim.implicit.scene import Rigid, Scene
from diffcloud.sim.implicit.terms import kernels
from diffcloud.sim.terms import TERMS
from diffcloud.sim.terms.elements import elements
from diffcloud.sim.terms.term import Setup


def build_scene(setup: Setup, time_step: float) -> Scene:
    """Build the data that are constant in a simulation with steps of `time_step` [s]."""
    surrounding, mesh, bodies = setup.surrounding, setup.mesh, setup.bodies
    fixed = [o for o in surrounding.obstacles if o.plane() is None] + [o.mesh for o in surrounding.moving]
    meshes = [*fixed, *(body.mesh for body in surrounding.bodies)]
    surface = contact_surface(
        mesh,
        meshes,
        movable=[False] * len(fixed) + [True] * len(bodies),
        touches_itself=surrounding.self_contact,
        near_at_rest_below=CREASE * surrounding.contact.repulsion_thickness,
    )
    nodes, others = len(mesh.nodes), sum(len(obstacle.nodes) for obstacle in fixed)
    normals, offsets = half_spaces(mesh, surrounding)
    meets = (surface.points < nodes) | (surface.points >= nodes + others)
    if not len(offsets):
        meets[:] = False
    settings = surrounding.contact
    thicknesses = (settings.repulsion_thickness, min(settings.repulsion_thickness, NEAR_PART * mesh.smallest_height))
    terms, of = elements(setup, TERMS, kernels, len(bodies))
    return Scene(
        terms=terms,
        pattern=of,
        time_step=float(time_step),
        second_order=setup.order == 2 and len(bodies.start) == 0,
        gravity=np.array(surrounding.gravity, dtype=np.float64),
        surface=surface,
        planes=Planes(
            np.ascontiguousarray(normals), np.ascontiguousarray(offsets), surface.points[meets], surface.point_area[meets]
        ),
        law=np.array(
            [[settings.stiffness, thickness, settings.sticking_speed] for thickness in thicknesses], dtype=np.float64
        ),
        moves=surface.movable[surface.owner],
        rigid=Rigid(bodies.points, bodies.body, bodies.gyration.reshape(-1, 9)),
        obstacle_points=others,
    )
