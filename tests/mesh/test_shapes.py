"""Procedural shapes: topology, orientation, seams, and rest shapes that fit their world shapes."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.errors import MeshError
from diffcloud.mesh import (
    ClothMesh,
    SurfaceMesh,
    box_surface,
    cylinder_surface,
    loop_cloth,
    rectangle_surface,
    sphere_surface,
    vest_cloth,
    vest_shoulder,
)

LOOPS = [(2, 3), (3, 28), (4, 40)]
VEST = {"width": 0.22, "height": 0.26, "depth": 0.035}


def boundary_loops(mesh: ClothMesh) -> int:
    """Number of closed curves that the boundary edges form."""
    edges, faces = mesh.edges
    boundary = edges[(faces < 0).any(axis=1)]
    group = np.arange(len(mesh.nodes))
    for a, b in boundary:
        group[group == group[a]] = group[b]
    assert (np.bincount(boundary.ravel())[np.unique(boundary)] == 2).all()  # the boundary is a manifold
    return len(np.unique(group[np.unique(boundary)]))


def euler_characteristic(mesh: ClothMesh) -> int:
    return len(mesh.nodes) - len(mesh.edges[0]) + len(mesh.faces)


def stretches(mesh: ClothMesh) -> np.ndarray:
    """[F, 2] singular values of each face's deformation from material space to the world."""
    corner = mesh.nodes[mesh.faces]
    world = np.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=-1)
    return np.linalg.svd(world @ np.linalg.inv(mesh.material_edges), compute_uv=False)


def normals(mesh: ClothMesh | SurfaceMesh) -> np.ndarray:
    corner = mesh.nodes[mesh.faces]
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


@pytest.mark.parametrize(("rows", "columns"), LOOPS)
def test_a_loop_is_an_annulus_that_looks_outwards(rows, columns):
    mesh = loop_cloth(rows, columns, 0.04, 0.9)
    assert len(mesh.nodes) == rows * columns
    assert euler_characteristic(mesh) == 0
    assert boundary_loops(mesh) == 2
    assert mesh.face_area.sum() == pytest.approx(0.04 * 0.9)
    outward = mesh.nodes[mesh.faces].mean(axis=1) * [1, 1, 0]
    assert ((normals(mesh) * outward).sum(axis=1) > 0).all()
    edges, faces = mesh.edges
    assert (faces >= 0).all(axis=1).sum() == len(edges) - 2 * columns  # no edge traversed twice the same way


@pytest.mark.parametrize(("rows", "columns"), LOOPS)
def test_a_loop_is_nearly_at_rest_and_its_seam_nodes_own_two_verts(rows, columns):
    mesh = loop_cloth(rows, columns, 0.04, 0.9)
    # chords of a circle whose arcs are the material's length
    chord = np.sin(np.pi / columns) / (np.pi / columns)
    assert stretches(mesh).max() == pytest.approx(1.0)
    assert stretches(mesh).min() == pytest.approx(chord)
    owned = np.bincount(mesh.vert_node)
    assert np.flatnonzero(owned == 2).tolist() == [row * columns for row in range(rows)]
    assert set(owned) == {1, 2}


def test_a_loop_with_ends_is_a_stadium():
    mesh = loop_cloth(2, 60, 0.04, 1.2, 0.06)
    assert np.ptp(mesh.nodes[:, 0]) == pytest.approx(0.12, rel=2e-2)
    straight = (1.2 - 2 * np.pi * 0.06) / 2
    assert np.ptp(mesh.nodes[:, 1]) == pytest.approx(straight + 0.12, rel=1e-2)
    assert mesh.nodes[0] == pytest.approx([0, -straight / 2 - 0.06, -0.02])
    assert stretches(mesh).min() > 0.98
    with pytest.raises(MeshError, match="end radii up to"):
        loop_cloth(2, 60, 0.04, 1.2, 0.3)


def test_a_vest_has_four_openings_and_two_panels():
    mesh = vest_cloth(**VEST)
    assert len(mesh.nodes) == 80
    assert euler_characteristic(mesh) == 2 - 4  # a sphere with the openings waist, neck and two arms
    assert boundary_loops(mesh) == 4
    half = len(mesh.verts) // 2
    front, back = (np.flatnonzero((mesh.face_verts < half).all(axis=1) == first) for first in (True, False))
    assert len(front) == len(back) == len(mesh.faces) / 2
    assert (mesh.face_verts[back] >= half).all()  # patches of their own
    assert mesh.verts[:half, 0].max() < mesh.verts[half:, 0].min()
    assert (normals(mesh)[front][:, 1] < 0).all()
    assert (normals(mesh)[back][:, 1] > 0).all()
    assert (mesh.face_area > 0).all()


