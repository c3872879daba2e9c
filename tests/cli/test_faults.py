"""What kills, full disks, two commands at once and foreign files do: nothing is lost, nothing looks whole that is not, and
the same command again ends with the bytes of an undisturbed one."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest
import yaml

from diffcloud.io.episodes import write_episode
from diffcloud.io.simulated import write_simulated
from tests.cli.invoke import environment, invoke, program, run_process, wait_for
from tests.cli.test_commands import SMALL
from tests.conftest import small_lift
from tests.estimation.test_fit import clouds_of
from tests.regressors.simulated import sagging_sheet

ALONE = ("--params", "params.yaml", "--workers", 1)
FIT = ("pipeline.fit", *ALONE, "--out", "data/fits", "data/episodes")
SET = ("network", "generate", "--scene", "small", "--train", 40, "--test", 34)
TRAIN = ("network", "train", *ALONE, "--scene", "small", "--model", "mlp", "--data", "sim", "--out", "networks")

DIES = (
    "import contextlib, os, sys\n"
    "from diffcloud.io import files\n"
    "name, sys.argv[1:] = sys.argv[1], sys.argv[2:]\n"
    "opened = files._opened_alone\n"
    "@contextlib.contextmanager\n"
    "def watched(path, temporary):\n"
    "    with opened(path, temporary) as stream:\n"
    "        if path.name == name:\n"
    "            stream.write(b'half')\n"
    "            stream.flush()\n"
    "            os.kill(os.getpid(), 9)\n"
    "        yield stream\n"
    "files._opened_alone = watched\n"
    "from tests.cli.invoke import main\n"
    "main()\n"
)
"""A command that is killed in the middle of writing a file of this name."""
FULL = (
    "import resource, signal, sys\n"
    "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
    "from tests.cli.invoke import main\n"
    "resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]),) * 2)\n"
    "sys.argv[1:] = sys.argv[2:]\n"
    "main()\n"
)
"""A command whose files cannot grow beyond so many bytes, as on a disk that is full by then."""


@pytest.fixture
def work(tmp_path, monkeypatch):
    """Two recordings of a small lift in a tree, as the pipeline has it, and their clouds as files."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "raw" / "scenes").mkdir(parents=True)
    (tmp_path / "raw" / "scenes" / "small.yaml").write_text(yaml.safe_dump(SMALL))
    params = {
        "scenes": ["small"],
        "preprocess": {"outlier_neighbours": 5},
        "train": {"profile": "quick", "epochs": 2, "points": 24},
        "fit": {"solver": {"max_steps": 1}},
    }
    (tmp_path / "params.yaml").write_text(yaml.safe_dump(params))
    (tmp_path / "joint.yaml").write_text(yaml.safe_dump({**params, "fit": {**params["fit"], "joint": True}}))
    for number in (1, 2):
        episode = clouds_of(small_lift(), stretching=0.7 * number, density=1.0)
        write_episode(tmp_path / "data" / "episodes" / "small" / f"e{number}.npz", episode)
    (tmp_path / "clouds").mkdir()
    for index in range(episode.frame_count):
        np.savetxt(tmp_path / "clouds" / f"{index:03d}.xyz", episode.frame(index))
    return tmp_path


def run_code(code: str, *arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    env = environment()
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, timeout=120)


def contents(folder: Path) -> dict[str, bytes]:
    """File -> bytes, without what tells seconds."""
    found: dict[str, bytes] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and not name.endswith(".timings.json"):
            found[name] = path.read_bytes()
    return found


def hidden(folder: Path) -> list[Path]:
    return [path for path in folder.rglob(".*") if not path.name.endswith(".timings.json")]


