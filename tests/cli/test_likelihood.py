"""`likelihood` through the commands: other commands take what the fit knows of its uncertainty from its record."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from diffcloud.errors import ConfigError
from diffcloud.estimation.record import read_fit
from diffcloud.evaluation.intervals import intervals_of
from diffcloud.evaluation.methods import space_of
from diffcloud.io.episodes import write_episode
from diffcloud.scene.scenarios import load_scenario
from tests.cli.invoke import invoke
from tests.estimation.test_fit import clouds_of

TRUTH = {"stretching": 0.6, "density": 1.7}
SCENARIO = {
    "base": "lift",
    "nodes": [5, 5],
    "grip": "pivot",
    "frames": 8,
    "steps_per_frame": 3,
    "rate_hz": 10.0,
    "points": 1500,
    "path": [[0, 0, 0, 0], [0.8, 0, -0.1, 0.25]],
}
OPTIONS = (
    "--scene", "small.yaml", "--parameters", "stretching", "--fix", "density=0.34", "--uncertain", "bending=1.5x",
)  # fmt: skip


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    folder = tmp_path_factory.mktemp("likelihood")
    (folder / "small.yaml").write_text(yaml.safe_dump(SCENARIO))
    finer = load_scenario(folder / "small.yaml").finer()
    for seed, name in ((5, "one"), (6, "two")):
        write_episode(folder / f"{name}.npz", clouds_of(finer, points=2000, seed=seed, **TRUTH))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        invoke("fit", "one.npz", "two.npz", *OPTIONS, "--out", "fits")
    return folder


@pytest.fixture(autouse=True)
def here(work, monkeypatch):
    monkeypatch.chdir(work)


def test_the_record_has_what_the_fit_knows():
    record = read_fit(Path("fits/fit.json"))
    told = record.estimate
    assert record.solver == "likelihood"
    assert set(told.mean) == {"stretching"}
    assert {"recording", "prior", "bending", "turn", "pose", "mesh", "time step", "starts"} == set(told.sources)
    assert sum(told.weights) == pytest.approx(1.0)
    assert [len(one.chi_squares) for one in told.recordings] == [len(one.frames) for one in record.episodes]
    assert all(one.left_out.rms_mm < 1.5 * one.rms_mm for one in record.episodes)


def test_intervals_are_those_of_the_record():
    told = json.loads(Path("fits/intervals.json").read_text())
    record = read_fit(Path("fits/fit.json"))
    entry, variance = told["parameters"]["stretching"], sum(part[0][0] for part in record.estimate.sources.values())
    assert entry["value"] == pytest.approx(record.estimate.mean["stretching"] * entry["nominal"])
    assert entry["high"] / entry["value"] == pytest.approx(entry["value"] / entry["low"])
    assert entry["high"] / entry["value"] == pytest.approx(2.718281828 ** (1.6448536 * variance**0.5), rel=1e-4)
    assert entry["low"] < TRUTH["stretching"] * entry["nominal"] < entry["high"]
    assert told["fits_to_noise"]


def test_a_recording_that_the_model_does_not_follow_is_told(tmp_path):
    data = json.loads(Path("fits/fit.json").read_text())
    for one in data["estimate"]["recordings"]:
        one["chi_squares"] = [25.0] * len(one["chi_squares"])
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(data))
    record = read_fit(path)
    told = intervals_of(record, space_of(record), load_scenario("small.yaml"))
    assert not told.fits_to_noise
    assert "in one the cloth is 5.0 times as far from the recording" in told.reason
    assert told.parameters["stretching"].status == "model_error"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": [1.0, 0.5, 0.1, 0.2]}, "starts and weights must be as long as each other"),
        ({"sources": {"recording": [[1.0, 0.0]]}}, "sources must hold"),
    ],
)
def test_a_damaged_estimate_is_refused(tmp_path, change, message):
    data = json.loads(Path("fits/fit.json").read_text())
    data["estimate"] |= change
    (tmp_path / "fit.json").write_text(json.dumps(data))
    with pytest.raises(ConfigError, match=message):
        read_fit(tmp_path / "fit.json")


def test_the_published_measure_has_none():
    known = ("fit", "one.npz", *OPTIONS[:-2], "--loss", "paper", "--out", "papers")
    assert "the paper's loss has no likelihood" in invoke(*known, "--solver", "likelihood", code=1).errors
    invoke(*known, "--max-steps", 1)
    assert read_fit(Path("papers/fit.json")).solver == "adam"
