"""Inputs of the wrong kind, of a size that memory does not hold, or with numbers that some read otherwise."""

from __future__ import annotations

import os
import signal
import socket
import struct
import subprocess
import sys
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from diffcloud.errors import DiffCloudError, EpisodeError
from diffcloud.io.arrays import read_npy, read_npz
from diffcloud.io.clouds import read_cloud
from diffcloud.io.episodes import Episode, read_episode
from diffcloud.io.files import files_in, read_json, read_yaml, write_text
from diffcloud.io.images import png_size, read_color, read_depth
from diffcloud.io.inputs import open_input, read_input
from diffcloud.io.numbers import disguised, number, whole
from diffcloud.io.obj import read_cloth
from diffcloud.io.pickles import load_npy
from diffcloud.io.schema import Checked, Vector
from diffcloud.io.tables import numbers, read_csv
from diffcloud.io.urdf import read_urdf
from diffcloud.jobs.settings import load_config
from diffcloud.regressors import Regressor
from diffcloud.scene.scenarios import load_scenario
from diffcloud.settings import updated
from tests.cli.invoke import environment

READERS = {
    "yaml": read_yaml,
    "json": read_json,
    "csv": lambda path: read_csv(path, kind="table", error=DiffCloudError),
    "npz": lambda path: read_npz(path, kind="set", error=DiffCloudError),
    "npy": lambda path: read_npy(path, kind="set", error=DiffCloudError),
    "pickle": load_npy,
    "obj": read_cloth,
    "urdf": read_urdf,
    "png": read_depth,
    "colour": read_color,
    "size": png_size,
    "safetensors": Regressor.read,
}


@pytest.fixture
def in_time():
    """A read that waits for ever fails."""
    signal.setitimer(signal.ITIMER_REAL, 20)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0)


class TestNoFile:
    @pytest.mark.parametrize("reader", READERS)
    def test_a_pipe_is_refused_at_once(self, tmp_path, reader, in_time):
        os.mkfifo(tmp_path / "pipe")
        with pytest.raises(DiffCloudError, match=r"is a named pipe\. An? .* must be a regular file\. Write its"):
            READERS[reader](tmp_path / "pipe")

    @pytest.mark.parametrize("suffix", [".ply", ".pcd", ".xyz", ".npy"])
    def test_also_of_a_cloud(self, tmp_path, suffix, in_time):
        os.mkfifo(tmp_path / f"0{suffix}")
        with pytest.raises(DiffCloudError, match="named pipe"):
            read_cloud(tmp_path / f"0{suffix}")

    def test_also_of_a_scenario_and_of_parameters(self, tmp_path, in_time):
        os.mkfifo(tmp_path / "s.yaml")
        for read in (load_scenario, load_config):
            with pytest.raises(DiffCloudError, match="named pipe"):
                read(tmp_path / "s.yaml")

    def test_devices_sockets_and_folders(self, tmp_path):
        for path, what in ((Path("/dev/zero"), "a device"), (tmp_path, "a folder")):
            with pytest.raises(DiffCloudError, match=f"is {what}"):
                open_input(path)
        with socket.socket(socket.AF_UNIX) as one:
            one.bind(str(tmp_path / "s"))
            with pytest.raises(DiffCloudError, match="is a socket"):
                open_input(tmp_path / "s")

    def test_a_missing_one_and_a_name_that_no_file_has(self, tmp_path):
        with pytest.raises(DiffCloudError, match=r"^No such track: .*none\.$"):
            open_input(tmp_path / "none", kind="track")
        for name in ("a\0b", "n" * 5000):
            with pytest.raises(DiffCloudError, match="Cannot read"):
                open_input(tmp_path / name)

    def test_a_file_that_is_longer_than_its_size_is_not_read_whole(self, tmp_path):
        """The system states no size for its own files."""
        path = Path("/proc/self/maps")
        if not path.exists():
            path = tmp_path / "f"
            path.write_text("x" * 200)
        with pytest.raises(DiffCloudError, match=r"has 0\.0 MB\. A file may have 0\.0 MB"):
            read_input(path, most_bytes=100)