class TestKilledWhileWriting:
    """By SIGKILL, in the middle of a file."""

    COMMANDS = (
        ("e2.npz", ("data", "preprocess", *ALONE, "--out", "out", "data/episodes")),
        ("e2.npz", ("pipeline.fit", *ALONE, "--out", "out", "data/episodes")),
        ("e2.json", ("pipeline.fit", *ALONE, "--out", "out", "data/episodes")),
        ("train-000000.npz", (*SET, "--workers", 0, "--out", "out")),
        ("test_nodes.npy", (*SET, "--workers", 0, "--out", "out")),
        ("set.json", (*SET, "--workers", 0, "--out", "out")),
        ("out.npz", ("data", "import", "clouds", "--rate-hz", 10, "--out", "out/out.npz")),
        ("out.npz", ("simulate", "small", "--out", "out/out.npz")),
        ("003.obj", ("simulate", "small", "--format", "obj", "--out", "out")),
    )

    @pytest.mark.parametrize(("file", "command"), COMMANDS, ids=lambda value: value if isinstance(value, str) else value[0])
    def test_the_same_command_again_ends_with_the_same_bytes(self, work, file, command):
        invoke(*command)
        undisturbed = contents(work / "out")
        (work / "out").rename(work / "whole")
        done = run_code(DIES, file, *command, cwd=work)
        assert done.returncode == -signal.SIGKILL, done.stderr
        assert hidden(work)
        left = {name for name in contents(work / "out") if not Path(name).name.startswith(".")}
        assert left < set(undisturbed)
        assert not [path for folder in ("out", "out.partial") for path in (work / folder).rglob(file)]
        invoke(*command)
        assert contents(work / "out") == undisturbed
        assert hidden(work) == []
        assert not (work / "out.partial").exists()

    def test_what_is_left_is_not_taken_for_an_episode(self, work):
        """A killed `preprocess` leaves half a file, and macOS files of its own, beside the episodes."""
        run_code(DIES, "e2.npz", "data", "preprocess", *ALONE, "--out", "clean", "data/episodes", cwd=work)
        (work / "clean" / "small" / "._e1.npz").write_bytes(b"macOS")
        assert len(hidden(work / "clean")) == 2
        done = invoke("pipeline.fit", *ALONE, "--out", "fits", "clean")
        assert set(done.result["fits"]) == {"small/e1"}


class TestFullDisk:
    @pytest.mark.slow
    @pytest.mark.parametrize("limit", [300, 30_000])
    def test_a_training_leaves_all_or_nothing(self, work, limit):
        sets = {"train": sagging_sheet(24, scenario="small"), "test": sagging_sheet(10, seed=1, scenario="small")}
        write_simulated(work / "sim", sets, about={}, replaced="")
        done = run_code(FULL, limit, *TRAIN, cwd=work)
        assert done.returncode == 1, done.stderr
        assert "Traceback" not in done.stderr
        assert "Cannot write" in done.stderr
        assert "File too large" in done.stderr
        for name in ("mlp.safetensors", ".mlp.timings.json", "mlp/training.json"):
            assert not (work / "networks" / name).exists()
        invoke(*TRAIN)
        again = contents(work / "networks")
        (work / "networks").rename(work / "first")
        invoke(*TRAIN)
        assert contents(work / "networks") == again

    @pytest.mark.slow
    @pytest.mark.parametrize("command", [FIT, (*SET, "--workers", 0, "--out", "set")], ids=["fit", "simulate"])
    def test_others_say_so_and_go_on_later(self, work, command):
        done = run_code(FULL, 1000, *command, cwd=work)
        assert done.returncode == 1
        assert "Cannot write" in done.stderr
        assert "Traceback" not in done.stderr
        assert hidden(work) == []
        invoke(*command)


class TestTwoAtOnce:
    @pytest.mark.parametrize(
        "command",
        [(*SET, "--workers", 0, "--out", "out"), ("pipeline.fit", *ALONE, "--out", "out", "data/episodes")],
    )
    def test_the_second_is_told_of_the_first_which_ends_as_if_alone(self, work, command):
        invoke(*command)
        undisturbed = contents(work / "out")
        (work / "out").rename(work / "whole")
        env = environment()
        with subprocess.Popen(program(*command), cwd=work, env=env, stderr=subprocess.PIPE, text=True) as first:
            lock = work / ".out.diffcloud-lock"
            wait_for(lambda: lock.exists() and lock.stat().st_size, first)
            # held still, so that the second comes in the middle however slow the machine is
            first.send_signal(signal.SIGSTOP)
            done = invoke(*command, code=1)
            first.send_signal(signal.SIGCONT)
            _, said = first.communicate(timeout=120)
        assert first.returncode == 0, said
        assert f"is being written by process {first.pid} " in done.errors
        assert command[0].removeprefix("pipeline.") in done.errors
        assert contents(work / "out") == undisturbed
        assert hidden(work) == []


class TestLostWorkers:
    @pytest.mark.slow
    def test_dask_workers_that_are_killed_are_an_error_with_a_name(self, work):
        invoke(*SET, "--workers", 0, "--out", "out")
        undisturbed = contents(work / "out")
        env = environment()
        command = program(*SET, "--workers", "2", "--out", "killed")
        process = subprocess.Popen(command, cwd=work, env=env, stderr=subprocess.PIPE, text=True, start_new_session=True)
        for worker in wait_for(lambda: _workers_of(process.pid), process):
            worker.kill()
        _, said = process.communicate(timeout=120)
        assert "Traceback" not in said
        if process.returncode:  # else Dask started others in time
            assert process.returncode == 1
            assert "Worker processes ended without a word" in said
        run_process(*SET, "--workers", 2, "--out", "killed", cwd=work)
        assert contents(work / "killed") == undisturbed


