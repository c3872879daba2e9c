"""Commands as a person runs them: outputs, --json, exit status, bad input that leaves nothing behind."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from diffcloud.estimation import task
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.pose import NUISANCE
from diffcloud.estimation.record import read_fit
from diffcloud.estimation.result import describe_recording
from diffcloud.estimation.settings import FitSettings
from diffcloud.io.episodes import Episode, read_episode, write_episode
from diffcloud.io.obj import read_cloth, read_surface
from diffcloud.io.timings import read_seconds
from diffcloud.jobs.scenarios import scene_named
from diffcloud.scene.scenarios import load_scenario
from diffcloud.sensing.cameras import inverse, looking_at, transform
from diffcloud.sim.properties import one_set
from tests.arcsim.files import MESHES, over_moving_box, write_file, write_files
from tests.cli.invoke import DIFFCLOUD, ROOT, Invoked, environment, invoke, stage, study, wait_for
from tests.conftest import small_lift
from tests.estimation.test_fit import clouds_of

SMALL = {
    "base": "lift",
    "nodes": [5, 5],
    "grip": "pivot",
    "grip_m": 0.0131,
    "frames": 5,
    "steps_per_frame": 2,
    "points": 200,
    "path": [[0, 0, 0, 0], [0.5, 0, -0.05, 0.15]],
}


def run(*arguments: object, cwd: Path, code: int = 0) -> Invoked:
    with contextlib.chdir(cwd):
        return invoke(*arguments, code=code)


@pytest.fixture
def work(tmp_path):
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(SMALL))
    write_episode(tmp_path / "e1.npz", clouds_of(small_lift(), stretching=0.7, density=1.0))
    return tmp_path


def staged(name: str, *arguments: object, cwd: Path, code: int = 0) -> Invoked:
    with contextlib.chdir(cwd):
        return stage(name, *arguments, code=code)


def measured(scene: Path, episode: Path, values: dict[str, float]) -> float:
    """The loss of these parameters, by the measure of a fit with default settings."""
    objective = Objective(load_scenario(str(scene)), read_episode(episode), **FitSettings().measure())
    with torch.no_grad():
        return describe_recording(objective, objective.simulate_to_loss(one_set(values)), episode.stem).loss


def test_simulate_writes_the_contract_and_meshes(work):
    command = ("simulate", "small.yaml", "--set", "stretching=2", "--set", "density=1", "--frames", 3)
    done = run(*command, "--out", "run.npz", cwd=work)
    with np.load(work / "run.npz") as data:
        assert data["nodes"].shape == (4, 25, 3)
        assert data["nodes"].dtype == np.float64
        assert data["faces"].dtype == np.int64
        assert data["times"].tolist() == pytest.approx([0, 0.1, 0.2, 0.3])
        last = data["nodes"][-1]
    assert done.result["parameters"] == {"stretching": 2.0, "density": 1.0}
    for kind in ("obj", "ply"):
        run(*command, "--out", kind, "--format", kind, cwd=work)
    np.testing.assert_array_equal(read_cloth(work / "obj" / "003.obj").nodes, last)
    assert len(list((work / "ply").glob("*.ply"))) == 4
    assert "give --out motion.npz" in run(*command, cwd=work, code=1).errors
    assert "writes a folder" in run(*command, "--out", "run.npz", "--format", "obj", cwd=work, code=1).errors


def test_a_cloth_that_lies_askew_is_replayed_as_it_lay(work):
    write_episode(work / "askew.npz", clouds_of(small_lift(), stretching=0.7, density=1.0, turn=0.2, shape_1_1=0.01))
    told = ("--scene", "small.yaml", "--fix", "density=0.2", "--initial-state", "turn=10deg,shape=1cm", "--starts", 1)
    run("fit", *told, "--out", "fits", "askew.npz", cwd=work)
    record = read_fit(work / "fits" / "fit.json")
    assert sum(record.nuisance[name].value for name in ("turn", "yaw")) == pytest.approx(0.2, abs=0.05)
    run("simulate", "fits/fit.json", "--track", "askew.npz", "--out", "r.npz", cwd=work)
    with np.load(work / "r.npz") as found, np.load(work / "fits" / "fit.npz") as fitted:
        np.testing.assert_allclose(found["nodes"][0], fitted["nodes"][0], atol=1e-12)
        assert np.ptp(found["nodes"][0, :, 2]) > 0.003
    assert {"turn", "shape"} <= set(json.loads((work / "fits" / "intervals.json").read_text())["sources"])


def test_options_add_to_what_the_parameters_file_gives(work):
    (work / "params.yaml").write_text(
        "fit: {fixed: {bending: 8.0e-6, density: 0.6}, bounds: {stretching: [1.0, 20.0], density: [0.1, 0.4]}, "
        "solver: {starts: 2, model_error: false}}"
    )
    told = ("--scene", "small.yaml", "--params", "params.yaml", "--max-steps", 1, "--out", "fits", "e1.npz")
    run("fit", *told, "--fix", "density=0.2", "--bound", "density=0.18:0.22", cwd=work)
    record = read_fit(work / "fits" / "fit.json")
    assert (record.parameters["bending"].value, record.parameters["density"].value) == pytest.approx((8e-6, 0.2))
    assert record.parameters["stretching"].bounds == pytest.approx((1.0, 20.0))
    settings = {"starts": 2, "model_error": False, "max_steps": 1}
    assert settings.items() <= record.settings.items()
    other = run("fit", *told, "--solver", "adam", cwd=work).errors
    assert "adam has no model_error, which --params states for likelihood" in other
    assert read_fit(work / "fits" / "fit.json").settings["starts"] == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--fix", "density=heavy"), "--fix density: must be a number"),
        (("--fix", "density"), "--fix takes NAME=VALUE, got 'density'"),
        (("--bound", "density=3:1"), "--bound density must be in order (low < high), got [3.0, 1.0]"),
        (("--bound", "density=low:2"), "--bound density.0: must be a number"),
        (("--level", 2), "--level: must be less than or equal to 0.999"),
        (("--max-steps", 0), "--max-steps: must be greater than or equal to 1"),
        (("--solver", "lbfgs"), "--solver: unknown solver 'lbfgs'; allowed are likelihood, adam"),
        (("--frames", "first"), "--frames 0: must be a number"),
    ],
)
def test_an_option_that_cannot_be_is_named(work, options, message):
    done = run("fit", "--scene", "small.yaml", "--out", "fits", *options, "e1.npz", cwd=work, code=1)
    assert message in done.errors
    assert not (work / "fits").exists()


def test_fit_then_replay_and_measure(work):
    done = run(
        "fit", "--scene", "small.yaml", "--out", "fits", "--max-steps", 3, "--starts", 2, "--fix", "density=0.2",
        "--initial-state", "none", "e1.npz", cwd=work,
    )  # fmt: skip
    summary = json.loads((work / "fits" / "fit.json").read_text())
    assert done.result["rms_mm"] == summary["rms_mm"]
    assert {"loss", "loss_start", "iterations", "stop_reason", "parameters"} <= set(summary)
    assert not {"seconds", "versions"} & set(summary)  # they differ from run to run and lie beside it
    assert {"value", "unit"} <= set(summary["parameters"]["stretching"])
    values = {name: entry["multiplier"] for name, entry in summary["parameters"].items()}
    assert values.keys() > {"stretching", "density", "bending"}  # what is not known exactly was fitted too
    again = measured(work / "small.yaml", work / "e1.npz", values)
    assert again == pytest.approx(summary["loss"], rel=1e-9)  # same metric, same points
    assert measured(work / "small.yaml", work / "e1.npz", {**values, "density": 2.0}) > again
    run("simulate", "fits/fit.json", "--track", "e1.npz", "--out", "r.npz", cwd=work)
    with np.load(work / "r.npz") as replay, np.load(work / "fits" / "fit.npz") as fitted:
        np.testing.assert_allclose(replay["nodes"], fitted["nodes"], atol=1e-12)


@pytest.mark.parametrize("solver", ["cma_es", "random_search"])
def test_a_fit_by_a_search(work, solver):
    (work / "params.yaml").write_text(yaml.safe_dump({"fit": {"solver": {"name": solver, "max_simulations": 12}}}))
    command = ("fit", "--scene", "small.yaml", "--out", "fits", "--params", "params.yaml")
    done = run(*command, "--init", "stretching=8,density=0.2", "e1.npz", cwd=work)
    summary = json.loads((work / "fits" / "fit.json").read_text())
    assert (summary["solver"], summary["simulations"], summary["stop_reason"]) == (solver, 12, "simulations")
    assert summary["start"] == {"stretching": 2.0, "density": 1.0}
    assert summary["loss"] <= summary["loss_start"]
    assert f"There are no intervals: the solver {solver} gives none" in done.errors
    assert not (work / "fits" / "intervals.json").exists()
    for options in (("--starts", 2), ("--max-steps", 3)):
        assert options[0] in run(*command, *options, "e1.npz", cwd=work, code=1).errors


def test_each_recording_alone(work):
    write_episode(work / "e2.npz", clouds_of(small_lift(), stretching=1.4, density=1.0))
    command = ("fit", "--scene", "small.yaml", "--out", "fits", "--max-steps", 1, "--starts", 1)
    done = run(*command, "--separate", "e1.npz", "e2.npz", cwd=work)
    assert set(done.result) == {"e1", "e2"}
    assert [len(read_fit(work / "fits" / name / "fit.json").episodes) for name in ("e1", "e2")] == [1, 1]


def test_recordings_alone_may_have_a_dot_in_their_names(work):
    """Of a folder, all of the name counts."""
    episode = read_episode(work / "e1.npz")
    for name in ("run.1", "run.2"):
        (work / name).mkdir()
        for index in range(episode.frame_count):
            np.savetxt(work / name / f"{index:03d}.xyz", episode.frame(index))
        rows = np.column_stack([episode.times, episode.gripper[:, 0]])
        np.savetxt(work / name / "gripper.csv", rows, delimiter=",", header="t_s,x,y,z", comments="")
    command = ("fit", "--scene", "small.yaml", "--out", "fits", "--max-steps", 1, "--starts", 1, "--separate")
    assert set(run(*command, "run.1", "run.2", cwd=work).result) == {"run.1", "run.2"}


class TestJointFitOverMotions:
    """One cloth that is lifted, and pulled to the side."""

    @pytest.fixture
    def motions(self, work):
        told = yaml.safe_load((work / "small.yaml").read_text())
        (work / "side.yaml").write_text(yaml.safe_dump({**told, "path": [[0, 0, 0, 0], [0.5, 0.1, 0, 0.1]]}))
        write_episode(work / "s1.npz", clouds_of(load_scenario(str(work / "side.yaml")), stretching=1.4, density=1.0))
        return work

    def test_each_recording_has_its_own_pose_and_loss(self, motions):
        pairs = ("small.yaml=e1.npz", "side.yaml=s1.npz")
        done = run("fit", *pairs, "--out", "fits", "--max-steps", 2, "--fix", "density=0.2", cwd=motions)
        joint = json.loads((motions / "fits" / "fit.json").read_text())
        assert [(one["scenario"], one["name"]) for one in joint["episodes"]] == [("small", "e1"), ("side", "s1")]
        losses = [one["loss"] for one in joint["episodes"]]
        assert joint["loss"] == pytest.approx(math.sqrt(losses[0] * losses[1]), rel=1e-9)
        for one in joint["episodes"]:
            assert set(one["nuisance"]) == {*NUISANCE, "turn"} - {"scale"}
            assert one["left_out"]["loss"] >= 0.5 * one["loss"]
        assert "predict other recordings" in done.result["held_out"] or "do not predict" in done.result["held_out"]
        assert done.result["episodes"].keys() == {"e1", "s1"}
        run("simulate", "fits/fit.json", "--track", "s1.npz", "--out", "r.npz", cwd=motions)
        with np.load(motions / "r.npz") as replay, np.load(motions / "fits" / "fit.npz") as fitted:
            np.testing.assert_allclose(replay["nodes"], fitted["nodes_1"], atol=1e-12)

    def test_a_folder_stands_for_its_episodes(self, motions):
        (motions / "lifts").mkdir()
        for name in ("e1.npz", "e2.npz"):
            shutil.copy(motions / "e1.npz", motions / "lifts" / name)
        run("fit", "small.yaml=lifts", "side.yaml=s1.npz", "--out", "fits", "--max-steps", 1, cwd=motions)
        joint = json.loads((motions / "fits" / "fit.json").read_text())
        assert [(one["scenario"], one["name"]) for one in joint["episodes"]] == [
            ("small", "e1"),
            ("small", "e2"),
            ("side", "s1"),
        ]

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (("small.yaml=e1.npz", "e1.npz"), "Give each recording its scene, as in lift=a.npz fold=b.npz"),
            (("small.yaml=e1.npz", "small.yaml=e1.npz"), "Two recordings are named e1"),
            (("small.yaml=e1.npz", "small.yaml=."), "Two recordings are named e1"),
            (("small.yaml=nothing",), "nothing holds no gripper.csv"),
            (("small.yaml=e1.npz", "denim.yaml=s1.npz"), "is of one cloth"),
        ],
    )
    def test_what_is_no_list_of_recordings(self, motions, arguments, message):
        (motions / "denim.yaml").write_text(yaml.safe_dump({**SMALL, "material": "denim"}))
        (motions / "nothing").mkdir()
        assert message in run("fit", *arguments, "--out", "fits", cwd=motions, code=1).errors
        assert not (motions / "fits" / "fit.json").exists()


def test_a_process_says_what_is_wrong_without_a_traceback(work):
    command = [*DIFFCLOUD, "fit", "--scene", "nothing", "--out", "fits", "e1.npz"]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=work, env=env, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert done.stderr.startswith("Error: ")
    assert "Traceback" not in done.stderr


@pytest.fixture
def tree(work):
    """Episodes as the stage `fit` takes them."""
    (work / "raw" / "scenes").mkdir(parents=True)
    (work / "raw" / "scenes" / "small.yaml").write_text(yaml.safe_dump(SMALL))
    (work / "episodes" / "small").mkdir(parents=True)
    shutil.move(work / "e1.npz", work / "episodes" / "small" / "e1.npz")
    return work


FIT = ("fit", "--params", "params.yaml", "--out", "fits", "episodes")


def told(folder: Path, **fit: object) -> None:
    (folder / "params.yaml").write_text(yaml.safe_dump({"scenes": ["small"], "fit": fit}))


def fit_of(folder: Path, name: str) -> dict:
    return json.loads((folder / "small" / f"{name}.json").read_text())


def test_interrupted_fit_leaves_the_best_so_far_and_goes_on(tree, monkeypatch):
    calls = []

    def evaluate(self, *arguments):
        calls.append(0)
        if len(calls) == 20:
            raise KeyboardInterrupt  # as Ctrl-C does
        return evaluated(self, *arguments)

    evaluated = Objective.__call__
    monkeypatch.setattr(Objective, "__call__", evaluate)
    write_episode(tree / "episodes" / "small" / "e2.npz", clouds_of(small_lift(), stretching=1.7, density=1.0))
    adam = {"name": "adam", "max_steps": 10}  # as many steps whatever the loss does
    told(tree, solver=adam)
    done = staged(*FIT, cwd=tree, code=130)
    assert "best so far" in done.errors
    first, second = (fit_of(tree / "fits", name) for name in ("e1", "e2"))
    assert (first["stop_reason"], second["stop_reason"]) == ("iterations", "interrupted")
    assert second["loss"] <= second["loss_start"]
    calls[:] = [0] * 20  # no more interrupts
    seconds = read_seconds(tree / "fits" / "small" / "e1.json")
    assert staged(*FIT, cwd=tree).result["fits"]["small/e1"]["seconds"] == seconds > 0  # kept
    assert fit_of(tree / "fits", "e2")["iterations"] == 10
    begun = len(calls)
    told(tree, solver=adam, level=0.8)  # the same fit
    staged(*FIT, cwd=tree)
    assert len(calls) == begun
    told(tree, solver=adam, seed=1)  # another fit
    staged(*FIT, cwd=tree)
    assert len(calls) > begun


def test_a_ctrl_c_after_the_last_step_does_not_cost_the_fit(tree, monkeypatch):
    real, pressed = task.describe_fit, []

    def describe(*arguments, **options):
        if not pressed:
            pressed.append(True)
            raise KeyboardInterrupt
        return real(*arguments, **options)

    monkeypatch.setattr(task, "describe_fit", describe)
    told(tree, solver={"name": "adam", "max_steps": 2})
    staged(*FIT, cwd=tree, code=130)
    assert fit_of(tree / "fits", "e1")["stop_reason"] == "iterations"
    seconds = read_seconds(tree / "fits" / "small" / "e1.json")
    assert staged(*FIT, cwd=tree).result["fits"]["small/e1"]["seconds"] == seconds > 0  # kept


@pytest.mark.slow
def test_processes_give_the_same_fits(tree):
    write_episode(tree / "episodes" / "small" / "e2.npz", clouds_of(small_lift(), stretching=1.7, density=1.0))
    told(tree, solver={"max_steps": 2})
    found = {}
    for workers in (1, 2):
        out = f"by{workers}"
        staged("fit", "--params", "params.yaml", "--out", out, "--workers", workers, "episodes", cwd=tree)
        found[workers] = [(tree / out / "small" / f"{name}.json").read_bytes() for name in ("e1", "e2")]
    assert found[1] == found[2]


@pytest.mark.slow
def test_ctrl_c_stops_fits_in_processes_and_keeps_their_best(tree):
    folder = tree / "episodes" / "small"
    (folder / "e1.npz").unlink()
    write_episode(
        folder / "easy.npz", clouds_of(small_lift(), stretching=5.05, density=5.05)
    )  # below the threshold at once
    moved = clouds_of(small_lift(), stretching=1.7, density=1.0)
    write_episode(folder / "far.npz", replace(moved, points=moved.points + 0.03))  # out of reach
    told(tree, solver={"name": "adam", "max_steps": 1_000_000, "threshold": 5e-5})
    command = [sys.executable, "-m", "pipeline.fit", *FIT[1:], "--workers", "2"]
    process = subprocess.Popen(command, cwd=tree, env=environment(), stderr=subprocess.PIPE, text=True)
    wait_for((tree / "fits" / "small" / "easy.json").exists, process)
    time.sleep(3)  # the other process began when this one did
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130, said
    assert "Traceback" not in said
    reasons = [fit_of(tree / "fits", name)["stop_reason"] for name in ("easy", "far")]
    assert reasons == ["threshold", "interrupted"]


CLUSTER = """
import sys
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


