"""OBJ: nodes against verts, seams, polygons, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.errors import MeshError
from diffcloud.io.obj import read_cloth, read_surface, write_cloth, write_surface
from diffcloud.mesh import grid_cloth


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
    path = write(tmp_path / "a.obj", "v 0 0 3\nv 2 0 0\nv 0 2 0\nv 2 2 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\nf 2 4 3\n")
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
    nodes = mesh.nodes + rng.normal(size=mesh.nodes.shape)
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
