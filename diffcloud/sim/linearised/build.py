"""The kernels' scene from a cloth and its surrounding."""

from __future__ import annotations

from typing import Any

import numpy as np

from diffcloud.sim.compiled.sparse import Pattern, pattern, slots
from diffcloud.sim.contact.surface import contact_surface
from diffcloud.sim.linearised.scene import Scene
from diffcloud.sim.reference.impact_zones import Projection
from diffcloud.sim.reference.nearest import Repulsion, held_slots
from diffcloud.sim.surrounding import ReferenceContact
from diffcloud.sim.terms import TERMS, kernels
from diffcloud.sim.terms.planes import half_spaces
from diffcloud.sim.terms.term import Setup


def elements(setup: Setup) -> tuple[Any, Pattern]:
    """(`kernels.Terms`, the pattern of the step matrix)."""
    found = [term.build(setup) for term in TERMS]
    nodes = [
        np.zeros((0, term.corners), np.int64) if one is None else np.ascontiguousarray(one.nodes, dtype=np.int64)
        for term, one in zip(TERMS, found, strict=True)
    ]
    of = pattern(len(setup.mesh.nodes), nodes)
    parts = []
    for term, one, own in zip(TERMS, found, nodes, strict=True):
        numbers = [
            np.zeros((0, *shape)) if one is None else np.ascontiguousarray(one.constants[name], dtype=np.float64)
            for name, shape in term.constants.items()
        ]
        numbers += [
            np.zeros((0,) * axes) if one is None else np.ascontiguousarray(one.tables[name], dtype=np.float64)
            for name, axes in term.tables.items()
        ]
        parts.append(getattr(kernels, term.class_name)(own, slots(of, own), *numbers))
    return kernels.Terms(*parts), of


def build_scene(setup: Setup, time_step: float) -> Scene:
    surrounding, mesh = setup.surrounding, setup.mesh
    choices = surrounding.reference_contact
    numbers = surrounding.contact
    terms, of = elements(setup)
    obstacles = surrounding.obstacles if choices is not None else ()
    surface = contact_surface(mesh, obstacles, all_edges=True)
    points = np.concatenate([o.nodes for o in obstacles] + [np.zeros((0, 3))])
    given = choices or ReferenceContact()
    repulsion = Repulsion(numbers.stiffness, numbers.repulsion_thickness, given.smallest, given.count_once, np.zeros(0))
    if choices is not None:
        held = held_slots(surface, repulsion, np.concatenate([mesh.nodes, points]))
        repulsion = repulsion._replace(held=held)
    normals, offsets = half_spaces(mesh, surrounding)
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