@pytest.mark.slow
def test_a_scheduler_that_dies_loses_no_finished_fit(tree, tmp_path_factory):
    for number in range(2, 6):
        name = tree / "episodes" / "small" / f"e{number}.npz"
        write_episode(name, clouds_of(small_lift(), stretching=0.5 * number, density=1.0))
    told(tree, solver={"name": "adam", "max_steps": 20})
    (tree / "cluster.py").write_text(CLUSTER)
    elsewhere = tmp_path_factory.mktemp("elsewhere")  # where workers start; what they write is relative to the command
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "start_new_session": True}
    with subprocess.Popen([sys.executable, tree / "cluster.py"], cwd=elsewhere, env=environment(), **pipes) as cluster:
        command = [sys.executable, "-m", "pipeline.fit", *FIT[1:], "--scheduler", cluster.stdout.readline().strip()]
        process = subprocess.Popen(command, cwd=tree, env=environment(), stderr=subprocess.PIPE, text=True)
        wait_for((tree / "fits" / "small" / "e1.json").exists, process)
        os.killpg(cluster.pid, signal.SIGKILL)
        _, said = process.communicate(timeout=120)
    assert process.returncode == 1, said
    assert "Finished results are kept. Run the command again." in " ".join(said.split())
    finished = {path.stem: path.stat().st_mtime_ns for path in (tree / "fits" / "small").glob("e*.json")}
    assert 1 <= len(finished) < 5
    staged(*FIT, cwd=tree)
    now = {path.stem: path.stat().st_mtime_ns for path in (tree / "fits" / "small").glob("e*.json")}
    assert finished.items() <= now.items()
    assert len(now) == 5


