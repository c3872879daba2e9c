"""Coarser meshes of a surface: shape, topology and quality are kept."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.mesh.refinement import refined
from diffcloud.mesh.shapes import grid_cloth, loop_cloth, vest_cloth
from diffcloud.mesh.simplified import cloth_of, simplified, topology
from diffcloud.mesh.topology import ClothMesh, SurfaceMesh


def surface(mesh: ClothMesh) -> SurfaceMesh:
    return SurfaceMesh(mesh.nodes, mesh.faces)


def angles(mesh: SurfaceMesh) -> np.ndarray:
    """[F] smallest angles [deg]."""
    corner = mesh.nodes[mesh.faces]
    way = np.roll(corner, -1, axis=1) - corner
    length = np.linalg.norm(way, axis=-1)
    cosine = -(way * np.roll(way, 1, axis=1)).sum(-1) / (length * np.roll(length, 1, axis=1))
    return np.degrees(np.arccos(cosine)).min(axis=1)


@pytest.mark.parametrize(
    "mesh",
    [grid_cloth(30, 40, 0.3, 0.4), loop_cloth(20, 80, 0.4, 0.8), refined(refined(vest_cloth(0.4, 0.47, 0.05))[0])[0]],
    ids=["rectangle", "tube", "vest"],
)
def test_shape_and_topology_stay(mesh):
    fine = surface(mesh)
    coarse = simplified(fine, 150)
    assert len(coarse.nodes) == pytest.approx(150, rel=0.3)
    assert topology(coarse) == topology(fine)
    assert cloth_of(coarse).face_area.sum() == pytest.approx(cloth_of(fine).face_area.sum(), rel=0.02)
    assert np.quantile(angles(coarse), 0.05) > 25
    assert angles(coarse).min() > 15


def test_corners_stay():
    coarse = simplified(surface(grid_cloth(30, 40, 0.3, 0.4)), 100)
    corners = np.array([[x, y, 0.0] for x in (-0.2, 0.2) for y in (-0.15, 0.15)])
    assert np.linalg.norm(coarse.nodes[:, None] - corners, axis=2).min(axis=0) == pytest.approx(0, abs=1e-12)


def test_a_cloth_is_at_rest_in_its_shape():
    vest = surface(vest_cloth(0.4, 0.47, 0.05))
    cloth = cloth_of(vest)
    corner, flat = vest.nodes[vest.faces], cloth.verts[cloth.face_verts]
    for one, other in ((0, 1), (1, 2), (2, 0)):
        rest = np.linalg.norm(flat[:, one] - flat[:, other], axis=1)
        np.testing.assert_allclose(rest, np.linalg.norm(corner[:, one] - corner[:, other], axis=1), rtol=1e-12)
