"""Files of others: what they say of themselves is checked before memory is taken, and nothing in them is lost silently."""

from __future__ import annotations

import io
import json
import struct
import zipfile

import numpy as np
import pytest

from diffcloud.errors import ConfigError, DiffCloudError, EpisodeError
from diffcloud.estimation.record import read_fit
from diffcloud.io import files, inputs, tables
from diffcloud.io.arrays import read_npy, read_npz
from diffcloud.io.files import read_json, read_yaml
from diffcloud.io.pickles import load_npy
from diffcloud.io.tables import read_csv


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.npz"


class TestArrays:
    def test_what_numpy_writes_comes_back(self, path, rng):
        told = {
            "f": rng.normal(size=(3, 4)), "i": np.arange(5), "fortran": np.asfortranarray(rng.normal(size=(2, 3))),
            "text": np.array(["a", "bc"]),
            "scalar": np.array(2.5), "empty": np.zeros((0, 3)), "bool": np.array([True, False]),
        }  # fmt: skip
        for write in (np.savez, np.savez_compressed):
            write(path, **told)
            found = read_npz(path, kind="set", error=EpisodeError)
            assert found.keys() == told.keys()
            for name, array in told.items():
                np.testing.assert_array_equal(found[name], array)
                assert found[name].dtype == array.dtype
                assert found[name].flags.writeable
        np.save(path.with_suffix(".npy"), told["fortran"])
        np.testing.assert_array_equal(read_npy(path.with_suffix(".npy"), kind="set", error=EpisodeError), told["fortran"])

    def refused(self, path, message, **options):
        with pytest.raises(EpisodeError, match=message):
            read_npz(path, kind="set", error=EpisodeError, **options)

    def test_damaged_ones_are_named(self, path):
        self.refused(path, "No such set: ")
        path.write_bytes(b"PK nothing")
        self.refused(path, r"a\.npz is not a readable set: ")
        np.savez(path, a=np.zeros(3))
        self.refused(path, "it lacks b", names=("a", "b"))
        np.savez(path, a=np.array([{}], dtype=object))
        self.refused(path, "has elements of type object")

    @pytest.mark.parametrize("cut", [0.3, 0.6, 0.95])
    def test_a_deflate_stream_that_is_cut_or_damaged(self, path, cut, rng):
        np.savez_compressed(path, a=rng.normal(size=2000))
        data = bytearray(path.read_bytes())
        for index in range(int(cut * len(data)), int(cut * len(data)) + 8):
            data[index] ^= 0xFF
        path.write_bytes(data)
        self.refused(path, "is not a readable set")

    def test_encryption_and_unknown_compression(self, path):
        np.savez(path, a=np.zeros(3))
        good = path.read_bytes()
        for offset, value, message in ((6, 1, "encrypted"), (8, 99, "compression|not supported")):
            data = bytearray(good)
            struct.pack_into("<H", data, offset, value)
            struct.pack_into("<H", data, data.index(b"PK\x01\x02") + offset + 2, value)  # the directory says so, too
            path.write_bytes(data)
            self.refused(path, message)

    def test_a_header_that_states_more_than_there_is_takes_no_memory(self, path):
        body = npy(np.zeros(3))
        head = body.replace(b"(3,)", b"(30000000000,)".ljust(4))
        length = struct.unpack_from("<H", body, 8)[0]
        head = head[:8] + struct.pack("<H", length + len(head) - len(body)) + head[10:]
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("a.npy", head)
        self.refused(path, "states 240000000000 bytes and has 24")
        (path.parent / "b.npy").write_bytes(head)
        with pytest.raises(EpisodeError, match="states 240000000000 bytes"):
            read_npy(path.parent / "b.npy", kind="set", error=EpisodeError)

    @pytest.mark.parametrize(
        ("kind", "shape", "message"),
        [
            ("<U0", (10**9,), "(an array of|of type) <U0"),
            ("<f8", (0, 10**30), "allowed dimension"),
            ("<f8", (1,) * 9, "shape"),
        ],
    )
    def test_a_shape_that_needs_no_bytes_takes_no_memory(self, path, kind, shape, message):
        """numpy has a letter's memory for each text without letters: four gigabytes here."""
        stream = io.BytesIO()
        np.lib.format.write_array_header_1_0(stream, {"descr": kind, "fortran_order": False, "shape": shape})
        path.with_suffix(".npy").write_bytes(stream.getvalue() + (b"" if 0 in shape or kind == "<U0" else bytes(8)))
        with pytest.raises(EpisodeError, match=message):
            read_npy(path.with_suffix(".npy"), kind="set", error=EpisodeError)
        with pytest.raises(EpisodeError, match=message):
            load_npy(path.with_suffix(".npy"))

    @pytest.mark.parametrize("head", [b"{", b"{'descr': '<f8', 'fortran_order': False, 'shape': (", b"[" * 60, b"1 +"])
    def test_a_header_that_is_no_header(self, path, head):
        body = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head
        path.with_suffix(".npy").write_bytes(body + bytes(24))
        with pytest.raises(EpisodeError, match="has no header of an array"):
            read_npy(path.with_suffix(".npy"), kind="set", error=EpisodeError)

    def test_a_bomb_is_not_unpacked(self, path, monkeypatch):
        np.savez_compressed(path, a=np.zeros(1_000_000))
        assert path.stat().st_size < 20_000
        self.refused(path, r"unpacks to 8\.0 MB\. A set may have 1\.0 MB", most_bytes=1_000_000)
        np.save(path.with_suffix(".npy"), np.zeros(1000))
        with pytest.raises(EpisodeError, match="may have"):
            read_npy(path.with_suffix(".npy"), kind="set", error=EpisodeError, most_bytes=1000)
        assert inputs.MOST_BYTES <= 2**30