@pytest.mark.parametrize("told", ["side=1,2", "side", "=1,2,3", "side=1,2,nan", "side=a,b,c"])
def test_a_camera_that_stands_nowhere(work, told):
    (work / "clouds").mkdir()
    np.savetxt(work / "clouds" / "0.xyz", np.eye(3))
    refused = run("data", "import", "clouds", "--rate-hz", 10, "--camera", told, "--out", "nowhere.npz", cwd=work, code=1)
    assert "--camera takes NAME=X,Y,Z in metres" in refused.errors
    assert not (work / "nowhere.npz").exists()


def test_import_own_clouds_end_to_end(work):
    (work / "clouds").mkdir()
    episode = read_episode(work / "e1.npz")
    for index in range(episode.frame_count):
        np.savetxt(work / "clouds" / f"frame_{index:03d}.xyz", episode.frame(index))
    rows = np.column_stack([episode.times, episode.gripper[:, 0]])
    np.savetxt(work / "gripper.csv", rows, delimiter=",", header="t_s,x,y,z", comments="")
    where = ("--camera", "side=1.2,0,0.5", "--camera", "top=0,0,2")
    run("data", "import", "clouds", "--gripper", "gripper.csv", *where, "--out", "own.npz", cwd=work)
    assert read_episode(work / "own.npz").meta["viewpoints"] == {"side": [1.2, 0.0, 0.5], "top": [0.0, 0.0, 2.0]}
    again = read_episode(work / "own.npz")
    np.testing.assert_allclose(again.points, episode.points, atol=1e-6)
    run("fit", "--scene", "small.yaml", "--out", "fits", "--max-steps", 1, "own.npz", cwd=work)


