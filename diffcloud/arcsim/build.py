"""Builds the constant scene data for the kernels."""

from __future__ import annotations

import numpy as np

from diffcloud.arcsim.contact.impact_zones import Projection
from diffcloud.arcsim.contact.nearest import Repulsion, held_slots
from diffcloud.arcsim.contact.planes import stopping_planes
from diffcloud.arcsim.scene import Scene
from diffcloud.arcsim.terms import TERMS, kernels
from diffcloud.sim.contact.surface import contact_surface
from diffcloud.sim.surrounding import ReferenceContact
from diffcloud.sim.terms.elements import elements
from diffcloud.sim.terms.term import Setup


def build_scene(setup: Setup, time_step: float) -> Scene:
    """Build the data that are constant in a simulation with steps of `time_step` [s]."""
    surrounding, mesh = setup.surrounding, setup.mesh
    choices = surrounding.reference_contact
    numbers = surrounding.contact
    terms, of = elements(setup, TERMS, kernels)
    obstacles = surrounding.obstacles if choices is not None else ()
    surface = contact_surface(mesh, obstacles, all_edges=True)
    points = np.concatenate([o.nodes for o in obstacles] + [np.zeros((0, 3))])
    given = choices or ReferenceContact()
    repulsion = Repulsion(numbers.stiffness, numbers.repulsion_thickness, given.smallest, given.count_once, np.zeros(0))
    if choices is not None:
        held = held_slots(surface, repulsion, np.concatenate([mesh.nodes, points]))
        repulsion = repulsion._replace(held=held)
    normals, offsets = stopping_planes(mesh, surrounding)
    return Scene(
        terms,
        of,
        time_step,
        points,
        normals,
        offsets,
        surface,
        choices is not None and surrounding.proximity,
        choices is not None,
        repulsion,
        Projection(numbers.projection_thickness, given.smallest, given.residue),
    )