class TestArchives:
    def test_an_array_that_stands_there_twice(self, tmp_path):
        path = tmp_path / "e.npz"
        np.savez(path, a=np.zeros(3), b=np.ones(3))
        with zipfile.ZipFile(path) as archive:
            data = archive.read("a.npy")
        with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(path, "a") as archive:
            archive.writestr("a.npy", data)
        with pytest.raises(DiffCloudError, match="it holds 'a' twice"):
            read_npz(path, kind="episode", error=DiffCloudError)

    @pytest.mark.parametrize("size", [64, 2**31])
    def test_a_directory_that_lies_about_sizes(self, tmp_path, size):
        """Eight megabytes said to be 64 bytes, or two gigabytes: neither is unpacked."""
        path = tmp_path / "e.npz"
        np.savez_compressed(path, a=np.zeros(1_000_000))
        data = bytearray(path.read_bytes())
        place = data.rindex(b"PK\x01\x02")
        data[place + 24 : place + 28] = struct.pack("<I", size)
        path.write_bytes(data)
        tracemalloc.start()
        with pytest.raises(DiffCloudError, match=r"is not a readable set|unpacks to 2\.15 GB"):
            read_npz(path, kind="set", error=DiffCloudError)
        assert tracemalloc.get_traced_memory()[1] < 4_000_000
        tracemalloc.stop()

    def test_four_gigabytes_are_refused_by_their_directory(self, tmp_path):
        path = tmp_path / "e.npz"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name in ("points", "offsets", "times", "meta"):
                archive.writestr(f"{name}.npy", b"")
        data = bytearray(path.read_bytes())
        place = data.index(b"PK\x01\x02")
        data[place + 24 : place + 28] = struct.pack("<I", 3_900_000_000)
        path.write_bytes(data)
        with pytest.raises(DiffCloudError, match=r"unpacks to 3\.90 GB\. An episode may have"):
            read_episode(path)


class Block(Checked):
    length: float = 1.0
    count: int = 1
    on: bool = True
    place: Vector = (0.0, 0.0, 0.0)


ODD = ("1:30", "yes", "no", "on", "off", "0x10", "010", "0o17", "1_000", "1_0.5", "0b1", "١")
"""Of which readers of YAML 1.1 or Python make numbers or truth values."""


class TestNumbers:
    @pytest.mark.parametrize("odd", ODD)
    @pytest.mark.parametrize("field", ["length", "count", "on", "place"])
    def test_odd_ones_are_refused_in_yaml(self, tmp_path, odd, field):
        (tmp_path / "f.yaml").write_text(f"{field}: {f'[0, 0, {odd}]' if field == 'place' else odd}\n", encoding="utf-8")
        with pytest.raises(ValidationError, match="Input should be"):
            Block.model_validate(read_yaml(tmp_path / "f.yaml"))

    def test_plain_ones_are_read(self, tmp_path):
        (tmp_path / "f.yaml").write_text("length: 1e-5\ncount: 90\non: false\nplace: [-.5, +3, 1.5E+2]\n")
        assert Block.model_validate(read_yaml(tmp_path / "f.yaml")) == Block(
            length=1e-5, count=90, on=False, place=(-0.5, 3, 150)
        )

    def test_truth_values_are_no_numbers(self):
        for data in ({"length": True}, {"count": False}, {"on": 1}):
            with pytest.raises(ValidationError):
                Block.model_validate(data)

    def test_names_stay_what_they_are(self, tmp_path):
        (tmp_path / "f.yaml").write_text("no: [yes, 1:30, 2024-01-01]\n1e5: 010\n")
        assert read_yaml(tmp_path / "f.yaml") == {"no": ["yes", "1:30", "2024-01-01"], "1e5": "010"}

    def test_a_scenario_says_which_field(self, tmp_path):
        (tmp_path / "s.yaml").write_text("base: lift\nframes: 1:30\n")
        with pytest.raises(DiffCloudError, match=r"s\.yaml: frames: Input should be a number\. Allowed are plain decimal"):
            load_scenario(tmp_path / "s.yaml")

    @pytest.mark.parametrize("odd", ["1:30", "yes", "0x10", "1_000", "True", "١", "1_0.5"])
    def test_odd_ones_are_refused_in_tables(self, tmp_path, odd):
        (tmp_path / "t.csv").write_text(f"t_s,x\n0,{odd}\n1,{odd}\n", encoding="utf-8")
        with pytest.raises(DiffCloudError, match=r"Allowed are plain decimal|allowed are plain decimal"):
            numbers(read_csv(tmp_path / "t.csv", kind="t", error=DiffCloudError), ["x"], place="t", error=DiffCloudError)

    def test_plain_ones_in_tables(self, tmp_path):
        (tmp_path / "t.csv").write_text("t_s,x,y\n0,1e-5,\n1,-2,\n")
        table = read_csv(tmp_path / "t.csv", kind="t", error=DiffCloudError)
        found = numbers(table, ["t_s", "x", "y"], place="t", error=DiffCloudError)
        assert found.tolist()[0][:2] == [0, 1e-5]
        assert np.isnan(found[:, 2]).all()

    def test_words(self):
        assert [number(word) for word in ("1", "-.5", "2.", "1e3", "0007")] == [1, -0.5, 2, 1000, 7]
        assert whole("12") == 12
        for word in ("1_0", "0x1", "", "1:3", "１"):
            with pytest.raises(ValueError, match="not a"):
                number(word)
            with pytest.raises(ValueError, match="not a whole number"):
                whole(word)
        assert disguised("1_000")
        assert not disguised("1000")
        assert not disguised("lift_1")

    def test_a_mesh(self, tmp_path):
        (tmp_path / "m.obj").write_text("v 0 0 0\nv 1_0 0 0\nv 0 1 0\nf 1 2 3\n")
        with pytest.raises(DiffCloudError, match="line 2: '1_0' is not a number"):
            read_cloth(tmp_path / "m.obj")


