"""A fit that ended with a finer mesh than its scenario's: every command simulates it with that mesh."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from diffcloud.io.episodes import write_episode
from diffcloud.scene.scenarios import load_scenario
from tests.fit.test_fit import clouds_of
from tests.pipeline.invoke import invoke

TRUTH = {"stretch": 0.6, "mass": 1.7}
SCENARIO = {
    "base": "lift",
    "nodes": [5, 5],
    "frames": 8,
    "steps_per_frame": 3,
    "rate_hz": 10.0,
    "points": 1500,
    "path": [[0, 0, 0, 0], [0.8, 0, -0.1, 0.25]],
}


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finer")
    (folder / "coarse.yaml").write_text(yaml.safe_dump(SCENARIO))
    scenario = load_scenario(folder / "coarse.yaml")
    write_episode(folder / "cloth.npz", clouds_of(scenario.halved(1), points=3000, **TRUTH))
    return folder


OPTIONS = (
    "--scenario", "coarse.yaml", "--parameters", "stretch", "--fix", "mass=1.7", "--nuisance", "none", "--doubts", "none",
    "--starts", 1, "--screen", 4,
)  # fmt: skip


@pytest.fixture(scope="module")
def record(work):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(work)
        told = invoke("fit", "cloth.npz", *OPTIONS, "--out", "fits")
    assert "(edges 1/2 as long)" in told.errors
    return json.loads((work / "fits" / "cloth.json").read_text())


@pytest.fixture(autouse=True)
def here(work, monkeypatch):
    monkeypatch.chdir(work)


def test_the_fit_says_so_and_finds_the_truth(record):
    assert record["halvings"] == 1
    assert record["parameters"]["stretch"]["value"] == pytest.approx(TRUTH["stretch"], rel=0.05)
    with np.load("fits/cloth.npz") as motion:
        assert motion["nodes"].shape[1] == 81


def test_the_mesh_stays_where_asked(record, work):
    invoke("fit", "cloth.npz", *OPTIONS, "--halvings", 0, "--out", "kept")
    kept = json.loads((work / "kept" / "cloth.json").read_text())
    assert kept["halvings"] == 0
    assert kept["loss"] > 5 * record["loss"]


def test_the_loss_is_measured_with_that_mesh(record):
    told = invoke("evaluate", "loss", "cloth.npz", "--fit", "fits/cloth.json").result
    assert told["loss"] == pytest.approx(record["loss"], rel=1e-6)


def test_a_rollout_is_the_fitted_motion(record):
    invoke("rollout", "--fit", "fits/cloth.json", "--episode", "cloth.npz", "--out", "again.npz")
    with np.load("fits/cloth.npz") as motion, np.load("again.npz") as again:
        np.testing.assert_allclose(again["nodes"], motion["nodes"], atol=1e-9)


def test_intervals_are_of_that_mesh(record):
    told = invoke("evaluate", "intervals", "fits/cloth.json", "cloth.npz").result
    entry = told["parameters"]["stretch"]
    assert told["explains"]
    assert entry["low"] < TRUTH["stretch"] < entry["high"]


def test_it_is_exported_with_that_mesh(record):
    invoke("export", "fits/cloth.json", "--to", "arcsim", "--out", "in_arcsim")
    told = Path("in_arcsim/meshes/cloth/cloth.obj").read_text().splitlines()
    assert sum(line.startswith("v ") for line in told) == 81


def test_a_joint_fit_has_one_mesh_when_recordings_are_left_out_too(work):
    scenario = load_scenario(work / "coarse.yaml")
    write_episode(work / "more.npz", clouds_of(scenario.halved(1), points=3000, seed=6, **TRUTH))
    invoke("fit", "cloth.npz", "more.npz", *OPTIONS, "--joint", "--out", "joint")
    told = json.loads((work / "joint" / "joint.json").read_text())
    assert told["halvings"] == 1
    for one in told["episodes"]:
        assert one["left_out"]["parameters"]["stretch"] == pytest.approx(TRUTH["stretch"], rel=0.1)
        assert one["left_out"]["rms_mm"] < 1.2 * told["rms_mm"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--halvings", 9), "less than or equal to 3"),
        (("--halvings", 1, "--solver", "adam"), "halvings: of solver gauss_newton"),
        (("--halvings", 1, "--paper"), "not of the published measure"),
    ],
)
def test_what_cannot_be_is_refused(work, options, message):
    told = invoke("fit", "cloth.npz", "--scenario", "coarse.yaml", *options, "--out", "never", code=1)
    assert message in told.errors
    assert not (work / "never").exists()
