"""Cloths of any shape: what a pad holds, how layers lie, and that a scene begins at rest."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.errors import MeshError, SceneError
from diffcloud.io.obj import write_surface
from diffcloud.mesh.shapes import grid_cloth, loop_cloth
from diffcloud.mesh.simplified import cloth_of
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.scene.scenarios.catalogue import make_scenario, own_options
from diffcloud.scene.scenarios.surface import layers, level_frame, read_mesh, under_pad
from diffcloud.sim.simulate import rollout

GRID = grid_cloth(9, 11, 0.32, 0.40)
SHEET = SurfaceMesh(GRID.nodes, GRID.faces)
STANDING = loop_cloth(6, 20, 0.2, 0.5, 0.001)
TUBE = SurfaceMesh(STANDING.nodes[:, [1, 2, 0]], STANDING.faces)
"""A flat tube of two layers, in the plane z = 0."""
MATERIAL = {"density_kg_m2": 0.2, "stretching_n_m": 60.0, "bending_n_m": 5e-6}


def scenario(folder, surface, point, **fields):
    write_surface(folder / "cloth.obj", surface)
    told = {"base": "mesh", "mesh": "cloth.obj", "material": MATERIAL, "steps_per_frame": 16, **fields}
    told.setdefault("grippers", {"gripper": {"on_mesh_m": point}})
    return make_scenario(own_options(told, "cloth", "test", folder=folder))


@pytest.mark.parametrize("point", [(0.2, 0.16, 0), (0.2, 0.01, 0), (0.03, -0.02, 0)], ids=["corner", "edge", "inside"])
@pytest.mark.parametrize("size", [0.02, 0.03, 0.05])
def test_a_pad_holds_its_area_near_its_point(point, size):
    adapted, held = under_pad(SHEET, np.array(point), size)
    mesh = cloth_of(adapted)
    faces = np.isin(mesh.faces, held).all(axis=1)
    assert mesh.face_area[faces].sum() == pytest.approx(size**2, rel=0.25)
    middle = adapted.nodes[adapted.faces[faces]].mean(axis=(0, 1))
    assert np.linalg.norm(middle - point) < 1.5 * size
    assert mesh.face_area.sum() == pytest.approx(0.32 * 0.40)


def test_a_pad_holds_both_layers():
    _, held = under_pad(TUBE, np.array([0.02, 0.01, 0.0]), 0.02)
    assert set(np.sign(TUBE.nodes[held, 2])) == {-1, 1}


def test_layers_are_counted_where_they_lie_on_another():
    found = layers(TUBE.nodes, TUBE.faces)
    inner = np.abs(TUBE.nodes[:, 2]) > 0.9e-3
    assert (found[inner & (TUBE.nodes[:, 2] > 0)] == 1).all()
    assert (found[TUBE.nodes[:, 2] <= 0] == 0).all()
    assert not layers(SHEET.nodes, SHEET.faces).any()


def test_a_mesh_in_the_table_plane_is_not_rotated():
    rotation, centre = level_frame(SHEET.nodes, SHEET.faces)
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(centre, 0, atol=1e-12)


@pytest.mark.parametrize("surface", [SHEET, TUBE], ids=["one layer", "two layers"])
def test_a_flat_cloth_begins_at_rest(tmp_path, surface):
    still = [[0, 0, 0, 0], [1, 0, 0, 0]]
    one = scenario(tmp_path, surface, (0.1, 0.05, 0), path=still, table_height_m=0.03, yaw_deg=30, frames=5)
    motion = rollout(one.scene.build()[0], one.steps).positions[0]
    assert float((motion[-1] - motion[0]).norm(dim=-1).max()) < 1.5e-3


def test_a_hanging_cloth_begins_at_rest(tmp_path):
    hold = {"gripper": {"on_mesh_m": [0.2, 0.16, 0], "at_m": [0.1, 0.2, 0.9]}}
    still = [[0, 0, 0, 0], [1, 0, 0, 0]]
    one = scenario(
        tmp_path, SHEET, None, grippers=hold, start="hang", grip="pivot", path=still, frames=5, self_contact=False
    )
    motion = rollout(one.scene.build()[0], one.steps).positions[0]
    assert float((motion[-1] - motion[0]).norm(dim=-1).max()) < 1e-3
    assert motion[0, :, 2].max() == pytest.approx(0.9, abs=0.01)
    assert motion[0, :, 2].min() < 0.9 - 0.4


def test_another_grasp_size_holds_the_same_nodes(tmp_path):
    one = scenario(tmp_path, SHEET, (0.2, 0.16, 0), grip_known_within=1.5)
    smaller = one.regrip(-1.0)
    assert smaller.scene.handles.nodes == one.scene.handles.nodes
    assert smaller.scene.handles.grasp.size == pytest.approx(0.02 / 1.5)


def test_what_cannot_be_a_cloth_is_refused(tmp_path):
    apart = SurfaceMesh(
        np.concatenate([SHEET.nodes, SHEET.nodes + np.array([1, 0, 0])]),
        np.concatenate([SHEET.faces, SHEET.faces + len(SHEET.nodes)]),
    )
    write_surface(tmp_path / "apart.obj", apart)
    with pytest.raises(MeshError, match="2 separate parts"):
        read_mesh(tmp_path / "apart.obj", 300)
    write_surface(tmp_path / "mm.obj", SurfaceMesh(1e3 * SHEET.nodes, SHEET.faces))
    with pytest.raises(MeshError, match=r"400 across\. Meshes are in metres"):
        read_mesh(tmp_path / "mm.obj", 300)
    with pytest.raises(SceneError, match="mm thick; at most 50 mm"):
        scenario(tmp_path, SurfaceMesh(STANDING.nodes * [60, 1, 1], STANDING.faces), (0, 0, 0))
    with pytest.raises(SceneError, match="no gripper holds the cloth"):
        scenario(tmp_path, SHEET, None, grippers={})
