"""The start of a cloth of any shape is found from its first cloud, and another cloth is refused."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from diffcloud.errors import ConfigError, EpisodeError
from diffcloud.identification import found_cloth, found_layout
from diffcloud.io.episodes import Episode, write_episode
from diffcloud.io.obj import write_surface
from diffcloud.jobs.scene_files import find_scene
from diffcloud.mesh.shapes import grid_cloth
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.scene.scenarios import load_scenario
from diffcloud.scene.scenarios.catalogue import make_scenario, own_options, paths_within, with_paths
from diffcloud.scene.scenarios.layout import find_layout
from diffcloud.scene.scenarios.surface import flat_points, level_frame
from tests.cli.invoke import invoke
from tests.identification.test_hanging import surface


def shape() -> SurfaceMesh:
    """A shirt with one long and one short sleeve, 0.5 m wide."""
    grid = grid_cloth(12, 16, 0.36, 0.48)
    x, y = grid.nodes[grid.faces].mean(axis=1)[:, :2].T
    kept = ((x > -0.14) & (x < 0.08)) | ((y > 0.05) & (x > -0.21))
    used, faces = np.unique(grid.faces[kept], return_inverse=True)
    return SurfaceMesh(grid.nodes[used], faces.reshape(-1, 3))


MESH = shape()
FRAME = level_frame(MESH.nodes, MESH.faces)


def recorded(mesh=MESH, up="front", yaw=0.7, held=(-0.1, 0.17), hand=0.0, others=()):
    """Two frames of a flat cloth that rises with its grippers. A hand may hide the points near the first."""
    rng = np.random.default_rng(0)
    place, points = [0.5, 0.1, 0.03], np.array([[*one, 0.0] for one in (held, *others)])
    frame = level_frame(mesh.nodes, mesh.faces)
    nodes, grasps = (flat_points(one, frame, up, yaw) + place for one in (mesh.nodes, points))
    clouds = [surface(nodes, mesh.faces, 2500, rng) + np.array([0, 0, rise]) for rise in (0.0, 0.3)]
    clouds[0] = clouds[0][np.linalg.norm((clouds[0] - grasps[0])[:, :2], axis=1) > hand]
    names = ("a", "b")[: len(points)]
    track = np.stack([grasps, grasps + np.array([0, 0, 0.3])])
    return Episode.from_frames(clouds, np.array([0.0, 0.1]), gripper=track, grippers=names), nodes


def found(episode, folder, mesh=MESH):
    write_surface(folder / "cloth.obj", mesh)
    cloth = {name: one.value for name, one in found_cloth([episode], None, 0.2, folder / "cloth.obj").items()}
    layout = found_layout(episode, cloth)
    return cloth | {name: one.value for name, one in layout.fields.items()}, layout


@pytest.mark.parametrize(("up", "yaw", "hand"), [("front", 0.7, 0.0), ("back", 3.9, 0.0), ("front", 5.2, 0.1)])
def test_the_cloth_is_found_where_it_was_laid(tmp_path, up, yaw, hand):
    episode, nodes = recorded(up=up, yaw=yaw, hand=hand)
    fields, _ = found(episode, tmp_path)
    placed = flat_points(MESH.nodes, FRAME, fields["up"], np.radians(fields["yaw_deg"])) + np.array(
        [*fields["center_m"], 0.03]
    )
    assert fields["up"] == up
    assert np.linalg.norm(placed - nodes, axis=1).max() < 0.006
    assert fields["grippers"]["a"]["on_mesh_m"][:2] == pytest.approx((-0.1, 0.17), abs=0.005)
    assert fields["table_height_m"] == pytest.approx(0.0294, abs=0.001)


def test_each_gripper_holds_its_place(tmp_path):
    episode, _ = recorded(others=[(0.2, 0.1)])
    fields, _ = found(episode, tmp_path)
    scenario = make_scenario(own_options(fields, "cloth", "test", folder=tmp_path))
    assert scenario.scene.handles.grippers == ("a", "b")
    assert fields["grippers"]["b"]["on_mesh_m"][:2] == pytest.approx((0.2, 0.1), abs=0.006)


def test_another_cloth_is_refused_with_all_distances(tmp_path):
    square = grid_cloth(8, 8, 0.12, 0.12)
    episode, _ = recorded()
    with pytest.raises(EpisodeError, match=r"RMS distances .*degrees \d+ mm; .*at most 25 mm are allowed"):
        found(episode, tmp_path, SurfaceMesh(square.nodes, square.faces))


def test_a_shirt_is_no_rectangle():
    episode, _ = recorded()
    with pytest.raises(EpisodeError, match="State the shape of another cloth by --mesh"):
        find_layout(episode, (0.44, 0.36))


def test_a_rectangle_under_a_hand_is_one():
    grid = grid_cloth(9, 11, 0.32, 0.40)
    episode, _ = recorded(SurfaceMesh(grid.nodes, grid.faces), held=(0.19, 0.15), hand=0.1)
    assert find_layout(episode, (0.40, 0.32)).fields["grasped"].value


def test_a_mesh_that_hangs_is_refused(tmp_path):
    write_surface(tmp_path / "cloth.obj", MESH)
    upright = np.random.default_rng(0).uniform(0, 0.3, (500, 3)) * [1, 0.01, 1]
    episode = Episode.from_frames([upright] * 2, np.arange(2) / 10, gripper=np.tile([0.15, 0.0, 0.32], (2, 1, 1)))
    with pytest.raises(EpisodeError, match="`start: hang`"):
        found_cloth([episode], None, None, tmp_path / "cloth.obj")


def test_size_and_mesh_exclude_each_other(tmp_path):
    episode, _ = recorded()
    with pytest.raises(ConfigError, match="Give one of them"):
        found_cloth([episode], (0.4, 0.3), None, tmp_path / "cloth.obj")
    with pytest.raises(ConfigError, match="there is none at"):
        found_cloth([episode], None, None, tmp_path / "cloth.obj")


def test_the_command_takes_tracks_of_two_grippers(tmp_path):
    folder = tmp_path / "clouds"
    folder.mkdir()
    np.save(folder / "000.npy", np.zeros((5, 3)))
    (folder / "gripper_a.csv").write_text("t_s,x,y,z\n0,0,0,0\n")
    command = ("fit", str(folder), "--out", str(tmp_path / "found"))
    assert "Add the missing track" in invoke(*command, code=1).errors
    np.save(folder / "001.npy", np.zeros((5, 3)))
    (folder / "gripper_b.csv").write_text("t_s,x,y,z\n0,0,0,0\n.1,0,0,0\n")
    assert "gripper 'a' has 1 rows for 2 clouds" in invoke(*command, code=1).errors.replace("\n", " ")


def test_the_folder_of_a_fit_has_its_own_mesh_and_can_be_moved(tmp_path, capsys):
    episode, _ = recorded()
    write_episode(tmp_path / "lifted.npz", episode)
    write_surface(tmp_path / "shirt.obj", MESH)
    here, there = tmp_path / "found", tmp_path / "elsewhere"
    mesh, recordings = tmp_path / "shirt.obj", [tmp_path / "lifted.npz"]
    _, cloth, layouts = find_scene(recordings, here, None, 0.2, mesh=mesh)
    assert yaml.safe_load((here / "cloth.yaml").read_text())["mesh"] == "cloth.obj"
    assert (here / "cloth.obj").read_bytes() == mesh.read_bytes()
    fields = {**cloth, **layouts["lifted"]}
    (here / "scenes").mkdir()
    (here / "scenes/lifted.yaml").write_text(yaml.safe_dump(paths_within(fields, here / "scenes", here)))
    here.rename(there)
    mesh.unlink()
    moved = load_scenario(there / "scenes/lifted.yaml")
    assert len(moved.scene.mesh.nodes) > 100
    find_scene(recordings, there, None, 0.2, mesh=there / "cloth.obj")
    assert "that counts" not in capsys.readouterr().err
    write_surface(mesh, SurfaceMesh(2 * MESH.nodes, MESH.faces))
    find_scene(recordings, there, None, 0.2, mesh=mesh)
    assert "that counts, not --mesh" in capsys.readouterr().err.replace("\n", " ")


def test_paths_outside_of_the_folder_stay_absolute(tmp_path):
    fields = {"mesh": str(tmp_path / "a/b/cloth.obj"), "material": str(tmp_path / "own.json"), "base": "mesh"}
    told = paths_within(fields, tmp_path / "a/scenes", tmp_path / "a")
    assert told == {"mesh": "../b/cloth.obj", "material": str(tmp_path / "own.json"), "base": "mesh"}
    assert with_paths(told, tmp_path / "a/scenes") == fields
    assert paths_within({"material": "knit"}, tmp_path, tmp_path) == {"material": "knit"}
