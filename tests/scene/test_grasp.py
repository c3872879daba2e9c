"""Held places of a grid scenario and of scene files have a physical size, which meshes keep."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.arcsim.load import load_scene
from diffcloud.arcsim.write import write_scene
from diffcloud.errors import SceneError
from diffcloud.mesh import ClothMesh, grid_cloth
from diffcloud.mesh.refinement import refined
from diffcloud.scene.scenarios import Scenario, load_scenario
from diffcloud.scene.scenarios.catalogue import built_in, own_options
from diffcloud.scene.scenarios.grid import GridScenario, grid_scenario
from diffcloud.sim.grasp import Grasp
from diffcloud.sim.simulate import rollout
from tests.arcsim.files import sheets_over_table, write_file, write_files


def lift(**changes: object) -> Scenario:
    options = own_options(changes, "own", "test", folder=None)
    assert isinstance(options, GridScenario)
    return grid_scenario(options)


def held(scenario: Scenario) -> np.ndarray:
    """[N, 2] in material space."""
    return scenario.scene.mesh.verts[scenario.grasped]


def triangles(mesh: ClothMesh) -> set[tuple]:
    """Faces by their corners in material space."""
    return {tuple(sorted(map(tuple, corner))) for corner in mesh.verts[mesh.face_verts].round(9).tolist()}


@pytest.mark.parametrize("nodes", [(4, 5), (7, 7), (13, 10), (49, 37)])
@pytest.mark.parametrize("refinements", [0, 1, 2])
def test_a_pad_is_as_large_on_every_mesh(nodes, refinements):
    scenario = lift(size_m=(0.4, 0.3), nodes=nodes, grip_m=0.02)
    for _ in range(refinements if max(nodes) < 20 else 0):
        scenario = scenario.finer()
    mesh = scenario.scene.mesh
    assert mesh.face_area.sum() == pytest.approx(0.12)
    np.testing.assert_allclose([held(scenario).min(0), held(scenario).max(0)], [[0.38, 0.28], [0.4, 0.3]])
    under = (mesh.verts >= np.array([0.38, 0.28]) - 1e-9).all(1)
    assert sorted(scenario.grasped) == np.flatnonzero(under).tolist()
    assert len({handle.motion for handle in scenario.scene.handles.handles}) == 1
    if refinements == 0:
        assert len(mesh.nodes) == nodes[0] * nodes[1]
        free = np.diff(np.unique(mesh.verts[:, 0].round(9)))[: nodes[0] // 2]
        np.testing.assert_allclose(free, free[0], rtol=1e-6)


@pytest.mark.parametrize("corner", ["left_bottom", "right_bottom", "left_top", "right_top"])
@pytest.mark.parametrize("nodes", [(7, 7), (6, 7), (6, 4)])
def test_diagonals_alternate_and_one_goes_through_the_held_corner(corner, nodes):
    scenario = lift(nodes=nodes, grasped=[corner], grip="pivot")
    mesh = scenario.scene.mesh
    meeting = np.bincount(mesh.faces.ravel())
    assert meeting[scenario.grasped] == 2
    inner = np.ones((nodes[1], nodes[0]), bool)
    inner[[0, -1]] = inner[:, [0, -1]] = False
    counts = meeting.reshape(nodes[::-1])
    assert set(counts[inner]) <= {4, 8}
    beside = inner[:, 1:] & inner[:, :-1]
    assert (counts[:, 1:] != counts[:, :-1])[beside].all()


def test_a_square_cloth_is_its_own_mirror_image():
    mesh = load_scenario("lift").scene.mesh
    assert triangles(mesh) == triangles(
        replace(mesh, verts=mesh.verts[:, ::-1].copy(), face_verts=mesh.face_verts[:, ::-1].copy())
    )


def test_a_finer_grid_is_the_grid_with_half_the_edges():
    finer, _ = refined(grid_cloth(4, 6, 0.3, 0.5, through=7))
    assert triangles(finer) == triangles(grid_cloth(7, 11, 0.3, 0.5))


def test_pads_lie_around_their_places_and_neighbours_are_one():
    square = {"size_m": (0.6, 0.6), "nodes": (7, 7), "grip_m": 0.04, "yaw_deg": 0}
    of = {
        24: ([0.28, 0.28], [0.32, 0.32]),  # in the middle
        3: ([0.28, 0.0], [0.32, 0.04]),  # on the lower edge
        34: ([0.56, 0.38], [0.6, 0.42]),  # on the right one
    }
    for place, ends in of.items():
        found = held(lift(**square, grasped=[place]))
        np.testing.assert_allclose([found.min(0), found.max(0)], ends, atol=1e-12)
    bar = held(lift(**square, grasped=[*range(42, 49)]))
    np.testing.assert_allclose([bar.min(0), bar.max(0)], [[0.0, 0.56], [0.6, 0.6]])
    assert len(bar) == 14


def test_two_pads_of_one_gripper_stay_two_on_finer_meshes():
    scenario = lift(size_m=(0.1, 0.3), nodes=(4, 5), grasped=["left_top", "right_top"]).finer()
    assert sorted(np.unique(held(scenario)[:, 0].round(9))) == pytest.approx([0.0, 0.01, 0.02, 0.08, 0.09, 0.1])


@pytest.mark.parametrize("gripper", [True, False])
def test_an_upright_pad_turns_its_corner_up_and_follows(tmp_path, gripper):
    scenario = lift(grip="upright_pad", yaw_deg=0, path=[[0, 0, 0, 0], [1.5, 0, 0, 0.1]], frames=15)
    system, _ = scenario.scene.build()
    track = None
    if gripper:
        times = np.arange(1, scenario.steps + 1) * system.time_step
        track = torch.as_tensor(scenario.scene.handles.own_track(times))[None]
    with torch.no_grad():
        nodes = rollout(system, scenario.steps, track=track).positions[0, -1].numpy()
    start, end = scenario.scene.mesh.nodes[scenario.grasped], nodes[scenario.grasped]
    inner, outer = 0, 3
    np.testing.assert_allclose(end[inner], start[inner] + [0, 0, 0.1], atol=1e-4)
    np.testing.assert_allclose(end[outer], end[inner] + [0, 0, 0.02 * 2**0.5], atol=1e-4)
    np.testing.assert_allclose(
        np.linalg.norm(end - end[:, None], axis=-1), np.linalg.norm(start - start[:, None], axis=-1), atol=1e-4
    )
    finer = scenario.finer().scene
    assert len({handle.node for handle in finer.handles.handles}) == len(finer.handles.handles) == 9
    with pytest.raises(SceneError, match="an upright pad"):
        write_scene(scenario.scene, tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"grip_m": 0.3}, r"a pad of 0.3 m does not fit .* 0.2625 x 0.2625 m\. It must be smaller"),
        ({"grip_m": -0.02}, "grip_m"),
        ({"grip_m": 0}, "grip_m"),
        ({"grip": "glove"}, "grip"),
        ({"nodes": (3, 2)}, "2 nodes along y are too few for pads .* Give at least 3"),
        ({"grasped": [24], "grip": "upright_pad"}, "(?i)upright pad inside the cloth"),
        ({"nodes": (80, 80), "grasped": ["right_top", 70]}, "two ends of pads lie .* mm apart"),
    ],
)
def test_what_cannot_be_held_is_refused(changes, message):
    with pytest.raises(SceneError, match=message):
        lift(**changes)


@pytest.mark.parametrize("material", ["soft-knit", "silk", "denim"])
@pytest.mark.parametrize("integrator", ["implicit", "arcsim"])
def test_a_cloth_rests_where_it_starts(material, integrator):
    still = [[0, 0, 0, 0], [1, 0, 0, 0]]
    scenario = lift(material=material, integrator=integrator, path=still, frames=10, table_height_m=0.02, gap_m=0.0006)
    system, _ = scenario.scene.build()
    with torch.no_grad():
        heights = rollout(system, scenario.steps).positions[0, :, :, 2].numpy()
    np.testing.assert_allclose(heights, 0.0206, atol=1e-6 if integrator == "implicit" else 2e-4)


def test_a_cloth_that_starts_high_falls():
    options = built_in("lift").model_copy(update={"gap_m": 0.05})
    table = grid_scenario(options).scene.surrounding.obstacles[0].plane()
    assert table is not None
    assert table[1] == 0.0


class TestFiles:
    def test_a_pad_holds_what_lies_under_it(self, tmp_path):
        data = sheets_over_table() | {"diffcloud": {"grip": "pad", "grip_m": 0.055}}
        scene = load_scene(write_file(write_files(tmp_path), data))
        assert scene.handles.grasp == Grasp("pad", 0.055)
        assert scene.handles.nodes == [9, 10, 12, 13, 15, 17]  # a handle that names several is a pad of these
        again = load_scene(write_scene(scene, tmp_path / "again"))
        assert again.handles.nodes == scene.handles.nodes
        assert [handle.pad for handle in again.handles.handles] == [1, 1, 1, 1, 2, 2]

    @pytest.mark.parametrize(
        ("block", "message"),
        [
            ({"grip": "pad", "grip_m": 0.2}, r"handles.0: A pad of 0.2 does not fit on a cloth"),
            ({"grip": "pad", "grip_m": 0.02}, "holds no other node of this mesh"),
            ({"grip": "pad", "grip_m": -1}, "grip_m"),
            ({"grip_m": 0.02}, "`grip_m` is the size of a `grip`"),
        ],
    )
    def test_what_is_no_pad_is_refused(self, tmp_path, block, message):
        path = write_file(write_files(tmp_path), sheets_over_table() | {"diffcloud": block})
        with pytest.raises(SceneError, match=message):
            load_scene(path)

    def test_a_pivot_is_kept(self, tmp_path):
        scene = load_scenario("recorded_lift").scene
        path = write_scene(scene, tmp_path)
        assert json.loads(path.read_text())["diffcloud"]["grip"] == "pivot"
        again = load_scene(path)
        assert again.handles.grasp == scene.handles.grasp
        factors = again.build()[0].properties.stretching
        assert torch.equal(factors, scene.build()[0].properties.stretching)
        assert factors.max() == pytest.approx(1.303, abs=1e-3)