class TestCloudsOfACamera:
    """Clouds in the frame of a camera, with a wall behind the cloth."""

    @pytest.fixture
    def folder(self, work):
        pose = looking_at([1.0, -0.5, 0.8], [0.0, 0.0, 0.0])
        episode, wall = read_episode(work / "e1.npz"), np.array([[-2.0, 0.0, 0.5], [-2.0, 0.3, 0.6]])
        (work / "clouds").mkdir()
        for index in range(episode.frame_count):
            points = transform(inverse(pose), np.vstack([episode.frame(index), wall]).astype(np.float64))
            np.savetxt(work / "clouds" / f"{index:03d}.xyz", points, fmt="%.9f")
        np.savetxt(work / "camera.txt", pose)
        return work

    def test_they_become_those_of_the_cloth_in_the_robots_frame(self, folder):
        options = ("--rate-hz", 10, "--transform", "camera.txt", "--crop", "1,1,1:-1,-1,-1")
        run("data", "import", "clouds", *options, "--camera", "side=1,-0.5,0.8", "--out", "own.npz", cwd=folder)
        found, episode = read_episode(folder / "own.npz"), read_episode(folder / "e1.npz")
        np.testing.assert_array_equal(found.offsets, episode.offsets)
        np.testing.assert_allclose(found.points, episode.points, atol=1e-6)
        assert found.meta["viewpoints"] == {"side": [1.0, -0.5, 0.8]}

    @pytest.mark.parametrize("text", ["1,1,1", "0,0,0:1,1", "0,0,0:1,1,0", "0,0,0:1,1,nan", "a,b,c:1,1,1"])
    def test_a_box_that_is_none(self, folder, text):
        refused = run("data", "import", "clouds", "--rate-hz", 10, "--crop", text, "--out", "own.npz", cwd=folder, code=1)
        assert "two corners that differ in x, y and z" in refused.errors

    def test_a_box_beside_the_cloth(self, folder):
        options = ("--rate-hz", 10, "--transform", "camera.txt", "--crop", "5,5,5:6,6,6", "--out", "own.npz")
        refused = run("data", "import", "clouds", *options, cwd=folder, code=1)
        assert "no points in the box from [5.0, 5.0, 5.0] to [6.0, 6.0, 6.0] m. The first one is frame 0" in refused.errors
        assert not (folder / "own.npz").exists()

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("1 0 0 0\n0 1 0 0\n0 0 1 0", "it must be 4 x 4 numbers"),
            ("2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1", "it is not a rigid transform"),
            ("1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1", "it translates by nan m"),
            ("1 0 0 900\n0 1 0 0\n0 0 1 0\n0 0 0 1", "it translates by 900 m; give metres"),
            ("1 0 0 x\n0 1 0 0\n0 0 1 0\n0 0 0 1", "'x' is not a number"),
            ("9" * 20_000, "camera.txt"),
        ],
    )
    def test_a_file_without_a_transform(self, folder, text, said):
        (folder / "camera.txt").write_text(text)
        options = ("--rate-hz", 10, "--transform", "camera.txt", "--out", "own.npz")
        assert said in run("data", "import", "clouds", *options, cwd=folder, code=1).errors
        assert not (folder / "own.npz").exists()


