"""The posterior: its draws and densities belong together, it learns, and its calibration is measured."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import kstest

from diffcloud.errors import CheckpointError, ConfigError
from diffcloud.regressors import Regressor
from diffcloud.regressors.posterior import Posterior
from diffcloud.regressors.training import LEVELS, train_regressor
from diffcloud.reporting.regressors import TrainingEntry, errors_table, training_data
from tests.cli.invoke import invoke
from tests.regressors.simulated import sagging_sheet
from tests.regressors.test_checkpoints import episode, regressor
from tests.regressors.test_training import TINY

SETTINGS = replace(TINY, epochs=12, dropout=0.0, augment=False)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    path = tmp_path_factory.mktemp("trained") / "posterior.safetensors"
    sets = sagging_sheet(96), sagging_sheet(40, seed=1)
    return train_regressor("posterior", *sets, SETTINGS, path, device="cpu"), path


@pytest.fixture
def untrained():
    torch.manual_seed(0)
    return Posterior(2, frames=3, order="nearest", density=0.125).eval()


class TestDensity:
    def test_draws_lie_between_the_bounds_and_are_the_same_for_a_seed(self, untrained):
        clouds = torch.rand(2, 3, 30, 3)
        with torch.no_grad():
            first, again, other = (untrained.sample(clouds, 50, seed) for seed in (0, 0, 1))
        assert first.shape == (2, 50, 2)
        assert bool(((first > 0) & (first < 1)).all())
        assert torch.equal(first, again)
        assert not torch.equal(first, other)

    def test_it_is_that_of_the_draws(self, untrained):
        """Truths drawn from it have uniform ranks in every parameter, and in density."""
        clouds = torch.rand(1, 3, 30, 3)
        with torch.no_grad():
            truths, drawn = (untrained.sample(clouds, 2000, seed)[0] for seed in (0, 1))
            density = untrained.log_density(clouds, torch.cat([truths, drawn])[None])[0]
        denser = (density[None, 2000:] > density[:2000, None]).double().mean(1)
        below = (drawn[None] < truths[:, None]).double().mean(1)
        for ranks in (denser, *below.T):
            assert kstest(ranks.numpy(), "uniform").pvalue > 1e-3

    def test_the_loss_is_its_logarithm(self, untrained):
        clouds, fractions = torch.rand(4, 3, 30, 3), torch.rand(4, 2)
        with torch.no_grad():
            expected = -untrained.log_density(clouds, fractions[:, None]).mean()
            torch.testing.assert_close(untrained.loss(clouds, fractions), expected)


class TestTraining:
    def test_it_learns(self, trained):
        result, _ = trained
        losses = [row["validation_loss"] for row in result.summary["history"]]
        assert min(losses) < losses[0] - 0.5
        for row in result.summary["held_out"]["parameters"].values():
            assert row["mean_error_of_range"] < 0.8 * row["mean_error_of_range_of_median"]
            assert row["coverage"] == sorted(row["coverage"])

    def test_its_calibration_is_measured(self, trained):
        told = trained[0].summary["held_out"]["calibration"]
        assert len(told["expected_coverage"]) == len(LEVELS)
        assert told["expected_coverage"] == sorted(told["expected_coverage"])
        assert all(0 <= p <= 1 for p in told["uniform_ranks"].values())

    def test_intervals_are_quantiles_of_its_draws(self, trained):
        found = Regressor.read(trained[1]).predict_prepared(torch.rand(2, 4, 24, 3))
        low, high = found.interval(0.8)
        inside = ((found.samples >= low[:, None]) & (found.samples <= high[:, None])).double().mean(1)
        torch.testing.assert_close(inside, torch.full_like(inside, 0.8), rtol=0, atol=0.003)
        torch.testing.assert_close(found.values, found.samples.quantile(0.5, dim=1))

    def test_the_report_shows_its_calibration(self, trained):
        entry = TrainingEntry("lift", "posterior", trained[0].summary)
        (told,) = training_data([entry])
        assert list(told["coverage"]) == ["stretching", "density", "all together"]
        rows = errors_table([entry]).rows
        assert [row[-1].note.startswith("ranks uniform: p = ") for row in rows] == [True, True]

    @pytest.mark.parametrize("changes", [{"predict_variance": True}, {"loss": "raw"}])
    def test_what_belongs_to_other_models_is_refused(self, tmp_path, changes):
        sets = sagging_sheet(24), sagging_sheet(10, seed=1)
        with pytest.raises(ConfigError, match="its own loss and predicts its own widths"):
            train_regressor("posterior", *sets, replace(TINY, **changes), tmp_path / "m.safetensors", device="cpu")


def test_without_sbi_it_is_said_what_to_install(tmp_path, monkeypatch):
    regressor("posterior").write(tmp_path / "posterior.safetensors")
    monkeypatch.setitem(sys.modules, "sbi.neural_nets.net_builders", None)
    with pytest.raises(ConfigError, match=r"pip install 'diffcloud\[posterior\]'"):
        Posterior(2, frames=3)
    with pytest.raises(CheckpointError, match=r"posterior\.safetensors: The model posterior needs sbi"):
        Regressor.read(tmp_path / "posterior.safetensors")


class TestCommand:
    @pytest.fixture
    def files(self, tmp_path):
        from diffcloud.io.episodes import write_episode

        write_episode(tmp_path / "e.npz", episode())
        for model in ("posterior", "meteornet"):
            regressor(model).write(tmp_path / f"{model}.safetensors")
        return tmp_path

    def test_draws_are_written(self, files):
        told = invoke(
            "network", "predict", files / "e.npz", "--checkpoint", files / "posterior.safetensors",
            "--samples", files / "s.csv",
        )  # fmt: skip
        rows = np.genfromtxt(files / "s.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
        assert set(rows["episode"]) == {"e"}
        found = told.result["e"]
        assert found["stretching"] == pytest.approx(float(np.median(rows["stretching"])), rel=1e-3)
        low, high = found["interval"]["density"]
        assert np.mean((rows["density"] >= low) & (rows["density"] <= high)) == pytest.approx(0.9, abs=0.01)

    def test_other_models_have_none(self, files):
        told = invoke(
            "network", "predict", files / "e.npz", "--checkpoint", files / "meteornet.safetensors",
            "--samples", files / "s.csv",
            code=1,
        )  # fmt: skip
        assert "--samples needs a posterior" in told.errors
        assert not (files / "s.csv").exists()
