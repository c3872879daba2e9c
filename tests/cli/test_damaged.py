"""Input that is damaged or absurd, through the command line: a named error, nothing written, nothing that hangs."""

from __future__ import annotations

import contextlib
import json
import re
import subprocess
import sys
import tracemalloc
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import diffcloud.cli.app
from diffcloud.errors import EpisodeError, MeshError, SceneError
from diffcloud.io.clouds import import_open3d, read_cloud
from diffcloud.io.files import read_yaml
from diffcloud.io.images import decode_depth
from diffcloud.io.obj import read_surface
from diffcloud.mesh.topology import ClothMesh
from diffcloud.scene.description import Scene
from diffcloud.sensing.validation.episode import validate_raw_episode
from diffcloud.sim.handles import Handles
from diffcloud.sim.materials import Material, preset
from diffcloud.sim.motion import axis_angle_quaternion
from diffcloud.sim.simulate import rollout
from diffcloud.sim.surrounding import Surrounding
from tests.cli.invoke import DIFFCLOUD, environment, invoke
from tests.sensing.table_scene import write_table_episode

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
        assert message in invoke("simulate", "bad.yaml", "--out", "r.npz", code=1).errors
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
        assert "Wrote 4 frames" in invoke("simulate", "small.yaml", "--out", "out[/x].npz").errors
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
            ("zip", 1, b"0 0 0\n", "DATA is zip; allowed are ascii, binary"),
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
    said = invoke("data", "import", "clouds", "--rate-hz", 10, "--out", "e.npz", code=1).errors
    assert "divide millimetres by 1000" in said
    assert not (work / "e.npz").exists()


@pytest.mark.parametrize(
    "command",
    [
        ("simulate", "small.yaml", "--frames", str(10**9), "--out", "r.npz"),
        ("view", "e.npz", "--points", "-3", "--out", "v.html"),
    ],
)
def test_numbers_out_of_range_are_refused_by_name(work, command):
    assert f"Invalid value for '{command[2]}'" in invoke(*command, code=2).errors


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("stretching=0", "must be above 0, got 0; the lowest usual value is 0.4"),
        ("air_density=-100", "must be above 0, got -100"),
        ("body_mass=-1", "body_mass has no effect in small"),
        ("density=1e300", "values from 2e-07 to 200000 are simulated"),
        ("density=1e-300", "values from 2e-07 to 200000 are simulated"),
        ("damping=1e30", "values from 1e-06 to 1e+06 are simulated"),
    ],
)
def test_parameters_that_no_cloth_has_are_refused(work, value, message):
    assert message in invoke("simulate", "small.yaml", "--set", value, "--out", "r.npz", code=1).errors
    assert not (work / "r.npz").exists()


def test_no_frames_are_none_to_fit(work):
    (work / "params.yaml").write_text("fit: {frames: []}\n")
    said = invoke("fit", "--params", "params.yaml", "--scene", "small.yaml", "--out", "f", "e.npz", code=1).errors
    assert "fit.frames: List should have at least 1 item" in said


@pytest.mark.parametrize("kind", ["clouds", "images"])
def test_files_numbered_by_large_numbers_are_refused_and_take_no_memory(work, kind):
    """Two of them are 33 million numbers apart, and no times since 1970 in any unit."""
    stamps = (5_700_000_000_000_000_000, 5_700_000_000_033_000_000)
    if kind == "clouds":
        (work / "clouds").mkdir()
        for stamp in stamps:
            np.save(work / "clouds" / f"{stamp}.npy", np.zeros((5, 3)))
        command = ("data", "import", "clouds", "--rate-hz", 10, "--out", "e.npz")
    else:
        folder = write_table_episode(work / "raw", frames=2) / "cameras" / "side"
        for path, stamp in zip(sorted((folder / "depth").iterdir()), stamps, strict=True):
            path.rename(path.with_name(f"{stamp}.png"))
        command = ("data", "import", f"side={folder}", "--rate-hz", 10, "--out", "e")
    tracemalloc.start()
    assert "are neither frame numbers nor times of a recording" in invoke(*command, code=1).errors
    assert tracemalloc.get_traced_memory()[1] < 100e6
    tracemalloc.stop()


def test_a_png_that_ends_in_its_header_is_refused(tmp_path):
    for length in range(34):
        data = b"\x89PNG\r\n\x1a\n\x00\x00\x00\x0dIHDR\x00\x00\x00\x02\x00\x00\x00\x02\x10\x00\x00\x00\x00"[:length]
        with pytest.raises(EpisodeError, match=r"a\.png"):
            decode_depth(data, "a.png")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scene_in_world": {"origin_m": [float("nan"), 0, 0]}}, "NaN is no number"),
        ({"scene_in_world": {"length_unit_m": 0}}, "length_unit_m: Input should be greater than or equal to 0.001"),
    ],
)
def test_what_preprocess_refuses_is_a_fault_of_the_episode(work, change, message):
    folder = write_table_episode(work / "raw" / "lift" / "one", frames=2)
    (folder / "episode.json").write_text(json.dumps({**json.loads((folder / "episode.json").read_text()), **change}))
    faults = [found.message for found in validate_raw_episode(folder) if found.severity == "fault"]
    assert any(message in fault for fault in faults), faults
    assert message in invoke("data", "preprocess", folder, "--out", "cleaned", code=1).errors