def test_stages_run_in_a_row_and_the_page_is_whole(work):
    (work / "raw" / "scenes").mkdir(parents=True)
    (work / "raw" / "scenes" / "small.yaml").write_text(yaml.safe_dump(SMALL))
    params = {
        "scenes": ["small"],
        "synthesize": {"per_scenario": 1},
        "fit": {"solver": {"max_steps": 2}},
        "evaluate": {"draws": 1},
    }
    (work / "params.yaml").write_text(yaml.safe_dump(params))
    staged("synthesize", "--params", "params.yaml", "--out", "data/recorded", cwd=work)
    staged("preprocess", "--params", "params.yaml", "--out", "data/episodes", "data/recorded", cwd=work)
    staged("fit", "--params", "params.yaml", "--out", "data/fits", "data/episodes", cwd=work)
    staged("evaluate", "--params", "params.yaml", cwd=work)
    staged("report", "--params", "params.yaml", cwd=work)
    metrics = json.loads((work / "reports" / "metrics.json").read_text())["small"]
    assert set(metrics) == {"rms_mm", "ratio_factor"}  # a fit compares every frame
    page = (work / "reports" / "index.html").read_text()
    assert "small_hidden1" in page
    head, *scripts = page.split("<script>")
    for own in (head, scripts[-1]):  # what lies between is plotly
        assert "{{" not in own
        assert "://" not in own
    first = (work / "reports" / "metrics.json").read_bytes()
    staged("evaluate", "--params", "params.yaml", cwd=work)
    assert (work / "reports" / "metrics.json").read_bytes() == first


