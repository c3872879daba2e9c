"""Training, predicting, and what takes predictions up, through the command line."""

from __future__ import annotations

import importlib
import json
import shutil
import signal
import subprocess
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import torch
import typer
import yaml
from click.testing import Result
from typer.testing import CliRunner

from diffcloud.cli.app import app
from diffcloud.clouds import CloudMaker
from diffcloud.errors import DiffCloudError, TrainingError
from diffcloud.io.episodes import read_episode, write_episode
from diffcloud.io.simulated import write_simulated
from diffcloud.regressors import Regressor
from diffcloud.regressors.training import train_regressor
from tests.cli.invoke import DIFFCLOUD, environment, wait_for
from tests.cli.test_commands import SMALL
from tests.conftest import small_lift
from tests.estimation.test_fit import clouds_of
from tests.regressors.simulated import sagging_sheet
from tests.regressors.test_checkpoints import regressor

NETWORKS = "data/regressors/small"
CHECKPOINT = f"{NETWORKS}/mlp.safetensors"
TRAIN = (
    "network",
    "train",
    "--params",
    "params.yaml",
    "--scene",
    "small",
    "--model",
    "mlp",
    "--data",
    "sim",
    "--out",
    NETWORKS,
)


def run(*arguments: object, code: int = 0) -> Result:
    """A command in this process: what it imports takes seconds."""
    words = [str(argument) for argument in arguments]
    stage = words[0].removeprefix("pipeline.")
    chosen = app
    if stage != words[0]:
        chosen = typer.Typer()
        chosen.command()(getattr(importlib.import_module(words.pop(0)), stage))
    done = CliRunner().invoke(chosen, words)
    raised = isinstance(done.exception, DiffCloudError)  # `main` makes a message and status 1 of it
    assert (1 if raised else done.exit_code) == code, f"{done.output}\n{done.exception!r}"
    return done


def trained(folder: Path, **settings: object) -> None:
    """Other settings of the training in the parameters file."""
    params = yaml.safe_load((folder / "params.yaml").read_text())
    params["train"] = {"profile": "quick", "epochs": 2, "points": 24} | settings
    (folder / "params.yaml").write_text(yaml.safe_dump(params))


def result(done: Result) -> dict:
    return json.loads(done.stdout.strip().splitlines()[-1])