def _workers_of(pid: int) -> list[psutil.Process]:
    """Processes that multiprocessing has started for a process."""
    try:
        children = psutil.Process(pid).children(recursive=True)
        return [child for child in children if any("spawn_main" in word for word in child.cmdline())]
    except psutil.Error:
        return []


class TestOnlyOwnFilesAreRemoved:
    def test_single_fits_stay_beside_a_joint_one(self, work):
        single = set(invoke(*FIT).result["fits"])
        assert single == {"small/e1", "small/e2"}
        before = contents(work / "data" / "fits" / "small")
        done = invoke(*FIT, "--params", "joint.yaml")
        after = contents(work / "data" / "fits" / "small")
        assert before == after
        assert (work / "data/fits/joint.json").exists()
        assert "Removed" not in done.errors
        invoke(*FIT)
        assert (work / "data/fits/joint.npz").exists()

    def test_fits_whose_episode_is_gone_go_and_others_stay(self, work):
        invoke(*FIT)
        invoke(*FIT, "--params", "joint.yaml")
        folder = work / "data" / "fits" / "small"
        (folder / "mine.json").write_text((folder / "e1.json").read_text())  # not from this command
        (folder / "notes.txt").write_text("mine")
        (work / "data" / "episodes" / "small" / "e2.npz").unlink()
        done = invoke(*FIT)
        told = "Removed fits whose episode is gone or whose settings have changed: joint.json, joint.npz, small/e2.json"
        assert told in done.errors
        names = [".e1.timings.json", "e1.json", "e1.npz", "mine.json", "notes.txt"]
        assert sorted(path.name for path in folder.iterdir()) == names

    def test_a_foreign_folder_in_the_place_of_a_sets_work_is_kept(self, work):
        (work / "out.partial").mkdir()
        (work / "out.partial" / "thesis.txt").write_text("three years")
        done = invoke(*SET, "--workers", 0, "--out", "out", code=1)
        assert "out.partial, where finished runs would be kept, holds something else" in done.errors
        assert (work / "out.partial" / "thesis.txt").read_text() == "three years"
        assert not (work / "out").exists()

    def test_files_beside_a_set_and_its_work_stay(self, work):
        invoke(*SET, "--workers", 0, "--export-clouds", "--out", "out")
        (work / "out" / "notes.txt").write_text("mine")
        (work / "out" / "clouds" / "train" / "0" / "notes.txt").write_text("mine")
        done = run_code(DIES, "train-000032.npz", *SET, "--seed", 1, "--workers", 0, "--out", "out", cwd=work)
        assert done.returncode == -signal.SIGKILL
        (work / "out.partial" / "notes.txt").write_text("mine")
        invoke(*SET, "--seed", 2, "--workers", 0, "--out", "out")
        assert sorted(path.name for path in (work / "out").iterdir()) == [
            "clouds", "notes.txt", "replaced.csv", "set.json", "surface.npz",
            "test.csv", "test_nodes.npy", "train.csv", "train_nodes.npy",
        ]  # fmt: skip
        left = [
            path.relative_to(work / "out").as_posix() for path in (work / "out" / "clouds").rglob("*") if path.is_file()
        ]
        assert left == ["clouds/train/0/notes.txt"]
        assert [path.name for path in (work / "out.partial").iterdir()] == ["notes.txt"]


class TestOutputFiles:
    def test_a_missing_suffix_is_added_and_said(self, work):
        (work / "towel").write_text("an older file")
        done = invoke("data", "import", "clouds", "--rate-hz", 10, "--out", "towel")
        assert "writing to towel.npz" in done.errors
        assert "to towel.npz." in done.errors
        assert done.result["out"] == "towel.npz"
        assert (work / "towel").read_text() == "an older file"
        known = ("--scene", "small", "--max-steps", 1, "--starts", 1)
        assert invoke("fit", *known, "--out", "fits", "towel.npz").result["rms_mm"] > 0

    @pytest.mark.parametrize("out", ["towel.ply", "towel.tar.gz", "clouds"])
    def test_another_suffix_and_folders_are_refused(self, work, out):
        done = invoke("data", "import", "clouds", "--rate-hz", 10, "--out", out, code=1)
        assert "--out takes a .npz file" in done.errors
        done = invoke("simulate", "small", "--out", out, code=1)
        assert "--out takes a .npz file" in done.errors
        assert sorted(path.name for path in work.iterdir()) == ["clouds", "data", "joint.yaml", "params.yaml", "raw"]