class TestTracks:
    """A simulation would follow a gripper that is nowhere near the cloth for hours."""

    def episode(self, factor=1.0, seconds=1.0):
        x = np.linspace(0, 0.4, 8)
        cloud = np.stack([*np.meshgrid(x, x), np.zeros((8, 8))], -1).reshape(-1, 3)
        track = np.stack([0.4 + 0 * x, 0.4 + 0 * x, x / 2], -1)
        return Episode.from_frames([cloud] * 8, seconds * np.arange(8) / 10, gripper=factor * track[:, None])

    def test_metres_are_taken(self):
        assert self.episode().gripper[-1, 0, 2] == pytest.approx(0.2)

    @pytest.mark.parametrize("factor", [100, 1000])
    def test_centimetres_and_millimetres_are_refused(self, factor):
        with pytest.raises(EpisodeError, match=r"m away from the middle of the clouds.*may be 10 times.*not millimetres"):
            self.episode(factor)

    def test_milliseconds_for_seconds(self):
        assert self.episode(seconds=0.1).times[-1] == pytest.approx(0.07)
        with pytest.raises(EpisodeError, match=r"moves at 286 m/s\. It may move at 100 m/s\. Give times in seconds"):
            self.episode(seconds=1e-3)


def test_a_name_that_is_not_in_the_systems_encoding(tmp_path):
    """It could stand in no record, no table and no page."""
    (tmp_path / os.fsdecode(b"a\xff.npz")).write_bytes(b"")
    with pytest.raises(DiffCloudError, match=r"a\\udcff\.npz is not utf-8 text.*Rename the file"):
        files_in(tmp_path, ".npz")
    write_text(tmp_path / "t", "a\udcff µ")
    assert (tmp_path / "t").read_text(encoding="utf-8") == "a\\udcff µ"


@pytest.mark.parametrize("name", [b"a\xff.yaml", "ünï.yaml".encode()])
@pytest.mark.parametrize("locale", [{"LC_ALL": "C"}, {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}])
def test_commands_in_any_locale(tmp_path, name, locale):
    (tmp_path / os.fsdecode(name)).write_text("base: lift\nframes: 0\n")
    command = [sys.executable, "-m", "diffcloud.cli.app", "simulate", name, "--out", "m.npz", "--json"]
    told = subprocess.run(command, cwd=tmp_path, env=environment() | locale, capture_output=True, timeout=120, check=False)
    assert told.returncode == 1
    text = told.stderr.decode("ascii", errors="replace").strip()
    assert text.startswith("Error: ")
    assert "Traceback" not in text
    assert ("frames: " in text) == (name[:1] != b"a" and "PYTHONUTF8" not in locale)


def test_counts_that_would_take_days_are_refused():
    with pytest.raises(DiffCloudError, match=r"solver\.likelihood\.starts: Input should be less than or equal to 100 "):
        updated(load_config(None).fit, solver={"starts": 100_000})