@pytest.mark.slow
def test_two_grippers_from_csv_to_report(work):
    """Their tracks come as one CSV, drive the fit, the simulation, and what the page is made of."""
    (work / "raw" / "scenes").mkdir(parents=True)
    two = {name: value for name, value in SMALL.items() if name != "path"} | {
        "yaw_deg": 0,
        "path": [[0, 0, 0, 0], [0.5, 0, 0, 0.15]],
        "grippers": {
            "left": {"grasped": ["left_top"]},
            "right": {"grasped": ["right_top"], "path": [[0, 0, 0, 0], [0.5, 0, 0.06, 0.1]]},
        },
    }
    (work / "raw" / "scenes" / "two.yaml").write_text(yaml.safe_dump(two))
    still = {**two, "path": [[0, 0, 0, 0], [0.5, 0, 0, 0.001]], "grippers": {"left": {"grasped": ["left_top"]}}}
    still["grippers"]["right"] = {"grasped": ["right_top"]}
    (work / "raw" / "scenes" / "still.yaml").write_text(yaml.safe_dump(still))
    run("simulate", "raw/scenes/two.yaml", "--set", "stretching=2.4", "--out", "true.npz", cwd=work)
    with np.load(work / "true.npz") as true:
        nodes, faces, times = true["nodes"], true["faces"], true["times"]
    (work / "clouds").mkdir()
    rows = ["gripper,t_s,x,y,z"]
    for frame, (time_s, cloth) in enumerate(zip(times, nodes, strict=True)):
        np.savetxt(work / "clouds" / f"{frame}.xyz", cloth[faces].mean(axis=1))
        for name, node in (("right", 24), ("left", 20)):  # in another order than the scenario's
            rows.append(",".join([name, *(f"{number:.9f}" for number in (time_s, *cloth[node]))]))
    (work / "tracks.csv").write_text("\n".join(rows))
    episode = "data/episodes/still/own.npz"
    run("data", "import", "clouds", "--gripper", "tracks.csv", "--out", episode, cwd=work)
    run("simulate", "still", "--track", episode, "--set", "stretching=2.4", "--out", "again.npz", cwd=work)
    with np.load(work / "again.npz") as again:
        np.testing.assert_allclose(again["nodes"][:, [20, 24]], nodes[:, [20, 24]], atol=1e-6)
        np.testing.assert_allclose(again["nodes"], nodes, atol=5e-3)
    short = ("simulate", "still", "--track", episode, "--frames", 2, "--out", "short.npz")
    done = run(*short, cwd=work)
    assert f"3 of the recording's {len(times)} frames lie within the" in done.errors
    assert done.result["warnings"]
    assert f"--frames {len(times) - 1} covers all" in done.errors
    assert "of the recording's" not in run(*short, "--frames", len(times) - 1, cwd=work).errors
    (work / "params.yaml").write_text(
        yaml.safe_dump({"scenes": ["still"], "fit": {"solver": {"max_steps": 2}}, "evaluate": {"draws": 1}})
    )
    staged("fit", "--params", "params.yaml", "--out", "data/fits", "data/episodes", cwd=work)
    staged("evaluate", "--params", "params.yaml", cwd=work)
    staged("report", "--params", "params.yaml", cwd=work)
    metrics = json.loads((work / "reports" / "metrics.json").read_text())
    assert metrics["still"]["rms_mm"]["diffcloud"] < 30  # the scenario's own path would leave it on the table
    assert "own" in (work / "reports" / "index.html").read_text()
    # one gripper's file alone is refused by the names
    (work / "one.csv").write_text("\n".join(row[5:] for row in rows if row.startswith("left,")))
    (work / "one.csv").write_text("t_s,x,y,z\n" + (work / "one.csv").read_text())
    run("data", "import", "clouds", "--gripper", "left=one.csv", "--out", "one.npz", cwd=work)
    done = run("simulate", "still", "--track", "one.npz", "--out", "x.npz", cwd=work, code=1)
    assert "The scene's grippers are left, right, the episode's left" in done.errors
    assert not (work / "x.npz").exists()