def test_the_vests_seams_are_its_sides_and_shoulders():
    mesh = vest_cloth(**VEST)
    seam = np.flatnonzero(np.bincount(mesh.vert_node) == 2)
    assert len(seam) == 8 + 6
    assert set(vest_shoulder(1)) | set(vest_shoulder(-1)) <= set(seam.tolist())
    assert mesh.nodes[seam][:, 1] == pytest.approx(np.zeros(14))  # in the plane between the panels
    sides = np.setdiff1d(seam, [*vest_shoulder(1), *vest_shoulder(-1)])
    assert np.ptp(np.abs(mesh.nodes[sides, 0])) < 1e-9
    for side in (1, -1):
        x = side * mesh.nodes[vest_shoulder(side), 0]
        assert (np.diff(x) > 0).all()
        assert x[0] > 0
        assert mesh.nodes[vest_shoulder(side), 2].min() > 0.9 * mesh.nodes[:, 2].max()


def test_a_vest_starts_nearly_at_rest():
    stretch = stretches(vest_cloth(**VEST))
    assert stretch.min() > 0.85
    assert stretch.max() < 1.15
    mesh = vest_cloth(**VEST)
    edges, _ = mesh.edges
    length = np.linalg.norm(np.diff(mesh.nodes[edges], axis=1)[:, 0], axis=-1)
    assert length.max() / length.min() < 4


def closed_surfaces() -> dict[str, tuple[SurfaceMesh, float, float]]:
    """Name -> (mesh, area, volume) of what it stands for."""
    prism_area = 12 / 2 * 0.1**2 * np.sin(2 * np.pi / 12)
    side = 2 * 0.1 * np.sin(np.pi / 12)
    return {
        "box": (box_surface([-1, 0, 2], [1, 3, 3]), 2 * (6 + 2 + 3), 6.0),
        "cylinder": (
            cylinder_surface([1, 2, 3], [1.3, 2, 2.6], 0.1, 12),
            2 * prism_area + 12 * side * 0.5,
            prism_area * 0.5,
        ),
        "sphere": (sphere_surface([0, 1, 0], 0.5, 4), np.pi, np.pi / 6),
    }


@pytest.mark.parametrize("name", ["box", "cylinder", "sphere"])
def test_obstacles_are_closed_and_look_outwards(name):
    mesh, area, volume = closed_surfaces()[name]
    half = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(np.unique(half, axis=0)) == len(half)
    assert {tuple(edge) for edge in half} == {tuple(edge[::-1]) for edge in half}  # every edge both ways
    assert len(mesh.nodes) - len(half) // 2 + len(mesh.faces) == 2
    corner = mesh.nodes[mesh.faces]
    assert np.linalg.det(corner - mesh.nodes.mean(axis=0)).sum() / 6 == pytest.approx(volume, rel=0.01)
    assert np.linalg.norm(normals(mesh), axis=1).sum() / 2 == pytest.approx(area, rel=0.01)
    assert mesh.plane() is None


def test_a_sphere_has_its_radius_and_even_edges():
    mesh = sphere_surface([1, 2, 3], 0.2, 2)
    assert len(mesh.faces) == 320
    assert np.linalg.norm(mesh.nodes - [1, 2, 3], axis=1) == pytest.approx(np.full(162, 0.2))
    length = np.linalg.norm(mesh.nodes[mesh.faces] - np.roll(mesh.nodes[mesh.faces], 1, axis=1), axis=-1)
    assert length.max() / length.min() < 1.3


def test_a_rectangle_is_a_plane_that_looks_up():
    normal, offset = rectangle_surface([1, 2], [0.5, 0.25], 0.3).plane()
    assert normal == pytest.approx([0, 0, 1])
    assert offset == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: loop_cloth(1, 9, 0.1, 1), "2 nodes across"),
        (lambda: loop_cloth(2, 2, 0.1, 1), "3 along"),
        (lambda: loop_cloth(2, 9, 0, 1), "positive width"),
        (lambda: vest_cloth(0.2, -1, 0.03), "positive width, height and depth"),
        (lambda: vest_cloth(0.2, 0.2, 0.1), "round at a depth of 0.06366 m"),
        (lambda: box_surface([0, 0, 0], [1, 0, 1]), "lower corner below"),
        (lambda: cylinder_surface([0, 0, 0], [0, 0, 0], 0.1), "a length"),
        (lambda: cylinder_surface([0, 0, 0], [0, 0, 1], 0.1, 2), "3 sides"),
        (lambda: sphere_surface([0, 0, 0], 0.0), "a radius"),
    ],
)
def test_impossible_sizes_are_refused(make, message):
    with pytest.raises(MeshError, match=message):
        make()