@pytest.fixture
def work(tmp_path, monkeypatch):
    """A folder with two episodes of a small lift, made-up draws of it, and a regressor that knows nothing."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "raw" / "scenes").mkdir(parents=True)
    (tmp_path / "raw" / "scenes" / "small.yaml").write_text(yaml.safe_dump(SMALL))
    params = {
        "scenes": ["small"],
        "train": {"profile": "quick", "epochs": 2, "points": 24},
        "fit": {"solver": {"max_steps": 1}},
        "evaluate": {"draws": 1},
    }
    (tmp_path / "params.yaml").write_text(yaml.safe_dump(params))
    for number in (1, 2):
        clouds = clouds_of(small_lift(), stretching=0.7 * number, density=1.0)
        write_episode(tmp_path / "data" / "episodes" / "small" / f"e{number}.npz", clouds)
    sets = {"train": sagging_sheet(24, scenario="small"), "test": sagging_sheet(10, seed=1, scenario="small")}
    write_simulated(tmp_path / "sim", sets, about={}, replaced="")
    regressor(scenario="small").write(tmp_path / CHECKPOINT)
    return tmp_path


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"draws": 1}, "A batch needs at least 2 draws"), ({"device": "gpu"}, "Torch finds no GPU on this machine")],
)
def test_trainings_that_cannot_be(work, monkeypatch, settings, message):
    trained(work, **settings)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    before = (work / CHECKPOINT).read_bytes()
    assert message in str(run(*TRAIN, code=1).exception)
    assert (work / CHECKPOINT).read_bytes() == before


def test_train_then_predict(work):
    trained = result(run(*TRAIN, "--seed", 5, "--json"))["models"]["mlp"]
    assert trained["epochs"] == 2
    assert set(trained["held_out"]["parameters"]) == {"stretching", "density"}
    summary = json.loads((work / "data/regressors/small/mlp/training.json").read_text())
    assert summary["history"] == trained["history"]
    assert Regressor.read(work / CHECKPOINT).description.training["settings"]["seed"] == 5
    done = run("network", "predict", "--checkpoint", CHECKPOINT, "--json", "data/episodes/small")
    found = result(done)
    assert set(found) == {"e1", "e2"}
    for values in found.values():
        low, high = values["interval"]["density"]
        assert low < values["density"] < high
        assert 0.1 <= values["clipped"]["stretching"] <= 10
        assert values["outside"] == [name for name in ("stretching", "density") if not 0.1 <= values[name] <= 10]


def test_clouds_show_what_the_cameras_of_a_recording_see(work, monkeypatch):
    plain = read_episode(work / "data/episodes/small/e1.npz")
    assert "has no camera positions" in str(run(*TRAIN, "--like", "data/episodes/small/e1.npz", code=1).exception)
    viewpoints = {"side": [0.5, -1.0, 0.7], "top": [0.0, 0.0, 2.0]}
    write_episode(work / "other.npz", replace(plain, meta={"scenario": "lift", "viewpoints": viewpoints}))
    assert "a recording of lift, not of small; add --scene lift" in str(
        run(*TRAIN, "--like", "other.npz", code=1).exception
    )
    write_episode(work / "seen.npz", replace(plain, meta={"scenario": "small", "viewpoints": viewpoints}))
    trained(work, augment=False)
    assert "leave out either" in str(run(*TRAIN, "--like", "seen.npz", code=1).exception)
    trained(work)
    shown = []
    monkeypatch.setattr(CloudMaker, "seen", lambda maker, nodes: shown.append(maker.augmentation.viewpoints))
    run(*TRAIN, "--like", "seen.npz")
    assert set(shown) == {tuple(map(tuple, viewpoints.values()))}
    told = Regressor.read(work / CHECKPOINT).description.training["settings"]
    assert told["viewpoints"] == [[0.5, -1.0, 0.7], [0.0, 0.0, 2.0]]


def test_values_outside_the_bounds_are_shown_and_told(work):
    beyond = regressor(scenario="small")
    beyond.network.head[-1].bias.data += 3
    beyond.write(work / CHECKPOINT)
    done = run("network", "predict", "--checkpoint", CHECKPOINT, "--json", "data/episodes/small/e1.npz")
    values = result(done)["e1"]
    assert values["stretching"] > 10
    assert values["clipped"] == {"stretching": 10, "density": 10}
    assert values["outside"] == ["stretching", "density"]
    assert "Outside the bounds" in done.stderr


@pytest.mark.slow
def test_a_fit_starts_from_a_prediction_and_the_report_shows_both(work):
    episodes = "data/episodes/small"
    predicted = result(run("network", "predict", "--checkpoint", CHECKPOINT, "--json", episodes))
    # else evaluate has all methods lay the cloth as the fit ends
    fit = (
        "fit",
        "--params",
        "params.yaml",
        "--scene",
        "small",
        "--init",
        "mlp",
        "--initial-state",
        "none",
        "--starts",
        "1",
    )
    run(*fit, "--separate", "--out", "fits", episodes)
    for name, values in predicted.items():
        for suffix in (".json", ".npz"):
            (work / "data/fits/small").mkdir(parents=True, exist_ok=True)
            shutil.copy(work / "fits" / name / f"fit{suffix}", work / "data/fits/small" / f"{name}{suffix}")
        start = json.loads((work / "data/fits/small" / f"{name}.json").read_text())["start"]
        assert {name: start[name] for name in values["clipped"]} == pytest.approx(values["clipped"], rel=1e-5)
    done = run("pipeline.evaluate", "--params", "params.yaml", "--json")
    table = pd.read_csv(work / "reports/tables/predictions.csv")
    assert table[["episode", "model"]].to_numpy().tolist() == [["e1", "mlp"], ["e2", "mlp"]]
    assert table["predicted_density"].tolist() == pytest.approx(
        [values["density"] for values in predicted.values()], rel=1e-5
    )
    fits = pd.read_csv(work / "reports/tables/fits.csv")
    assert table["loss"].tolist() == pytest.approx(fits["loss_start"].tolist(), rel=1e-4)  # the same simulation
    assert result(done)["metrics"]["regressors"]["small"]["mlp"]["loss"] == pytest.approx(table["loss"].mean())
    run(*TRAIN)  # for the curves
    run("pipeline.report", "--params", "params.yaml")
    page = (work / "reports/index.html").read_text()
    head, *scripts = page.split("<script>")
    assert "<summary>Networks</summary>" in head
    assert '"small / mlp"' in scripts[-1]
    assert "{{" not in head + scripts[-1]


def test_an_interrupted_training_goes_on(work):
    trained(work, epochs=4000, patience=4000)
    env = environment()
    (work / CHECKPOINT).unlink()
    process = subprocess.Popen([*DIFFCLOUD, *TRAIN], cwd=work, env=env, stderr=subprocess.PIPE, text=True)
    metrics = work / "data/regressors/small/mlp/metrics.json"
    assert "Training small/mlp" in process.stderr.readline()
    wait_for(metrics.exists, process)  # until an epoch is done
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    *before, last = errors.strip().splitlines()
    assert all(line.startswith("train: ") for line in before)  # where it takes long, its progress is told
    assert last == "Interrupted; the same command keeps finished networks and goes on from the last saved epoch."
    assert "Traceback" not in errors
    assert not (work / CHECKPOINT).exists()


@pytest.mark.slow
def test_several_networks_at_once_are_those_of_one_after_another(work):
    both = (*TRAIN, "--model", "pointnet2,mlp", "--json")
    done = run(*both)
    alone = result(done)
    written = {file.name: file.read_bytes() for file in (work / NETWORKS).glob("*.safetensors")}
    assert set(written) == {"mlp.safetensors", "pointnet2.safetensors"}
    assert done.stderr.count("Training ") == 2  # a network that is named twice is trained once
    for file in (work / NETWORKS).glob("*/training.json"):
        file.unlink()
    together = result(run(*both, "--workers", 2))
    assert {file.name: file.read_bytes() for file in (work / NETWORKS).glob("*.safetensors")} == written
    assert [model["history"] for model in together["models"].values()] == [
        model["history"] for model in alone["models"].values()
    ]


def test_without_a_scenario_those_of_the_parameters_are_trained(work):
    sets = {"train": sagging_sheet(24, scenario="other"), "test": sagging_sheet(10, seed=1, scenario="other")}
    write_simulated(work / "sims" / "other", sets, about={}, replaced="")
    (work / "sim").rename(work / "sims" / "small")
    params = yaml.safe_load((work / "params.yaml").read_text())
    params["train"] |= {"scenes": ["small", "other"], "models": ["mlp"], "epochs": 1}
    (work / "params.yaml").write_text(yaml.safe_dump(params))
    train = ("network", "train", "--params", "params.yaml", "--data", "sims", "--out", "data/regressors", "--json")
    assert list(result(run(*train))["models"]) == ["small/mlp", "other/mlp"]
    assert Regressor.read(work / "data/regressors/other/mlp.safetensors").description.scenario == "other"
    (work / "data/regressors/other/notes.txt").write_text("mine")
    params["train"]["scenes"] = ["small"]
    (work / "params.yaml").write_text(yaml.safe_dump(params))
    run(*train)  # leaves what training these alone would leave, and what it did not write
    assert [path.name for path in (work / "data/regressors/other").rglob("*")] == ["notes.txt"]
    assert (work / "data/regressors/small/mlp.safetensors").is_file()


def test_without_a_scenario_those_of_the_parameters_are_fitted(work):
    options = yaml.safe_load((work / "raw/scenes/small.yaml").read_text())
    (work / "raw/scenes/other.yaml").write_text(yaml.safe_dump(options))
    params = yaml.safe_load((work / "params.yaml").read_text()) | {"scenes": ["small", "other"]}
    (work / "params.yaml").write_text(yaml.safe_dump(params))
    fit = ("pipeline.fit", "--params", "params.yaml", "--out", "data/fits", "data/episodes")
    done = run(*fit, "--json")
    assert "data/episodes has no episodes of other." in done.stderr
    assert list(result(done)["fits"]) == ["small/e1", "small/e2"]
    shutil.copytree(work / "data/episodes/small", work / "data/episodes/unlisted")
    assert "also has episodes of unlisted. They are not fitted" in " ".join(run(*fit, "--json").stderr.split())
    shutil.rmtree(work / "data/episodes/unlisted")
    shutil.copytree(work / "data/episodes/small", work / "data/episodes/other")
    first = result(run(*fit, "--json"))["fits"]
    assert list(first) == ["small/e1", "small/e2", "other/e1", "other/e2"]
    assert json.loads((work / "data/fits/other/e2.json").read_text())["loss"] == first["other/e2"]["loss"]
    (work / "data/fits/other/notes.json").write_text("{}")
    (work / "data/episodes/other/e1.npz").unlink()
    again = result(run(*fit, "--json"))["fits"]
    assert again == {name: told for name, told in first.items() if name != "other/e1"}  # kept, with their seconds
    assert sorted(path.name for path in (work / "data/fits/other").iterdir()) == [
        ".e2.timings.json",
        "e2.json",
        "e2.npz",
        "notes.json",
    ]


def test_a_finished_network_is_kept_until_something_changes(work):
    first = result(run(*TRAIN, "--json"))["models"]["mlp"]
    assert result(run(*TRAIN, "--json"))["models"]["mlp"] == first  # the same seconds too
    assert result(run(*TRAIN, "--epochs", 3, "--json"))["models"]["mlp"]["epochs"] == 3
    again = result(run(*TRAIN, "--json"))["models"]["mlp"]
    assert again["history"] == first["history"]
    (work / CHECKPOINT).write_bytes(b"damaged")
    run(*TRAIN)
    Regressor.read(work / CHECKPOINT)


def test_one_network_that_fails_does_not_stop_the_others(work, monkeypatch):
    def lost(model: str, *arguments: object, **options: object) -> object:
        if model == "mlp":
            raise TrainingError("The losses of epoch 1 are nan.")
        return train_regressor(model, *arguments, **options)

    monkeypatch.setattr("diffcloud.regressors.training.train_regressor", lost)
    done = run(*TRAIN, "--model", "meteornet", code=1)
    assert str(done.exception) == "small/mlp: The losses of epoch 1 are nan."
    Regressor.read(work / NETWORKS / "meteornet.safetensors")


class TestBadInput:
    def test_names_and_files(self, work):
        episode = "data/episodes/small/e1.npz"
        (work / "bad.safetensors").write_bytes(b"nothing")
        regressor(scenario="fold").write(work / "fold.safetensors")
        fit = ("fit", "--scene", "small", "--out", "fits", episode, "--init")
        for arguments, message in (
            (
                ("network", "predict", "--checkpoint", "bad.safetensors", episode),
                "bad.safetensors is not a readable checkpoint",
            ),
            ((*fit, "meteornet"), "No such checkpoint: data/regressors/small/meteornet.safetensors"),
            (
                (*fit, "best"),
                "A start is middle, PARAMETER=VALUE,..., mlp, pointnet2, meteornet, posterior or a checkpoint, got 'best'",
            ),
            ((*fit, "fold.safetensors"), "fold.safetensors was trained for fold, not for small"),
            ((*TRAIN, "--scene", "lift"), "sim holds draws of small, not of lift"),
            ((*TRAIN, "--profile", "fast"), "--profile: must be 'quick', 'reduced' or 'paper' (got 'fast')"),
            ((*TRAIN, "--model", "transformer"), "Unknown model 'transformer'"),
        ):
            done = run(*arguments, code=1)
            assert message in str(done.exception)
        assert not (work / "fits").exists()
