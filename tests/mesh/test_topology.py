"""Cloth topology: edges, hinges, lumped areas, and refused meshes."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.errors import MeshError
from diffcloud.mesh import ClothMesh, SurfaceMesh, grid_cloth


def cloth(nodes, faces, verts=None, vert_node=None):
    nodes = np.asarray(nodes, dtype=float)
    verts = nodes[:, :2] if verts is None else np.asarray(verts, dtype=float)
    vert_node = np.arange(len(verts)) if vert_node is None else np.asarray(vert_node)
    return ClothMesh(nodes, verts, vert_node, np.asarray(faces))


SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]


@pytest.mark.parametrize("through", [0, 1])
@pytest.mark.parametrize(("rows", "columns"), [(2, 2), (3, 5), (7, 7)])
def test_grid_obeys_euler_and_keeps_its_area(rows, columns, through):
    mesh = grid_cloth(rows, columns, 0.6, 0.4, through=through)
    edges, faces = mesh.edges
    assert len(mesh.nodes) - len(edges) + len(mesh.faces) == 1  # a disc
    assert mesh.face_area.sum() == pytest.approx(0.24)
    assert mesh.node_area.sum() == pytest.approx(0.24)
    assert len(mesh.hinges.length) == (faces >= 0).all(axis=1).sum()
    assert (mesh.face_area > 0).all()


def test_hinge_sides_agree_with_face_winding():
    mesh = grid_cloth(4, 4, 1.0, 1.0)
    hinges = mesh.hinges
    for (n0, n1, opposite0, opposite1), (f0, f1) in zip(hinges.nodes, hinges.faces, strict=True):
        for face, first, second, third in ((f0, n0, n1, opposite0), (f1, n1, n0, opposite1)):
            corners = mesh.faces[face].tolist()
            start = corners.index(first)
            assert [corners[start], corners[(start + 1) % 3], corners[(start + 2) % 3]] == [first, second, third]


def test_two_faces_that_traverse_an_edge_alike_leave_it_a_boundary():
    """ARCSim's rule: the later face takes the slot. The published band mesh relies on it."""
    mesh = cloth(
        [[0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, -1, 0]],
        [[0, 1, 2], [3, 4, 5]],
        verts=[[0, 0], [1, 0], [0.5, 1], [0, 2], [1, 2], [0.5, 3]],
        vert_node=[0, 1, 2, 0, 1, 3],
    )
    edges, faces = mesh.edges
    shared = int(np.flatnonzero((edges == [0, 1]).all(axis=1))[0])
    assert faces[shared].tolist() == [1, -1]
    assert len(mesh.hinges.length) == 0


def test_seam_uses_the_mean_material_length_of_both_sides():
    mesh = cloth(
        SQUARE,
        [[0, 1, 2], [3, 4, 5]],
        verts=[[0, 0], [1, 0], [1, 1], [5, 5], [5, 7], [3, 7]],
        vert_node=[0, 1, 2, 0, 2, 3],
    )
    assert mesh.hinges.length == pytest.approx([(np.sqrt(2) + 2) / 2])


@pytest.mark.parametrize(
    ("nodes", "faces", "message"),
    [
        (SQUARE, [[0, 1, 1]], "uses a node twice"),
        ([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], "no area in material space"),
        (SQUARE, [[0, 2, 1]], "turned over"),
        (SQUARE, [[0, 1, 9]], "index 9 of 4"),
        (SQUARE, [[0, 1, 2], [0, -2, 3]], "A face refers to index -2 of 4"),
        ([[0, 0, np.nan], [1, 0, 0], [1, 1, 0]], [[0, 1, 2]], "NaN"),
        (SQUARE, np.zeros((0, 3), dtype=int), "no faces"),
    ],
)
def test_bad_meshes_are_refused_with_the_place(nodes, faces, message):
    with pytest.raises(MeshError, match=message):
        cloth(nodes, faces)


def test_an_edge_of_three_faces_is_refused():
    nodes = [[0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, 1, 1], [0.5, 1, 2]]
    with pytest.raises(MeshError, match="nodes 0 and 1 belongs to 3 faces"):
        cloth(nodes, [[0, 1, 2], [0, 1, 3], [0, 1, 4]])


def test_plane_is_found_and_a_box_has_none():
    tilted = SurfaceMesh(np.array([[0, 0, 0], [1, 0, 1], [1, 1, 1], [0, 1, 0]], float), np.array([[0, 1, 2], [0, 2, 3]]))
    normal, offset = tilted.plane()
    assert normal == pytest.approx([-np.sqrt(0.5), 0, np.sqrt(0.5)])
    assert offset == pytest.approx(0.0)
    bent = SurfaceMesh(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0.1], [0, 1, 0]], float), np.array([[0, 1, 2], [0, 2, 3]]))
    assert bent.plane() is None


def test_grid_sizes_are_checked():
    with pytest.raises(MeshError, match="2 x 2"):
        grid_cloth(1, 4, 1, 1)
    with pytest.raises(MeshError, match="positive size"):
        grid_cloth(3, 3, 0, 1)
