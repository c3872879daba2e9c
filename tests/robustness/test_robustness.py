"""A sample of the damaged inputs and of the faults, the same each time; `make robustness` tries all."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.cli.invoke import ROOT, environment
from tests.robustness import damage
from tests.robustness.isolated import read_alone
from tests.robustness.kinds import KINDS


def tried(*arguments: object) -> None:
    command = [sys.executable, "-m", "tests.robustness", *map(str, arguments)]
    done = subprocess.run(command, cwd=ROOT, env=environment(), capture_output=True, text=True, timeout=1500, check=False)
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]


@pytest.mark.longest
def test_a_sample_of_damaged_files_and_a_disturbed_command():
    """One of each kind of file; one disturbance of a command."""
    tried("--only", "inputs", "--only", "faults", "--sample", 1, "--sample-faults", 1, "--command", "fit", "--workers", 2)


@pytest.mark.slow
def test_a_moving_arm_is_stopped_and_what_was_recorded_is_kept():
    tried("--only", "arm", "--sample", 6)


@pytest.mark.slow
class TestTheSuiteItself:
    """It must see what it looks for."""

    def read(self, folder, code: str):
        def run() -> None:
            exec(code, {})

        return read_alone(folder, run)

    def test_verdicts(self, tmp_path):
        refused = "from diffcloud.errors import EpisodeError\nraise EpisodeError('no')"
        assert self.read(tmp_path, "x = 1").verdict == "taken"
        assert self.read(tmp_path, refused).verdict == "refused"
        assert self.read(tmp_path, "1 / 0").verdict == "traceback"
        assert self.read(tmp_path, "import numpy\nx = numpy.ones(2_500_000_000, numpy.int8)").verdict == "memory"
        assert self.read(tmp_path, f"open('left', 'w').write('x')\n{refused}").verdict == "left over"
        assert not list(tmp_path.iterdir())

    def test_a_hang_ends(self, tmp_path, monkeypatch):
        monkeypatch.setattr("tests.robustness.isolated.SECONDS", 0.5)
        assert self.read(tmp_path, "while True: pass").verdict == "hang"

    def test_every_damage_is_made(self):
        told = list(damage.document(b'{"a": 1.5, "b": ["x"], "c": {"d": true}}', ".json"))
        assert {one.field for one in told} == {"a", "b", "b[0]", "c", "c.d"}
        assert {one.damage for one in told} == set(damage.KINDS)
        assert any(b'"a": 1.5, ' in one.data and one.data.count(b'"a"') == 2 for one in told if one.damage == "duplicate")
        assert len({kind.name for kind in KINDS}) == len(KINDS)