def test_joints_of_another_arm_are_pointed_out(work):
    folder = write_table_episode(work / "raw" / "lift" / "one", frames=2)
    lines = [line.split(",") for line in (folder / "robot.csv").read_text().splitlines()]
    (folder / "robot.csv").write_text("\n".join(",".join(line[:4]) for line in lines) + "\n")
    found = {one.code: one for one in validate_raw_episode(folder)}["joint_count"]
    assert (found.severity, found.message[:29]) == ("fault", "It has 3 joints, the Gen3 7: ")
    with as_file(files("diffcloud.sensing") / "gen3_robotiq_2f_85.urdf") as urdf:
        invoke("data", "check", folder, "--urdf", urdf, code=1)
    (work / "params.yaml").write_text("scenes: [lift]\n")
    assert "joints" in invoke("data", "preprocess", folder, "--params", "params.yaml", "--out", "cleaned", code=1).errors


def test_a_cloth_of_one_face_moves_without_hinges():
    """And falls as all of it falls."""
    nodes, face = np.array([[0.0, 0, 1], [0.1, 0, 1], [0, 0.1, 1]]), np.array([[0, 1, 2]])
    mesh = ClothMesh(nodes, nodes[:, :2], np.arange(3), face)
    assert not len(mesh.hinges.length)
    surrounding = Surrounding(air_density=0.0)
    system = Scene(
        mesh=mesh,
        material=preset("denim"),
        handles=Handles(()),
        surrounding=surrounding,
        frame_time=0.1,
        frame_steps=8,
        integrator="arcsim",
    ).build()[0]
    fallen = rollout(system, 8).positions[0, -1] - torch.as_tensor(mesh.nodes)
    assert fallen[:, 2].numpy() == pytest.approx(np.full(3, -0.5 * 9.81 * 0.1**2), rel=0.15)


class TestUnforeseen:
    """An error that nobody foresaw is a fault of the program: one line, and its traceback in a file."""

    @pytest.fixture
    def told(self, monkeypatch, tmp_path, capsys):
        def run(error, *arguments):
            def fails():
                raise error

            monkeypatch.setattr(diffcloud.cli.app, "app", fails)
            monkeypatch.setattr(diffcloud.cli.app.ctrl_c, "listen", lambda: None)  # it would, for all later tests too
            monkeypatch.setattr(diffcloud.cli.app.tempfile, "tempdir", str(tmp_path))
            monkeypatch.setattr(diffcloud.cli.app.sys, "argv", ["diffcloud", *arguments])
            with pytest.raises(SystemExit) as stopped:
                diffcloud.cli.app.main()
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

    def test_a_ctrl_c_that_python_loses_is_pressed_again(self, tmp_path):
        """It comes in the callback of a weak reference, from which no exception gets out."""
        code = """
import os, signal, time, weakref
import diffcloud.cli.app

class Thing:
    pass

def work():
    thing = Thing()
    weakly = weakref.ref(thing, lambda _: (os.kill(os.getpid(), signal.SIGINT), time.sleep(0.1)))
    del thing
    time.sleep(30)

diffcloud.cli.app.app = work
diffcloud.cli.app.main()
"""
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment(), timeout=25)
        assert (done.returncode, done.stderr.strip()) == (130, "Interrupted.")

    def test_one_within_a_command_is_told_too(self):
        """Of which typer keeps the exit status alone."""
        code = """
import sys
import typer
import diffcloud.cli.app

app = typer.Typer()

@app.command()
def work():
    raise KeyboardInterrupt

diffcloud.cli.app.app = app
sys.argv = ["diffcloud"]
diffcloud.cli.app.main()
"""
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment(), timeout=25)
        assert (done.returncode, done.stderr.strip()) == (130, "Interrupted.")

    def test_a_ctrl_c_while_open3d_is_imported_is_no_missing_library(self, monkeypatch):
        def interrupted():
            try:
                raise KeyboardInterrupt
            except KeyboardInterrupt as pressed:
                raise ImportError("initialization failed") from pressed

        monkeypatch.setattr("diffcloud.io.clouds.load_libusb", interrupted)
        with pytest.raises(KeyboardInterrupt):
            import_open3d()

    @pytest.mark.parametrize("pressed", [True, False])
    def test_a_ctrl_c_that_a_library_turns_into_its_own_error_is_none_of_the_programs_faults(self, pressed):
        """As numpy's comparison of structured arrays does, and numba's calls."""
        code = f"""
import signal
import diffcloud.cli.app

def work():
    try:
        if {pressed}:
            signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        pass
    raise TypeError("Cannot compare structured arrays")

diffcloud.cli.app.app = work
diffcloud.cli.app.main()
"""
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment(), timeout=25)
        assert done.returncode == (130 if pressed else 1)
        assert (done.stderr.strip() == "Interrupted.") == pressed

    def test_debug_stands_before_any_command(self, work):
        done = subprocess.run([*DIFFCLOUD, "--debug", "doctor", "--json"], capture_output=True, text=True, check=True)
        assert "checks" in json.loads(done.stdout.splitlines()[-1])
