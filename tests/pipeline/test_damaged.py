"""Input that is damaged or absurd, through the command line: a named error, nothing written, nothing that hangs."""

from __future__ import annotations

import contextlib
import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import yaml

import pipeline.app
from diffcloud.errors import EpisodeError, MeshError, SceneError
from diffcloud.io.clouds import read_cloud
from diffcloud.io.files import read_yaml
from diffcloud.io.obj import read_surface
from diffcloud.sim.materials import Material, preset
from diffcloud.sim.motion import axis_angle_quaternion
from tests.pipeline.invoke import DIFFCLOUD, invoke

SMALL = {"base": "lift", "nodes": [4, 4], "frames": 3, "steps_per_frame": 1}


@pytest.fixture
def work(tmp_path):
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(SMALL))
    with contextlib.chdir(tmp_path):
        yield tmp_path


class TestScenarios:
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"base": ["lift"]}, "Unknown base"),
            ({"frames": 10**11}, "frames: Input should be less than or equal to 100000"),
            ({"steps_per_frame": 10**9}, "steps_per_frame"),
            ({"nodes": [100_000, 100_000]}, "nodes.0: Input should be less than or equal to 500"),
            ({"points": 10**9}, "points"),
            ({"path": [[0, 0, 0, 0], [1e300, 0, 0, 1]]}, "path"),
            ({"path": [[0, 0, 0, 0], [1, 0, 0, 1e300]]}, "path"),
            ({"center_m": [1e12, 0]}, "center_m"),
        ],
    )
    def test_absurd_values_are_named(self, work, changes, message):
        (work / "bad.yaml").write_text(yaml.safe_dump(SMALL | changes))
        assert message in invoke("rollout", "--scenario", "bad.yaml", "--out", "r.npz", code=1).errors
        assert not (work / "r.npz").exists()

    def test_anchors_that_stand_for_billions_are_refused(self, tmp_path):
        lines, last = ["a: &a [x, x, x, x, x, x, x, x, x]"], "a"
        for name in "bcdefghijk":
            lines.append(f"{name}: &{name} [{', '.join([f'*{last}'] * 9)}]")
            last = name
        (tmp_path / "bomb.yaml").write_text("\n".join(lines))
        with pytest.raises(SceneError, match="stands for more than 100000 values"):
            read_yaml(tmp_path / "bomb.yaml", error=SceneError)
        (tmp_path / "fine.yaml").write_text("a: &a [1, 2]\nb: *a\nc: {<<: {d: 1}, e: *a}\n")
        assert read_yaml(tmp_path / "fine.yaml") == {"a": [1, 2], "b": [1, 2], "c": {"d": 1, "e": [1, 2]}}
        (tmp_path / "empty.yaml").write_text("")
        assert read_yaml(tmp_path / "empty.yaml") is None

    def test_names_with_brackets_are_only_names(self, work):
        assert "Wrote 4 frames" in invoke("rollout", "--scenario", "small.yaml", "--out", "out[/x].npz").errors
        assert (work / "out[" / "x].npz").exists()


class TestScenes:
    def test_a_negative_table_is_refused(self):
        denim = preset("denim")
        for stretching, bending in ((-denim.stretching, denim.bending), (denim.stretching, -denim.bending)):
            with pytest.raises(SceneError, match="must not be negative"):
                Material("m", 0.2, stretching, bending)
        coupled = denim.stretching.copy()
        coupled[1:, [1, 3]] *= -1  # as measured tables have them
        assert Material("m", 0.2, coupled, denim.bending).name == "m"

    def test_a_rotation_about_no_axis_is_refused(self):
        assert axis_angle_quaternion(0.0, (0.0, 0.0, 0.0)) == (1.0, 0.0, 0.0, 0.0)
        with pytest.raises(SceneError, match="give an axis that is not zero"):
            axis_angle_quaternion(30.0, (0.0, 0.0, 0.0))

    def test_a_face_of_thousands_of_corners_is_refused(self, tmp_path):
        corners = [f"v {np.cos(t)} {np.sin(t)} 0" for t in np.linspace(0, 6, 2000)]
        face = "f " + " ".join(str(number + 1) for number in range(2000))
        (tmp_path / "disk.obj").write_text("\n".join([*corners, face]) + "\n")
        with pytest.raises(MeshError, match="line 2001: a face has at most 100 corners"):
            read_surface(tmp_path / "disk.obj")


