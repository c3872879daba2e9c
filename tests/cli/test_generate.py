"""`diffcloud simulate` as a person runs it: outputs, processes, kills, Ctrl-C, bad input."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from diffcloud.cli.app import app
from diffcloud.datasets import CHUNK
from diffcloud.errors import DiffCloudError
from diffcloud.io.simulated import SimulatedSet
from diffcloud.jobs import cluster
from diffcloud.regressors.dataset import Augmentation, CloudDataset
from tests.cli.invoke import DIFFCLOUD, ROOT, environment, run_process, wait_for
from tests.cli.test_commands import SMALL
from tests.datasets.test_simulation import contents

SET = ("network", "generate", "--scene", "small.yaml", "--train", 2 * CHUNK + 8, "--test", 18)
"""Four chunks."""


@pytest.fixture(scope="module")
def work(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("simulate")
    (folder / "small.yaml").write_text(yaml.safe_dump(SMALL))
    return folder


@pytest.fixture(scope="module")
def whole(work) -> Path:
    said = run_process(*SET, "--workers", 0, "--out", "whole", cwd=work)
    assert (said["train"], said["test"], said["resumed"], said["parameters"]) == (
        2 * CHUNK + 8,
        18,
        0,
        ["stretching", "density"],
    )
    assert said["replaced"] == {"train": 0, "test": 0}
    return work / "whole"


def interrupted(work: Path, out: str, how: signal.Signals) -> tuple[int, str]:
    """Start a set in one process and stop it after its first chunk: (exit status, standard error)."""
    env = environment()
    command = [*DIFFCLOUD, *map(str, SET), "--workers", "0", "--out", out]
    process = subprocess.Popen(command, cwd=work, env=env, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    wait_for((work / f"{out}.partial" / "train-000000.npz").exists, process)
    process.send_signal(how)
    _, said = process.communicate(timeout=60)
    assert not (work / out).exists()
    return process.returncode, said


def test_sets_are_read_back(whole):
    simulated = SimulatedSet.read(whole, "test")
    assert simulated.nodes.shape == (18, 6, 25, 3)
    assert ((simulated.parameters >= 0.1) & (simulated.parameters <= 10)).all()
    clouds, parameters = CloudDataset(simulated, Augmentation(), points=100).batch(range(18))
    assert clouds.shape == (18, 1, 100, 3)
    assert parameters.shape == (18, 2)
    assert json.loads((whole / "set.json").read_text())["draws"] == "uniform"


@pytest.mark.slow
def test_processes_give_the_same_bytes(whole, work):
    run_process(*SET, "--workers", 2, "--out", "processes", cwd=work)
    assert contents(work / "processes") == contents(whole)


def test_a_killed_set_ends_with_the_same_bytes(whole, work):
    status, _ = interrupted(work, "killed", signal.SIGKILL)
    assert status == -signal.SIGKILL
    done = run_process(*SET, "--workers", 0, "--out", "killed", cwd=work)
    assert CHUNK <= done["resumed"] < 2 * CHUNK + 26
    assert contents(work / "killed") == contents(whole)
    assert not (work / "killed.partial").exists()


def test_ctrl_c_says_how_to_go_on(work):
    status, said = interrupted(work, "stopped", signal.SIGINT)
    assert status == 130, said
    assert "finished runs are kept in stopped.partial; the same command goes on from there" in said
    assert "Traceback" not in said


def test_settings_come_from_the_parameter_file_and_options_win(work):
    section = {
        "train": 2,
        "test": 5,
        "distribution": "sobol",
        "parameters": ["density", "bending"],
        "scenes": ["small.yaml"],
    }
    (work / "params.yaml").write_text(yaml.safe_dump({"generate": section}))
    done = run_process(
        "network", "generate", "--params", "params.yaml", "--scene", "small.yaml", "--test", 0, "--export-clouds",
        "--uncertain", "air_density=1.3x", "--out", "few", cwd=work,
    )  # fmt: skip
    assert json.loads((work / "few" / "set.json").read_text())["uncertain"] == {"air_density": 1.3}
    assert {key: done[key] for key in ("train", "test", "draws", "parameters")} == {
        "train": 2, "test": 0, "draws": "sobol", "parameters": ["density", "bending"],
    }  # fmt: skip
    assert np.load(work / "few" / "clouds" / "train" / "1" / "005.npy").shape == (200, 3)
    assert SimulatedSet.read(work / "few", "train").names == ("density", "bending")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--parameters", "weight"), "Unknown parameter 'weight'"),
        (("--distribution", "gauss"), "--distribution: must be 'uniform', 'sobol', 'logarithmic' or 'modes' (got 'gauss')"),
        (("--distribution", "modes"), "not for 'small'"),
        (("--uncertain", "stretching=1.5x"), "leave out stretching"),
        (("--uncertain", "air_density=0.5x"), "air_density takes the factor within which it is known"),
        (("--train", "-1"), "train: "),
        (("--train", "0", "--test", "0"), "at least one run"),
        (("--out", "."), "holds something else than a simulated set"),
        (("--scheduler", "tcp://127.0.0.1:1"), "No Dask scheduler answers at tcp://127.0.0.1:1"),
    ],
)
def test_bad_input(work, monkeypatch, arguments, message):
    monkeypatch.chdir(work)
    monkeypatch.setattr(cluster, "_ANSWER_S", 0.5)
    started = ["network", "generate", "--scene", "small.yaml", "--train", "2", "--out", "bad", *arguments]
    done = CliRunner().invoke(app, started)
    assert isinstance(done.exception, DiffCloudError)
    assert message in str(done.exception)
    assert not (work / "bad").exists()
    assert not (work / "bad.partial").exists()
    assert not (work / ".bad.diffcloud-lock").exists()


@pytest.mark.slow
def test_a_cluster_gives_the_same_bytes(whole, work):
    """Slow: starts a scheduler and a worker of its own."""
    code = (
        "import sys, subprocess\n"
        "from distributed import LocalCluster\n"
        "if __name__ == '__main__':\n"
        "    with LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address=None) as cluster:\n"
        "        sys.exit(subprocess.call([*sys.argv[1:], '--scheduler', cluster.scheduler_address]))\n"
    )
    (work / "cluster.py").write_text(code)
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "cluster.py", *DIFFCLOUD, *map(str, SET), "--out", "cluster"]
    done = subprocess.run(command, cwd=work, env=env, capture_output=True, text=True, timeout=180)
    assert done.returncode == 0, done.stderr
    assert contents(work / "cluster") == contents(whole)
