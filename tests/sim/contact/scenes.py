"""Small scenes with meshes to touch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from diffcloud.mesh import ClothMesh, SurfaceMesh, grid_cloth
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.contact.surface import Surface, contact_surface
from diffcloud.sim.surrounding import ReferenceContact
from tests.conftest import small_lift


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> SurfaceMesh:
    """A box with outward faces."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return SurfaceMesh(np.array(low) + corners * (np.array(high) - np.array(low)), np.array(faces))


def together(*cloths: ClothMesh) -> ClothMesh:
    """Several cloths as one mesh, whose numbers follow each other."""
    begin = np.cumsum([0, *(len(cloth.nodes) for cloth in cloths)])
    return ClothMesh(
        np.concatenate([cloth.nodes for cloth in cloths]),
        np.concatenate([cloth.verts + 10.0 * index for index, cloth in enumerate(cloths)]),
        np.arange(begin[-1]),
        np.concatenate([cloth.face_verts + first for cloth, first in zip(cloths, begin[:-1], strict=True)]),
    )


def over_box(contact: ReferenceContact, *, proximity: bool = True, height: float = 0.012, **changes: object) -> Scenario:
    """A small cloth, lifted at a corner, that falls over the edges and corners of a box without lying on them exactly."""
    scenario = small_lift(
        contact_stiffness=1e6,
        contact_thickness_m=0.005,
        gravity=(0.0, 0.0, -30.0),
        gap_m=height,
        **{"grip": "pad", "grip_m": 0.01, **changes},
    )
    obstacle = box((-0.047, -0.061, -0.2), (0.053, 0.043, 0.0))
    surrounding = replace(scenario.scene.surrounding, obstacles=(obstacle,), reference_contact=contact, proximity=proximity)
    return replace(scenario, scene=replace(scenario.scene, surrounding=surrounding))


def crumpled(rng: np.random.Generator) -> tuple[Surface, np.ndarray]:
    """A crumpled cloth partly in the shell of two boxes that nearly touch: the surface and its points [N, 3]."""
    cloth = grid_cloth(5, 5, 0.3, 0.3)
    obstacles = [box((-0.1, -0.1, -0.2), (0.08, 0.11, 0.0)), box((-0.4, -0.4, -0.6), (0.4, 0.4, -0.211))]
    points = np.concatenate([cloth.nodes, *(mesh.nodes for mesh in obstacles)])
    points[:25] += rng.normal(size=(25, 3)) * [0.05, 0.05, 0.02]
    return contact_surface(cloth, obstacles, all_edges=True), points
