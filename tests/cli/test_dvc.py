"""The pipeline as users of DVC expect it: recordings that are added, what is ignored, whose code runs."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from diffcloud.io.episodes import Episode, write_episode
from diffcloud.io.timings import read_seconds, read_timings, timings_path, write_timings
from tests.cli.invoke import ROOT, environment


def told(folder: Path, *words: str) -> str:
    """What a program said, on both channels."""
    done = subprocess.run(words, cwd=folder, env=environment(), capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def dvc(folder: Path, *words: str) -> str:
    return told(folder, sys.executable, "-m", "dvc", *words)


def clouds(path: Path, seed: int) -> None:
    frames = list(np.random.default_rng(seed).uniform(0, 0.3, (2, 100, 3)))
    write_episode(path, Episode.from_frames(frames, np.array([0.0, 0.1])))


@pytest.fixture
def project(tmp_path) -> Path:
    """A repository with the settings of this one for git and DVC, its stage `preprocess`, and a recording."""
    for name in (".gitignore", ".dvcignore", ".dvc/config", "raw/README.md"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    stage = yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"]["preprocess"]
    stage["deps"] = [name for name in stage["deps"] if not name.startswith(("diffcloud", "pipeline"))]
    (tmp_path / "dvc.yaml").write_text(yaml.safe_dump({"stages": {"preprocess": stage}}))
    (tmp_path / "params.yaml").write_text(yaml.safe_dump({"scenes": ["lift"], "preprocess": {"points": 50}}))
    clouds(tmp_path / "data/recorded/lift/hidden1.npz", 1)
    told(tmp_path, "git", "init", "--quiet")
    return tmp_path


@pytest.mark.slow
def test_an_added_recording_makes_its_stage_stale_and_is_all_that_is_done(project):
    assert "Cleaned 1 episodes" in dvc(project, "repro")
    assert "up to date" in dvc(project, "status")
    told(project, "git", "add", "--all")
    (project / "raw/README.md").write_text("Other words.")
    assert "up to date" in dvc(project, "status")
    clouds(project / "raw/lift/my_recording.npz", 2)
    assert "?? " not in told(project, "git", "status", "--short")  # no recording gets into git by itself
    dvc(project, "add", "raw/lift/my_recording.npz")
    told(project, "git", "add", "--all")
    names = told(project, "git", "ls-files", "raw").split()
    assert "raw/lift/my_recording.npz.dvc" in names
    assert not any(name.endswith(".npz") for name in names)
    assert "preprocess" in dvc(project, "status")
    assert "Cleaned 1 episodes into data/episodes; 1 were finished already." in dvc(project, "repro")
    assert {path.name for path in (project / "data/episodes/lift").iterdir()} == {"hidden1.npz", "my_recording.npz"}


@pytest.mark.slow
def test_a_raw_recording_can_be_added(project):
    (project / "raw/my_recording").mkdir()
    (project / "raw/my_recording/episode.json").write_text("{}")
    dvc(project, "add", "raw/my_recording")
    told(project, "git", "add", "--all")
    assert "raw/my_recording.dvc" in told(project, "git", "ls-files", "raw").split()
    assert "raw/my_recording/episode.json" not in told(project, "git", "ls-files", "raw").split()


@pytest.mark.slow
def test_wall_times_are_no_part_of_an_output(project):
    dvc(project, "repro")
    write_timings(project / "data/episodes/lift/hidden1.json", 3.0)
    write_timings(project / "data/recorded/lift", 3.0)
    assert "up to date" in dvc(project, "status")


def test_wall_times_lie_beside_a_result_and_may_be_missing(tmp_path):
    for name, expected in (
        ("e1.json", ".e1.timings.json"), ("mlp.safetensors", ".mlp.timings.json"), ("set.2", ".set.2.timings.json")
    ):  # fmt: skip
        result = tmp_path / name
        assert timings_path(result) == tmp_path / expected
        assert read_seconds(result) is None
        write_timings(result, 2.5, resumed=3)
        assert read_seconds(result) == 2.5
        assert read_timings(result)["resumed"] == 3
    for damage in ("{", "[]", '{"seconds": "long"}', '{"seconds": -1}', '{"seconds": true}'):
        timings_path(tmp_path / "e1.json").write_text(damage)
        assert read_seconds(tmp_path / "e1.json") is None


def test_a_command_and_its_workers_run_the_code_of_the_current_folder(tmp_path):
    """Whatever `diffcloud` is installed, here by PYTHONPATH."""
    leave_out = shutil.ignore_patterns("__pycache__")
    for name in ("diffcloud", "pipeline"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=leave_out)
    (tmp_path / "diffcloud/cli/whose.py").write_text(
        "from dataclasses import dataclass\n"
        "import diffcloud, pipeline\n"
        "@dataclass(frozen=True)\n"
        "class Whose:\n"
        "    label: str\n"
        "    def run(self, tell):\n"
        "        return diffcloud.__file__, pipeline.__file__\n"
    )
    (tmp_path / "pipeline/__main__.py").write_text(
        "import json\n"
        "from diffcloud.jobs.fork_server import begin_importing\n"
        "from diffcloud.cli.whose import Whose\n"
        "from diffcloud.jobs.pool import run_all\n"
        "if __name__ == '__main__':\n"
        "    begin_importing('diffcloud.cli.whose', ['fit', '--workers', '2'])\n"
        "    jobs = [Whose('here'), *[Whose('there')] * 3]\n"
        "    found = [jobs[0].run(None), *(place for _, place, _ in run_all('whose', jobs, 2))]\n"
        "    print(json.dumps(found))\n"
    )
    printed = told(tmp_path, sys.executable, "-m", "pipeline")
    expected = [str(tmp_path / name / "__init__.py") for name in ("diffcloud", "pipeline")]
    assert json.loads(printed) == [expected] * 5  # nothing else, such as a warning of a worker's