class TestText:
    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ('{"a": 1, "b": {"c": 1, "c": 2}}', "names 'c' twice"),
            ('{"a": NaN}', "NaN is no number of JSON"),
            ('{"a": -Infinity}', "-Infinity is no number"),
            ('{"a": 1e999}', "1e999 is too large"),
            ("[" * 100_000 + "]" * 100_000, "is not readable JSON"),
            ('{"a": ' + "9" * 5000 + "}", "is not readable JSON"),
        ],
    )
    def test_json(self, tmp_path, text, message):
        (tmp_path / "a.json").write_text(text)
        with pytest.raises(DiffCloudError, match=message):
            read_json(tmp_path / "a.json")

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("a: 1\nb: {c: 1}\na: 2\n", "line 3: the key 'a' occurs twice"),
            ("- {b: 1, b: 1}\n", "line 1: the key 'b' occurs twice"),
            ("[" * 100_000 + "]" * 100_000, "is not readable YAML"),
        ],
    )
    def test_yaml(self, tmp_path, text, message):
        (tmp_path / "a.yaml").write_text(text)
        with pytest.raises(DiffCloudError, match=message):
            read_yaml(tmp_path / "a.yaml")

    def test_large_ones_are_not_read(self, tmp_path, monkeypatch):
        monkeypatch.setattr(files, "_MOST_JSON", 10)
        monkeypatch.setattr(files, "_MOST_YAML", 10)
        (tmp_path / "a").write_text("[1, 2, 3, 4, 5]")
        for read in (read_json, read_yaml):
            with pytest.raises(DiffCloudError, match=r"A file may have 0\.0 MB"):
                read(tmp_path / "a")


class TestTables:
    @pytest.mark.parametrize(
        ("text", "message"),
        [
            (b"x,y,x\n1,2,3\n", "has the column 'x' twice"),
            (b"", "No columns"),
            (b"\xff\xfex,y\n1,2\n", "is not a readable track"),
            (b"x,y\n1,2,3\n4,5\n", "is not a readable track"),
            (b"x,y\n1," + b"t" * 20_000 + b"\n", "a cell has 20000 letters"),
        ],
    )
    def test_damaged_ones_are_named(self, tmp_path, text, message):
        (tmp_path / "t.csv").write_bytes(text)
        with pytest.raises(EpisodeError, match=message):
            read_csv(tmp_path / "t.csv", kind="track", error=EpisodeError)

    def test_large_ones_are_not_read(self, tmp_path, monkeypatch):
        monkeypatch.setattr(tables, "_MOST_BYTES", 4)
        (tmp_path / "t.csv").write_text("x,y\n1,2\n")
        with pytest.raises(EpisodeError, match="A track may have"):
            read_csv(tmp_path / "t.csv", kind="track", error=EpisodeError)

    def test_a_torn_last_line_is_left_out(self, tmp_path):
        (tmp_path / "t.csv").write_text("x,y\n1,2\n3,")
        table = read_csv(tmp_path / "t.csv", kind="track", error=EpisodeError, torn=True)
        assert table.to_numpy().tolist() == [[1, 2]]


def test_a_fit_whose_history_has_no_shape_is_refused(tmp_path):
    from tests.estimation.records import record_of

    told = record_of().plain()
    told["history"]["values"] = told["history"]["values"][:-1]
    (tmp_path / "f.json").write_text(json.dumps(told))
    with pytest.raises(ConfigError, match="damaged fit: history"):
        read_fit(tmp_path / "f.json")