def built_in_mesh(name):
    return load_scenario(name).scene.mesh


def test_simulated_targets_are_whole_uniform_and_left_as_they_are(work):
    """The hidden parameters are recoverable in principle: at the truth only the sampling of the surface is left."""
    (work / "raw" / "scenes").mkdir(parents=True)
    (work / "raw" / "scenes" / "v.yaml").write_text("base: vest_hang\nframes: 3\nloss_frames: [2]\npoints: 900\n")
    (work / "p.yaml").write_text(yaml.safe_dump({"scenes": ["v"], "synthesize": {"per_scenario": 3}}))
    staged("synthesize", "--params", "p.yaml", "--out", "recorded", cwd=work)
    staged("preprocess", "--params", "p.yaml", "--out", "episodes", "recorded", cwd=work)
    for number in (1, 2, 3):
        recorded, kept = (
            read_episode(work / folder / "v" / f"v_hidden{number}.npz") for folder in ("recorded", "episodes")
        )
        np.testing.assert_array_equal(kept.points, recorded.points)
        assert np.diff(kept.offsets).tolist() == [900] * 4
        truth = kept.meta["truth"]
        assert all(0.1 <= value <= 10 for value in truth.values())
    loss = measured(work / "raw" / "scenes" / "v.yaml", work / "episodes" / "v" / "v_hidden3.npz", truth)
    area = float(built_in_mesh("vest_hang").face_area.sum())
    assert loss < 2 * area / (np.pi * 900)  # twice the mean squared distance to the nearest of 900 points


def test_rollouts_carry_the_bodies_to_draw(work):
    run("simulate", "vest_hang", "--frames", 1, "--out", "vest.npz", cwd=work)
    run("simulate", "small.yaml", "--frames", 1, "--out", "lift.npz", cwd=work)
    with np.load(work / "vest.npz") as vest, np.load(work / "lift.npz") as lift:
        assert vest["nodes"].shape == (2, 80, 3)
        assert vest["obstacle_faces"].max() == len(vest["obstacle_nodes"]) - 1
        assert lift["obstacle_nodes"].shape == (0, 3)  # the table is not drawn
        assert lift["moving_nodes"].shape == (2, 0, 3)


def test_rollouts_of_scene_files_carry_what_moves(work):
    data = over_moving_box()
    data["obstacles"].append({"mesh": "meshes/ball.obj", "transform": {"translate": [0, 0, 0.08]}})
    data |= {"frame_steps": 2, "gravity": [0, 0, -1]}
    path = write_file(write_files(work), data)
    heavy = 2 * scene_named(str(path)).nominal("body_mass")
    command = ("simulate", path, "--frames", 3, "--set", f"body_mass={heavy}", "--out")
    run(*command, "r.npz", cwd=work)
    for kind in ("obj", "ply"):
        run(*command, kind, "--format", kind, cwd=work)
    box, ball = len(MESHES["box"].nodes), len(MESHES["ball"].nodes)
    with np.load(work / "r.npz") as data:
        assert data["moving_nodes"].shape == (4, box + ball, 3)
        assert data["moving_faces"].max() == box + ball - 1
        rise, fall = np.split(data["moving_nodes"][-1] - data["moving_nodes"][0], [box])
        last, faces = data["moving_nodes"][-1], data["moving_faces"]
    assert (rise[:, 2] > 1e-5).all()
    assert (fall[:, 2] < -1e-5).all()
    written = read_surface(work / "obj" / "003_moving.obj")
    np.testing.assert_array_equal(written.nodes, last)
    np.testing.assert_array_equal(written.faces, faces)
    names = [f"{frame:03d}{what}.ply" for frame in range(4) for what in ("", "_moving")]
    assert sorted(file.name for file in (work / "ply").glob("*.ply")) == names


def test_synthetic_episodes_are_the_same_bytes_for_the_same_seed(work):
    (work / "raw" / "scenes").mkdir(parents=True)
    (work / "raw" / "scenes" / "small.yaml").write_text(yaml.safe_dump(SMALL))
    (work / "p.yaml").write_text(yaml.safe_dump({"scenes": ["small"], "synthesize": {"per_scenario": 1}}))
    for out in ("a", "b"):
        staged("synthesize", "--params", "p.yaml", "--out", out, cwd=work)
    first, second = (
        {path.relative_to(work / out): path.read_bytes() for path in (work / out).rglob("*") if path.is_file()}
        for out in ("a", "b")
    )
    assert Path("small/small_hidden1/cameras/side/depth/000000.png") in first
    assert first == second


