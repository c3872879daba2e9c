"""A finer mesh is the same cloth."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.mesh import ClothMesh, grid_cloth, loop_cloth, vest_cloth
from diffcloud.mesh.refinement import refined

MESHES = {
    "sheet": grid_cloth(3, 4, 0.2, 0.3),
    "loop with a seam": loop_cloth(2, 8, 0.1, 0.8),
    "vest with seams": vest_cloth(0.4, 0.47, 0.063),
}


@pytest.mark.parametrize("name", MESHES)
def test_area_places_and_seams_are_kept(name: str) -> None:
    mesh = MESHES[name]
    finer, edges = refined(mesh)
    count = len(mesh.nodes)
    assert len(finer.faces) == 4 * len(mesh.faces)
    np.testing.assert_array_equal(finer.nodes[:count], mesh.nodes)
    np.testing.assert_allclose(finer.nodes[count:], mesh.nodes[edges].mean(axis=1))
    np.testing.assert_allclose(finer.face_area.reshape(-1, 4), np.repeat(mesh.face_area[:, None] / 4, 4, 1), rtol=1e-12)
    # an inner edge becomes two, and each face has three within; a seam stays one edge in the world
    assert len(finer.hinges.nodes) == 2 * len(mesh.hinges.nodes) + 3 * len(mesh.faces)
    assert len(edges) == len(mesh.edges[0])
    assert len(finer.vert_node) == len(finer.verts)


def test_stretch_is_that_of_the_coarse_face() -> None:
    """Each small face maps from material space to the world as the one it is cut from."""
    mesh = MESHES["vest with seams"]
    finer, _ = refined(mesh)

    def gradient(of: ClothMesh) -> np.ndarray:
        corner = of.nodes[of.faces]
        sides = np.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=-1)
        return sides @ np.linalg.inv(of.material_edges)

    np.testing.assert_allclose(gradient(finer), np.repeat(gradient(mesh), 4, axis=0), atol=1e-9)
