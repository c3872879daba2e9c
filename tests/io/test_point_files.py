"""PCD and PLY of other tools: every field type, order and encoding gives the same points."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from diffcloud.errors import EmptyCloudError, EpisodeError
from diffcloud.io.clouds import read_cloud
from diffcloud.io.pcd import lzf_decompressed
from tests.cli.invoke import invoke

POINTS = np.array([[0.4, -0.12, 0.02], [0.55, 0.25, 0.0], [0.7, 0.125, 1.5], [-0.25, 0.5, 0.75]])
WHOLE = np.array([[1, 2, 3], [4, 50, 6], [100, 8, 9], [7, 0, 11]])


def literals(data):
    """LZF of bytes without any reference."""
    return b"".join(bytes([len(part) - 1]) + part for part in (data[at : at + 32] for at in range(0, len(data), 32)))


def pcd(path, points, kind="binary", fields=("x", "y", "z"), code="f4", extra=None, head=""):
    """Write points; `extra` (name, numpy code, count) comes before the coordinates, filled with 7."""
    layout = [(name, f"<{code}") for name in fields]
    if extra is not None:
        layout.insert(0, (extra[0], f"<{extra[1]}", (extra[2],)))
    table = np.zeros(len(points), layout)
    for name in fields:
        table[name] = points[:, "xyz".index(name.lower())]
    if extra is not None:
        table[extra[0]] = 7
    kinds = [table.dtype[name].base for name in table.dtype.names]
    counts = [int(np.prod(table.dtype[name].shape)) for name in table.dtype.names]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7",
        f"FIELDS {' '.join(table.dtype.names)}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}",
        f"TYPE {' '.join(kind.kind.upper() for kind in kinds)}",
        f"COUNT {' '.join(map(str, counts))}",
        head or f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 1 2 3 0.7 0.7 0 0",
        f"POINTS {len(points)}\nDATA {kind}\n",
    ]
    if kind == "ascii":
        data = "\n".join(
            " ".join(str(number) for name in table.dtype.names for number in np.ravel(row[name])) for row in table
        ).encode()
    elif kind == "binary":
        data = table.tobytes()
    else:
        plain = b"".join(np.ascontiguousarray(table[name]).tobytes() for name in table.dtype.names)
        packed = literals(plain)
        data = struct.pack("<II", len(packed), len(plain)) + packed
    path.write_bytes("\n".join(header).encode() + data)
    return path


class TestPcd:
    @pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
    @pytest.mark.parametrize("code", ["f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"])
    @pytest.mark.parametrize("extra", [None, ("rgb", "u4", 1), ("fpfh", "f4", 33), ("_", "u1", 5), ("t", "f8", 1)])
    def test_any_field_type_in_any_encoding(self, tmp_path, kind, code, extra):
        points = POINTS if code[0] == "f" else WHOLE
        path = pcd(tmp_path / "a.pcd", points, kind, code=code, extra=extra)
        np.testing.assert_allclose(read_cloud(path), points, atol=1e-6)

    @pytest.mark.parametrize("fields", [("z", "x", "y"), ("X", "Y", "Z"), ("y", "Z", "X")])
    def test_any_order_and_case_of_names(self, tmp_path, fields):
        np.testing.assert_allclose(read_cloud(pcd(tmp_path / "a.pcd", POINTS, fields=fields)), POINTS, atol=1e-6)

    @pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
    def test_pixels_of_an_organised_cloud_without_a_measurement_are_left_out(self, tmp_path, kind):
        points = np.insert(POINTS, [1, 3], np.nan, axis=0)
        path = pcd(tmp_path / "a.pcd", points, kind, head="WIDTH 3\nHEIGHT 2")
        np.testing.assert_allclose(read_cloud(path), POINTS, atol=1e-6)
        empty = pcd(tmp_path / "b.pcd", np.full((4, 3), np.nan), kind)
        with pytest.raises(EmptyCloudError, match="4 points, all of them NaN"):
            read_cloud(empty)

    def test_references_of_lzf_may_overlap_what_they_make(self):
        # "ab", then 6 bytes from 2 back; "a", then 7 + 100 + 2 bytes from 1 back in the long form
        assert lzf_decompressed(b"\x01ab" + bytes([4 << 5, 1]), 8) == b"abababab"
        assert lzf_decompressed(b"\x00a" + bytes([7 << 5, 100, 0]), 110) == b"a" * 110
        for damaged in (b"\x05ab", bytes([4 << 5, 1]), b"\x01ab" + bytes([4 << 5])):
            with pytest.raises(ValueError, match=r"bytes instead|before the beginning|within a reference"):
                lzf_decompressed(damaged, 8)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (("FIELDS x y z", "FIELDS a b c"), "fields a b c; a cloud needs x, y and z"),
            (("TYPE F F F", "TYPE F F Q"), "field z has TYPE Q SIZE 4; allowed are"),
            (("SIZE 4 4 4", "SIZE 4 4 2"), "field z has TYPE F SIZE 2"),
            (("COUNT 1 1 1", "COUNT 1 1 0"), "COUNT 0"),
            (("COUNT 1 1 1", "COUNT 1 1 3"), r"can hold 2 at most|one number each"),
            (("SIZE 4 4 4", "SIZE 4 4"), "differ in length"),
            (("HEIGHT 1", "HEIGHT 2"), "WIDTH x HEIGHT is 4 x 2, POINTS 4"),
        ],
    )
    def test_headers_that_contradict_themselves_are_refused_with_the_field(self, tmp_path, change, message):
        path = pcd(tmp_path / "a.pcd", POINTS)
        path.write_bytes(path.read_bytes().replace(*(part.encode() for part in change)))
        with pytest.raises(EpisodeError, match=message):
            read_cloud(path)


CODES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
         "double": "f8", "int16": "i2", "float64": "f8"}  # fmt: skip
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def ply(path, elements, form, newline="\n"):
    """Write elements: (name, [(type or (length type, entry type), property)], rows)."""
    lines = ["ply", f"format {form} 1.0", "comment TextureFile ../../secret.png", "obj_info made by hand"]
    data = []
    for name, properties, rows in elements:
        lines.append(f"element {name} {len(rows)}")
        lines += [
            f"property {kind} {label}" if isinstance(kind, str) else f"property list {' '.join(kind)} {label}"
            for kind, label in properties
        ]
        for row in rows:
            numbers = []
            for (kind, _), value in zip(properties, row, strict=True):
                if isinstance(kind, str):
                    numbers.append((kind, value))
                else:
                    numbers += [(kind[0], len(value)), *((kind[1], entry) for entry in value)]
            if form == "ascii":
                data.append((" ".join(str(value) for _, value in numbers) + newline).encode())
            else:
                data += [np.array(value, ORDERS[form] + CODES[kind]).tobytes() for kind, value in numbers]
    path.write_bytes(newline.join([*lines, "end_header", ""]).encode() + b"".join(data))
    return path


XYZ = [("float", "x"), ("float", "y"), ("float", "z")]


@pytest.mark.parametrize("form", ["ascii", *ORDERS])
class TestPly:
    @pytest.mark.parametrize("newline", ["\n", "\r\n"])
    @pytest.mark.parametrize("kind", sorted(CODES))
    def test_any_property_type_and_order(self, tmp_path, form, kind, newline):
        points = POINTS if CODES[kind][0] == "f" else WHOLE
        properties = [("uchar", "red"), (kind, "z"), (kind, "x"), ("double", "time"), (kind, "y")]
        rows = [(10, z, x, 2.5, y) for x, y, z in points.tolist()]
        path = ply(tmp_path / "a.ply", [("vertex", properties, rows)], form, newline)
        np.testing.assert_allclose(read_cloud(path), points, atol=1e-6)

    def test_elements_before_and_after_the_vertices_do_not_matter(self, tmp_path, form):
        lists = [(("uchar", "int"), "vertex_indices")]
        elements = [
            ("camera", [("float", "view_x"), ("int", "id")], [(1.5, 3)]),
            ("range_grid", lists, [([],), ([0],), ([1],), ([],)]),
            ("vertex", XYZ, POINTS.tolist()),
            ("face", [*lists, (("uchar", "float"), "texcoord")], [([0, 1, 2], [0.1] * 6)]),
        ]
        path = ply(tmp_path / "a.ply", elements, form)
        np.testing.assert_allclose(read_cloud(path), POINTS, atol=1e-6)
        path.write_bytes(path.read_bytes() + b"\n")
        np.testing.assert_allclose(read_cloud(path), POINTS, atol=1e-6)

    def test_vertices_may_hold_lists(self, tmp_path, form):
        properties = [XYZ[0], (("ushort", "double"), "weights"), *XYZ[1:]]
        rows = [(x, [0.5] * count, y, z) for count, (x, y, z) in enumerate(POINTS.tolist())]
        path = ply(tmp_path / "a.ply", [("vertex", properties, rows)], form)
        np.testing.assert_allclose(read_cloud(path), POINTS, atol=1e-6)

    def test_vertices_that_are_not_all_there_are_refused(self, tmp_path, form):
        path = ply(tmp_path / "a.ply", [("vertex", XYZ, POINTS.tolist())], form)
        whole = path.read_bytes()
        path.write_bytes(whole[: whole.rindex(b" ") if form == "ascii" else -4])
        with pytest.raises(EpisodeError, match="states 4 points and holds 3: it was cut off"):
            read_cloud(path)
        path.write_bytes(whole.replace(b"vertex 4", b"vertex 4000000000"))
        with pytest.raises(EpisodeError, match="states 4000000000 points, but is shorter"):
            read_cloud(path)
        path.write_bytes(whole.replace(b"float x", b"float a"))
        with pytest.raises(EpisodeError, match="its vertices have a, y, z; they need x, y and z"):
            read_cloud(path)

    def test_a_texture_is_never_opened(self, tmp_path, form, monkeypatch):
        """Neither one that is missing, nor one outside the folder."""
        (tmp_path / "secret.png").write_bytes(b"not for you")
        folder = tmp_path / "one" / "clouds"
        folder.mkdir(parents=True)
        elements = [("vertex", XYZ, POINTS.tolist()), ("face", [(("uchar", "int"), "vertex_indices")], [([0, 1, 2],)])]
        ply(folder / "0.ply", elements, form)
        opened = []
        monkeypatch.setattr("PIL.Image.open", lambda *given, **_: opened.append(given))
        done = invoke("data", "import", folder, "--rate-hz", 10, "--out", tmp_path / "c.npz")
        assert (done.result["points"], opened) == (4, [])