class TestBadInput:
    @pytest.mark.parametrize(
        ("params", "message"),
        [
            ({"fit": {"iteration": 3}}, "fit.iteration: unknown or unsupported field"),
            ({"fit": {"bounds": {"stretching": [5, 1]}}}, "must be in order (low < high), got [5.0, 1.0]"),
            ({"synthesize": {"true_range": [3, 1]}}, "true_range must be in order"),
            ({"fits": {}}, "fits: unknown or unsupported field"),
            ({"fit": {"solver": "lbfgs"}}, "fit.solver"),
            ({"fit": {"solver": {"smoothing": 0.5}}}, "smoothing: unknown or unsupported field"),
            ({"fit": {"solver": {"max_simulations": 9}}}, "max_simulations: unknown or unsupported field"),
            ({"fit": {"uncertain": "bend=2x"}}, "Unknown parameter 'bend'"),
            ({"fit": {"uncertain": "stretching=2x"}}, "stretching is fitted"),
            ({"fit": {"uncertain": "air_density=2x", "loss": "paper"}}, "the rest of the material is known"),
            ({"fit": {"loss": "paper"}}, "the paper's loss has no likelihood"),
        ],
    )
    def test_parameter_files(self, work, params, message):
        (work / "params.yaml").write_text(yaml.safe_dump(params))
        done = run("fit", "--params", "params.yaml", "--scene", "small.yaml", "--out", "fits", "e1.npz", cwd=work, code=1)
        assert message in done.errors
        assert not (work / "fits").exists()

    def test_a_damaged_last_episode_costs_nothing(self, tree):
        (tree / "episodes" / "small" / "e2.npz").write_bytes(b"nothing")
        told(tree)
        done = staged(*FIT, cwd=tree, code=1)
        assert "e2.npz is not a readable episode" in done.errors
        assert not (tree / "fits").exists()

    def test_an_episode_that_is_too_short(self, work):
        short = Episode.from_frames([np.zeros((3, 3))] * 2, np.array([0.0, 0.1]))
        write_episode(work / "short.npz", short)
        done = run("fit", "--scene", "small.yaml", "--out", "f", "--frames", 5, "short.npz", cwd=work, code=1)
        assert "Frame 5 is missing: the episode has 2 frames" in done.errors

    def test_unknown_names_and_numbers(self, work):
        for arguments, message in (
            (("lfit",), "Unknown scenario 'lfit'"),
            (("small.yaml", "--set", "weight=3"), "Unknown parameter 'weight'"),
            (("small.yaml", "--set", "density=heavy"), "takes NAME=NUMBER"),
            (("small.yaml", "--set", "density=nan"), "finite"),
            (("small.yaml", "--set", "stretching=-1e9"), "--set stretching must be above 0, got -1e+09"),
            (("small.yaml", "--set", "body_mass=2"), "body_mass has no effect in small"),
            (("none.json",), "No such file"),
        ):
            done = run("simulate", *arguments, "--out", "r.npz", cwd=work, code=1)
            assert message in done.errors
            assert not (work / "r.npz").exists()

    def test_a_diverged_rollout_names_step_and_parameters(self, work):
        own = load_scenario("vest_hang")
        bending, density = 9e5 * own.nominal("bending"), 2e-6 * own.nominal("density")
        explodes = ("--set", f"bending={bending:g}", "--set", f"density={density:g}", "--frames", 2)
        done = run("simulate", "vest_hang", *explodes, "--out", "r.npz", cwd=work, code=1)
        assert "diverged at step" in done.errors
        assert f"bending={bending:g}, density={density:g}" in done.errors
        assert not (work / "r.npz").exists()

    def test_a_disk_that_cannot_be_written(self, work):
        (work / "file").write_text("")
        done = run("simulate", "small.yaml", "--out", "file/r.npz", cwd=work, code=1)
        assert "Cannot write" in done.errors


def studied(*arguments: object, cwd: Path, code: int = 0) -> Invoked:
    with contextlib.chdir(cwd):
        return study(*arguments, code=code)


def test_a_study_of_gradients_goes_on_where_it_stopped(work):
    options = ["gradients", "--scene", "small.yaml", "--out", "pairs.csv"]
    studied(*options, "--pairs", 2, cwd=work)
    first = (work / "pairs.csv").read_text().splitlines()
    assert studied(*options, "--pairs", 3, cwd=work).result["pairs"] == 3
    assert (work / "pairs.csv").read_text().splitlines()[:3] == first
    assert "other pairs" in studied(*options, "--pairs", 3, "--seed", 1, cwd=work, code=1).errors
    other = studied(*options, "--pairs", 3, "--integrator", "arcsim", cwd=work, code=1).errors
    assert re.search("holds pairs of small implicit [0-9a-f]{16}, not of small arcsim", " ".join(other.split()))
    (work / "small.yaml").write_text(yaml.safe_dump(SMALL | {"steps_per_frame": SMALL["steps_per_frame"] + 1}))
    assert "holds pairs of small implicit" in studied(*options, "--pairs", 3, cwd=work, code=1).errors


def test_a_study_of_steps_and_meshes_writes_its_page(work):
    (work / "tiny.yaml").write_text(yaml.safe_dump(SMALL | {"nodes": [3, 3], "frames": 1}))
    studied("discretisation", "--scenario", "tiny.yaml", "--cuts", 1, "--out", "page.md", cwd=work)
    page = (work / "page.md").read_text()
    assert "| tiny | implicit, BDF2 | 2 (default) |" in page
    assert "| tiny | arcsim | 32 |" in page
    assert "<summary>Meshes</summary>" in page
