"""`import diffcloud as dc`, from a recording to an exported cloth."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import diffcloud as dc
from diffcloud.estimation.record import read_fit
from diffcloud.io.episodes import write_episode
from diffcloud.mesh import grid_cloth
from diffcloud.scene.scenarios import load_scenario
from tests.cli.invoke import invoke
from tests.cli.test_likelihood import SCENARIO
from tests.estimation.test_fit import clouds_of

TRUTH = {"stretching": 0.6, "density": 1.7}
SETTINGS = dc.FitSettings(parameters=["stretching"], fixed={"density": 0.34}, solver={"starts": 1})


@pytest.fixture(scope="module")
def scene() -> dc.Scene:
    return dc.Scene("small", {**SCENARIO, "grip_m": 0.02}, SETTINGS)


@pytest.fixture(scope="module")
def recording(scene) -> dc.Episode:
    return clouds_of(scene.scenario.finer(), points=2000, **TRUTH)


@pytest.fixture(scope="module")
def found(scene, recording) -> dc.Fit:
    return dc.fit(recording, scene)


class TestImport:
    def test_it_is_quick_and_brings_no_torch(self):
        code = "import sys, diffcloud as dc; print('torch' in sys.modules, 'numpy' in sys.modules, callable(dc.fit))"
        told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
        assert told.stdout.split() == ["False", "False", "True"]

    def test_what_is_public_is_there_and_explained(self):
        assert set(dir(dc)) == {*dc.__all__, "__version__"}
        for name in dc.__all__:
            assert inspect.getdoc(getattr(dc, name)), name
        with pytest.raises(AttributeError, match="no attribute 'fits'"):
            _ = dc.fits


class TestFit:
    def test_it_is_in_si_units(self, scene, found):
        stretching = found.parameters["stretching"]
        nominal = scene.scenario.scene.nominal("stretching")
        assert stretching.unit == "N/m"
        assert stretching.interval[0] < TRUTH["stretching"] * nominal < stretching.interval[1]
        assert stretching.value == pytest.approx(found.record.estimate.mean["stretching"] * nominal)
        assert found.status == "fits_to_noise"
        assert 0 < found.residual < 0.01
        assert 0 < found.horizons["small"] <= 0.8
        assert str(stretching) in str(found)

    def test_it_is_the_commands_fit_to_the_last_bit(self, scene, recording, found, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        Path("small.yaml").write_text(yaml.safe_dump(dict(scene.options)))
        write_episode(Path("small.npz"), recording)
        options = ("--scene", "small.yaml", "--parameters", "stretching", "--fix", "density=0.34", "--starts", 1)
        invoke("fit", *options, "--out", "fits", "small.npz")
        record = read_fit(Path("fits/fit.json"))
        assert record.values == found.record.values
        assert record.estimate == found.record.estimate

    def test_samples_spread_as_the_interval_does(self, found):
        drawn = found.sample(4000, seed=1)["stretching"]
        low, high = found.parameters["stretching"].interval
        assert ((drawn > low) & (drawn < high)).mean() == pytest.approx(0.9, abs=0.02)

    def test_it_is_saved_as_the_commands_read_it(self, found, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        assert read_fit(found.save("saved")).values == found.record.values
        invoke("export", "saved/fit.json", "--to", "obj", "--out", "obj", "--samples", 1)
        assert Path("obj/sample_0000/cloth.json").is_file()

    def test_it_is_exported(self, found, tmp_path):
        folder = dc.export(found, "arcsim", tmp_path / "out", samples=2)
        told = json.loads((folder / "sample_0001" / "cloth.json").read_text())
        assert told["parameters"]["stretching"] != found.parameters["stretching"].value
        assert (folder / "cloth.json").is_file()

    def test_other_solvers_know_no_uncertainty(self, scene, recording):
        settings = dc.FitSettings(
            parameters=["stretching"], fixed={"density": 0.34}, solver={"name": "random_search", "max_simulations": 3}
        )
        told = dc.fit([recording], [scene], settings)
        assert told.parameters["stretching"].interval is None
        assert told.status == "not_converged"
        with pytest.raises(dc.DiffCloudError, match="likelihood"):
            told.sample(2)

    def test_each_recording_takes_a_scene(self, scene, recording):
        with pytest.raises(dc.DiffCloudError, match="2 recordings and 1 scenes"):
            dc.fit([recording, recording], [scene])
        with pytest.raises(dc.DiffCloudError, match="Two scenes are named small"):
            dc.fit([recording, recording], [scene, scene])


class TestScene:
    def test_a_built_in_one_and_a_file(self, scene, tmp_path):
        assert dc.Scene.load("lift").scenario.name == "lift"
        (tmp_path / "mine.yaml").write_text(yaml.safe_dump(dict(scene.options)))
        mine = dc.Scene.load(tmp_path / "mine.yaml")
        assert mine.name == "mine"
        assert mine.scenario.frames == load_scenario(tmp_path / "mine.yaml").frames
        with pytest.raises(dc.DiffCloudError, match="lft"):
            dc.Scene.load("lft")
        (tmp_path / "damaged.yaml").write_text("nodes: [5,")
        with pytest.raises(dc.DiffCloudError, match=r"damaged\.yaml"):
            dc.Scene.load(tmp_path / "damaged.yaml")

    def test_a_motion_changes_with_its_material_as_its_gradient_says(self, scene):
        def height(stretching):
            return scene.simulate({"stretching": stretching, "density": 0.2}, seconds=0.5).positions[:, -1, :, 2].mean(-1)

        at = torch.tensor([4.0, 8.0], dtype=torch.float64, requires_grad=True)
        (slope,) = torch.autograd.grad(height(at).sum(), at)
        with torch.no_grad():
            central = (height(at + 1e-4) - height(at - 1e-4)) / 2e-4
        torch.testing.assert_close(slope, central, rtol=1e-4, atol=1e-9)
        assert bool((slope != 0).all())

    def test_quantities_are_in_si_units(self, scene):
        nominal = scene.scenario.scene.nominal("stretching")
        stated = scene.simulate({"stretching": nominal}, seconds=0.3)
        torch.testing.assert_close(stated.positions, scene.simulate(seconds=0.3).positions)
        with pytest.raises(dc.DiffCloudError, match="Unknown quantity 'stretch'"):
            scene.simulate({"stretch": 1.0})


class TestRecordings:
    def test_a_file_and_a_folder(self, recording, tmp_path):
        write_episode(tmp_path / "one.npz", recording)
        assert dc.load_recording(tmp_path / "one.npz").frame_count == recording.frame_count
        folder = tmp_path / "clouds"
        folder.mkdir()
        for number in range(3):
            np.save(folder / f"{number:03d}.npy", recording.frame(number))
        with pytest.raises(dc.DiffCloudError, match=r"gripper\.csv"):
            dc.load_recording(folder)
        (folder / "gripper.csv").write_text("t_s,x,y,z\n0,0,0,0\n0.1,0,0,0.01\n0.2,0,0,0.02\n")
        assert dc.load_recording(folder).frame_count == 3
        with pytest.raises(dc.DiffCloudError, match="No such recording"):
            dc.load_recording(tmp_path / "nothing")


class TestSurfaces:
    def test_points_follow_the_nodes(self):
        mesh = grid_cloth(3, 3, 0.2, 0.2)
        nodes = torch.tensor(mesh.nodes, dtype=torch.float64, requires_grad=True)
        points = dc.sample_surface(nodes, mesh.faces, 50, seed=3)
        assert points.shape == (50, 3)
        moved = dc.sample_surface(nodes + torch.tensor([0.0, 0.0, 0.1]), mesh.faces, 50, seed=3)
        torch.testing.assert_close(moved - points, torch.tensor([0.0, 0.0, 0.1]).double().expand(50, 3))
        loss = dc.chamfer(moved, points.detach().numpy())
        assert float(loss.detach()) == pytest.approx(0.01, rel=0.3)
        (slope,) = torch.autograd.grad(loss, nodes)
        assert float(slope[:, 2].sum()) == pytest.approx(0.2, rel=0.3)