class TestPcd:
    HEADER = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA {kind}\n"

    @pytest.mark.parametrize(
        ("kind", "count", "body", "message"),
        [
            ("ascii", 3, b"0.1 0.2 0.3\nfoo bar baz\n0.4 0.5 0.6\n", "numbers, as many in each line"),
            ("ascii", 3, b"0.1 0.2 0.3\n0.4 0.5 0.6\n", "states 3 points and holds 2"),
            ("binary", 10**9, b"abc", "states 1000000000 points"),
            ("binary_compressed", 10**9, b"abc" * 100, "states 1000000000 points"),
            ("binary", -1, b"abc", "states -1 points"),
            ("zip", 1, b"0 0 0\n", "hold 0 at most"),
        ],
    )
    def test_what_cannot_be_in_the_file_is_refused(self, tmp_path, kind, count, body, message):
        (tmp_path / "a.pcd").write_bytes(self.HEADER.format(n=count, kind=kind).encode() + body)
        with pytest.raises(EpisodeError, match=message):
            read_cloud(tmp_path / "a.pcd")

    @pytest.mark.parametrize(
        "text", [b"", b"\x00" * 100_000, b"FIELDS x y z\nDATA ascii\n1 2 3\n", b"POINTS x\nDATA ascii\n"]
    )
    def test_a_damaged_header_is_named(self, tmp_path, text):
        (tmp_path / "a.pcd").write_bytes(text)
        with pytest.raises(EpisodeError, match="header"):
            read_cloud(tmp_path / "a.pcd")


def test_clouds_in_millimetres_are_refused(work, rng):
    (work / "clouds").mkdir()
    for index in range(3):
        np.save(work / "clouds" / f"{index:03d}.npy", rng.uniform(100, 900, (50, 3)))
    said = invoke("import", "clouds", "clouds", "--rate-hz", 10, "--out", "e.npz", code=1).errors
    assert "divide millimetres by 1000" in said
    assert not (work / "e.npz").exists()


@pytest.mark.parametrize(
    "command",
    [
        ("fit", "--seed", "-3", "--scenario", "small.yaml", "--out", "f", "e.npz"),
        ("coverage", "--seed", "-3", "--scenario", "lift", "--out", "f"),
        ("train", "--seed", "-3", "--scenario", "lift", "--out", "f", "d"),
        ("rollout", "--frames", str(10**9), "--scenario", "small.yaml", "--out", "r.npz"),
    ],
)
def test_numbers_out_of_range_are_refused_by_name(work, command):
    assert f"Invalid value for '{command[1]}'" in invoke(*command, code=2).errors


class TestUnforeseen:
    """An error that nobody foresaw is a fault of the program: one line, and its traceback in a file."""

    @pytest.fixture
    def told(self, monkeypatch, tmp_path, capsys):
        def run(error, *arguments):
            def fails():
                raise error

            monkeypatch.setattr(pipeline.app, "app", fails)
            monkeypatch.setattr(pipeline.app.tempfile, "tempdir", str(tmp_path))
            monkeypatch.setattr(pipeline.app.sys, "argv", ["diffcloud", *arguments])
            with pytest.raises(SystemExit) as stopped:
                pipeline.app.main()
            assert stopped.value.code == 1
            return " ".join(capsys.readouterr().err.split())

        return run

    def test_ends_in_one_line_and_a_log(self, told):
        said = told(KeyError("status"), "fit", "two words")
        assert "Unexpected error (KeyError: 'status')" in said
        assert "Traceback" not in said
        log = Path(re.search(r"traceback is in (\S+\.log);", said)[1]).read_text()
        assert "diffcloud fit 'two words'" in log
        assert "KeyError: 'status'" in log
        assert "Traceback" in log

    def test_too_little_memory_says_what_to_try(self, told):
        assert "Out of memory (MemoryError: 67 GiB). Try fewer" in told(MemoryError("67 GiB"))

    def test_debug_shows_it(self, told):
        with pytest.raises(KeyError):
            told(KeyError("status"), "--debug", "fit")

    def test_debug_stands_before_any_command(self, work):
        done = subprocess.run([*DIFFCLOUD, "--debug", "materials", "--json"], capture_output=True, text=True, check=True)
        assert "denim" in json.loads(done.stdout.splitlines()[-1])
