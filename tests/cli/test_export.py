"""`diffcloud export`: from a fit to another simulator, and every refusal before anything is written."""

from __future__ import annotations

import contextlib
import json
import shutil

import numpy as np
import pytest
import yaml

from diffcloud.io.episodes import write_episode
from diffcloud.scene.scenarios import load_scenario
from tests.cli.invoke import invoke
from tests.cli.test_commands import SMALL
from tests.conftest import small_lift
from tests.estimation.test_fit import clouds_of

MATERIAL = {"density_kg_m2": 0.2, "stretching_n_m": 50.0, "bending_n_m": 1e-5, "poisson": 0.3}


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A joint fit beside its scenario, as `fit` leaves it, and intervals of it."""
    root = tmp_path_factory.mktemp("fitted")
    (root / "scenes").mkdir()
    (root / "scenes" / "small.yaml").write_text(yaml.safe_dump({**SMALL, "material": MATERIAL}))
    for name, stretch in (("e1", 0.7), ("e2", 0.8)):
        write_episode(root / f"{name}.npz", clouds_of(small_lift(), stretching=stretch, density=1.0))
    with contextlib.chdir(root):
        options = ("--scene", "scenes/small.yaml", "--parameters", "stretching,bending", "--out", ".")
        invoke("fit", *options, "--max-steps", 1, "e1.npz", "e2.npz")
    told = {
        "level": 0.9, "within": 1.5, "ratio": None, "best": None, "worst": None, "sources": {},
        "covariance": [[0.04, 0.0], [0.0, 0.01]], "fits_to_noise": True, "reason": "",
        "parameters": {
            name: {
                "value": nominal, "low": 0.5 * nominal, "high": 2 * nominal, "unit": unit, "nominal": nominal,
                "factor": 2.0, "at_bounds": [], "status": "identified",
            }
            for name, nominal, unit in (("stretching", 50.0, "N/m"), ("bending", 1e-5, "N·m"))
        },
    }  # fmt: skip
    (root / "intervals.json").write_text(json.dumps(told))
    return root


@pytest.fixture
def work(fitted, tmp_path):
    shutil.copytree(fitted, tmp_path / "work")
    with contextlib.chdir(tmp_path / "work"):
        yield tmp_path / "work"


def test_a_fit_finds_its_scenario_and_says_what_it_leaves_out(work):
    done = invoke("export", "fit.json", "--to", "mujoco", "--recording", "e2", "--out", "out")
    assert sorted(path.name for path in (work / "out").iterdir()) == sorted(done.result["files"])
    told = json.loads((work / "out" / "cloth.json").read_text())
    record = json.loads((work / "fit.json").read_text())
    assert told["recording"] == "e2"
    assert told["material"] == record["material"]
    assert told["isotropic_sheet"]["stretching_n_m"] == pytest.approx(record["parameters"]["stretching"]["value"])
    assert told["left_out"] == done.result["left_out"]
    assert "There is no air" in done.errors
    assert len(done.result["simplified_rms_mm"]) == 6
    assert "leaves out moves the cloth by" in done.errors


def test_the_first_recording_is_the_default_and_said(work):
    assert "The motion is that of e1, the first of 2" in invoke("export", "fit.json", "--to", "obj", "--out", "out").errors


def test_samples_spread_as_the_intervals_do(work):
    done = invoke("export", "fit.json", "--to", "obj", "--samples", 200, "--seed", 3, "--out", "out")
    assert len(list((work / "out").glob("sample_*/cloth.json"))) == 200
    logs = np.log([[drawn["stretching"] / 50, drawn["bending"] / 1e-5] for drawn in done.result["samples"]])
    np.testing.assert_allclose(logs.std(axis=0), [0.2, 0.1], rtol=0.2)
    np.testing.assert_allclose(logs.mean(axis=0), 0.0, atol=0.06)
    last = json.loads((work / "out" / "sample_0199" / "cloth.json").read_text())
    assert last["parameters"]["stretching"] == done.result["samples"][-1]["stretching"]
    assert last["isotropic_sheet"]["stretching_n_m"] == pytest.approx(last["parameters"]["stretching"])
    again = invoke("export", "fit.json", "--to", "obj", "--samples", 3, "--seed", 3, "--out", "again")
    assert again.result["samples"] == done.result["samples"][:3]


def test_a_second_export_takes_the_place_of_the_first_and_of_nothing_else(work):
    invoke("export", "fit.json", "--to", "mujoco", "--samples", 3, "--out", "out")
    (work / "out" / "sample_0002" / "nodes.npz").write_bytes(b"mine")
    (work / "out" / "mine.txt").write_text("mine")
    invoke("export", "fit.json", "--to", "obj", "--samples", 1, "--out", "out")
    there = {path.relative_to(work / "out").as_posix() for path in (work / "out").rglob("*") if path.is_file()}
    own = {f"{folder}{name}" for folder in ("", "sample_0000/") for name in ("cloth.obj", "held.csv", "cloth.json")}
    assert there == own | {"mine.txt", "sample_0002/nodes.npz"}


class TestRefusals:
    @pytest.mark.parametrize(
        ("command", "message"),
        [
            (("nothing.json", "--to", "obj"), "nothing.json"),
            (("intervals.json", "--to", "obj"), "is not a fit written by"),
            (("fit.json", "--to", "obj", "--recording", "e3"), "Unknown recording of the fit 'e3'"),
            (("fit.json", "--to", "obj", "--check"), "--check runs mujoco and newton; obj cannot be run"),
        ],
    )
    def test_say_what_is_wrong_and_write_nothing(self, work, command, message):
        assert message in invoke("export", *command, "--out", "out", code=1).errors
        assert not (work / "out").exists() or not any((work / "out").iterdir())

    def test_a_scenario_that_is_not_there(self, work):
        shutil.rmtree(work / "scenes")
        assert "Put its YAML file into" in invoke("export", "fit.json", "--to", "obj", "--out", "o", code=1).errors

    def test_a_missing_motion(self, work):
        (work / "fit.npz").unlink()
        assert "No such motion of a fit" in invoke("export", "fit.json", "--to", "obj", "--out", "o", code=1).errors

    def test_a_simulator_that_is_not_installed(self, work, monkeypatch):
        import diffcloud.cli.export

        monkeypatch.setattr(diffcloud.cli.export.importlib.util, "find_spec", lambda name: None)
        told = invoke("export", "fit.json", "--to", "newton", "--check", "--out", "o", code=1).errors
        assert "pip install 'diffcloud[simulators]'" in told

    def test_intervals_that_say_nothing(self, work):
        told = json.loads((work / "intervals.json").read_text())
        (work / "intervals.json").write_text(json.dumps({**told, "reason": "the cloth is far from the recording"}))
        command = ("export", "fit.json", "--to", "obj", "--samples", 2, "--out", "o")
        assert "Nothing can be drawn" in invoke(*command, code=1).errors
        (work / "intervals.json").write_text((work / "fit.json").read_text())
        assert "holds no intervals" in invoke(*command, code=1).errors
        del told["parameters"]["bending"]
        (work / "intervals.json").write_text(json.dumps(told))
        assert "holds intervals of stretching; the fit is of stretching, bending" in invoke(*command, code=1).errors


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "target", [pytest.param("mujoco", marks=pytest.mark.slow), pytest.param("newton", marks=pytest.mark.longest)]
)
def test_the_export_runs_and_moves_as_fitted(target, tmp_path, monkeypatch):
    """A lift of two and a half seconds. After 1.2 s the cloth buckles, one way or the other."""
    pytest.importorskip(target)
    monkeypatch.chdir(tmp_path)
    write_episode(tmp_path / "lift.npz", clouds_of(load_scenario("lift"), stretching=1.2, density=0.45))
    quick = ("--starts", 1, "--max-steps", 1, "--init", "stretching=4.8,density=0.09")
    invoke("fit", "--scene", "lift", "--out", ".", *quick, "lift.npz")
    done = invoke("export", "fit.json", "--to", target, "--check", "--out", "out")
    assert done.result["strip_error"] < 0.05
    assert done.result["cantilever_error"] < 0.05
    times = np.array(done.result["times_s"])
    assert times[-1] >= 2
    assert max(np.array(done.result["rms_mm"])[times <= 1.2]) < 10
