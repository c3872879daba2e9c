"""OBJ: nodes against verts, seams, polygons, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diffcloud.errors import MeshError
from diffcloud.io.obj import STRETCHED, other_lengths, read_cloth, read_surface, write_cloth, write_surface
from diffcloud.jobs.scenarios import limits
from diffcloud.mesh import grid_cloth
from diffcloud.scene.scenarios import load_scenario


def write(path, text):
    path.write_text(text)
    return path


def test_seam_nodes_own_several_verts(tmp_path):
    path = write(
        tmp_path / "seam.obj",
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 5 5\nvt 6 6\nvt 5 6\n"
        "f 1/1 2/2 3/3\nf 1/4 3/5 4/6\n",
    )
    mesh = read_cloth(path)
    assert len(mesh.nodes) == 4
    assert len(mesh.verts) == 6
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert mesh.vert_node.tolist() == [0, 1, 2, 0, 2, 3]


def test_corners_without_vt_take_the_nodes_first_vert_or_its_xy(tmp_path):
    path = write(tmp_path / "a.obj", "v 0 0 0\nv 2 0 0\nv 0 2 0\nv 2 2 0\nvt 0 0\nvt 2 0\nvt 0 2\nf 1/1 2/2 3/3\nf 2 4 3\n")
    mesh = read_cloth(path)
    assert mesh.face_verts.tolist() == [[0, 1, 2], [1, 3, 2]]
    assert mesh.verts[3].tolist() == [2, 2]


def test_quads_are_cut_from_the_corner_with_the_largest_smallest_angle(tmp_path):
    square = write(tmp_path / "q.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    assert read_surface(square).faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    kite = write(tmp_path / "k.obj", "v 0 0 0\nv 1 -0.2 0\nv 4 0 0\nv 1 0.2 0\nf 1 2 3 4\n")
    assert read_surface(kite).faces.tolist() == [[1, 2, 3], [1, 3, 0]]


def test_write_then_read_gives_the_same_mesh(tmp_path, rng):
    mesh = grid_cloth(3, 4, 0.1, 1 / 3)
    nodes = mesh.nodes + 1e-3 * rng.normal(size=mesh.nodes.shape)
    write_cloth(tmp_path / "c.obj", mesh, nodes)
    again = read_cloth(tmp_path / "c.obj")
    assert np.array_equal(again.nodes, nodes)
    assert np.array_equal(again.verts, mesh.verts)
    assert np.array_equal(again.face_verts, mesh.face_verts)
    surface = read_surface(tmp_path / "c.obj")
    write_surface(tmp_path / "s.obj", surface)
    assert np.array_equal(read_surface(tmp_path / "s.obj").nodes, nodes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0\n", "line 1.*three coordinates"),
        ("v a b c\n", "line 1"),
        ("v 0 0 0\nf 1 2 3\n", "v 2"),
        ("v 0 0 0\nf 0 1 1\n", "start at 1"),
        ("curv 1 2\n", "unsupported keyword 'curv'"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n", "shared by nodes"),
        ("v 0 0 0\nv 1 0 0\n", "no faces"),
    ],
)
def test_bad_files_are_refused_with_file_and_line(tmp_path, text, message):
    with pytest.raises(MeshError, match=message) as caught:
        read_cloth(write(tmp_path / "bad.obj", text))
    assert "bad.obj" in str(caught.value)


def test_missing_and_binary_files(tmp_path):
    with pytest.raises(MeshError, match="No such mesh"):
        read_cloth(tmp_path / "none.obj")
    (tmp_path / "b.obj").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(MeshError, match="not a readable mesh"):
        read_surface(tmp_path / "b.obj")


def cone(rows=7, columns=25, slope=0.5):
    """A skirt: (nodes [V, 3], its flat rest shape [V, 2], faces [F, 3]); a cone unrolls onto a part of a disc."""
    radius, turn = np.meshgrid(np.linspace(0.2, 0.5, rows), np.linspace(0, 1.8 * np.pi, columns), indexing="ij")
    flat = np.stack([radius * np.cos(slope * turn), radius * np.sin(slope * turn)], -1).reshape(-1, 2)
    height = -radius * np.sqrt(1 - slope**2)
    nodes = np.stack([slope * radius * np.cos(turn), slope * radius * np.sin(turn), height], -1).reshape(-1, 3)
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    return nodes, flat, np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])


def obj_of(path, nodes, verts, faces):
    lines = [f"v {x} {y} {z}" for x, y, z in nodes] + [f"vt {u} {v}" for u, v in verts]
    return write(path, "\n".join(lines + ["f " + " ".join(f"{i + 1}/{i + 1}" for i in face) for face in faces]))


class TestRestShape:
    """Material space is a shape in metres; a picture's coordinates, from 0 to 1, are none."""

    def test_a_skirt_with_its_rest_shape(self, tmp_path):
        nodes, flat, faces = cone()
        mesh = read_cloth(obj_of(tmp_path / "s.obj", nodes, flat, faces))
        assert np.array_equal(mesh.verts, flat)
        assert mesh.face_area.sum() == pytest.approx(0.5 * 0.9 * np.pi * (0.5**2 - 0.2**2), rel=0.01)

    def test_one_that_hangs_is_stretched_by_some_per_cent(self, tmp_path):
        nodes, flat, faces = cone()
        mesh = read_cloth(obj_of(tmp_path / "s.obj", nodes * [1.0, 1.0, 1.05], flat, faces))
        assert np.array_equal(mesh.verts, flat)

    @pytest.mark.parametrize("scale", [(2.0, 2.0), (0.5, 0.5), (1.0, 1.6), (0.6, 1.0), (1000.0, 1000.0)])
    def test_one_to_another_scale_is_refused_with_the_factors(self, tmp_path, scale):
        nodes, flat, faces = cone()
        with pytest.raises(MeshError, match=r"s\.obj: the material space \(vt\) has .* m²; vt looks like") as caught:
            read_cloth(obj_of(tmp_path / "s.obj", nodes, flat * scale, faces))
        factors = [float(word) for word in str(caught.value).split("Scale u by ")[1].split(" if ")[0].split(" and v by ")]
        np.testing.assert_allclose(np.multiply(factors, scale), 1, atol=0.02)

    def test_an_atlas_from_0_to_1_is_refused(self, tmp_path):
        nodes, _, faces = cone()
        u, v = np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 1, 25), indexing="ij")
        with pytest.raises(MeshError, match=r"vt\) has 1 m², the faces between the nodes \(v\) have 0\.29"):
            read_cloth(obj_of(tmp_path / "s.obj", nodes, np.stack([u, v], -1).reshape(-1, 2), faces))

    def test_a_pose_without_rest_shape_that_is_not_flat_is_refused(self, tmp_path):
        text = "v 0 0 0\nv 1 0 0\nv 1 1 2\nv 0 1 2\nf 1 2 3\nf 1 3 4\n"
        with pytest.raises(MeshError, match=r"has 1 m², .* have 2\.24 m²"):
            read_cloth(write(tmp_path / "p.obj", text))

    def test_what_lies_between_is_a_warning(self):
        lift, jacket = built_in_mesh("lift"), built_in_mesh("vest_hang")
        for mesh in (lift, jacket):
            assert other_lengths(mesh)[0] < STRETCHED
        wide = replace(lift, nodes=lift.nodes * 1.3)
        factor, message = other_lengths(wide)
        assert factor == pytest.approx(1.3)
        assert "Scale u by 1.3 and v by 1.3 " in message
        scenario = load_scenario("lift")
        assert limits(scenario) == []
        (told,) = limits(replace(scenario, scene=replace(scenario.scene, mesh=wide)))
        assert told == f"In the mesh of lift, {message}"


def built_in_mesh(name):
    return load_scenario(name).scene.mesh
