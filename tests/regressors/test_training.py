"""Training: the loss, equal runs, interruptions, and what is measured."""

from __future__ import annotations

import subprocess
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.errors import ConfigError, TrainingError
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.regressors import MODEL_NAMES, PROFILE_NAMES, Regressor, TrainingSettings, profile_settings
from diffcloud.regressors.checkpoints import OutputScale
from diffcloud.regressors.training import parameter_loss, train_regressor
from tests.regressors.simulated import sagging_sheet

TINY = TrainingSettings(
    epochs=4, batch_size=8, points=24, density=0.125, order="nearest", schedule="cosine", dropout=0.1, seed=3
)  # dropout, so that equal runs need equal random numbers


def train(tmp_path, model="mlp", settings=TINY, name="m", **options):
    """On 24 made-up draws; the last state is kept after every epoch."""
    return train_regressor(model, sagging_sheet(24), sagging_sheet(10, seed=1), settings, tmp_path / f"{name}.safetensors",
                           device="cpu", **options)  # fmt: skip


@pytest.fixture(autouse=True)
def saved_after_every_epoch(monkeypatch):
    monkeypatch.setattr("diffcloud.regressors.training._SAVE_EVERY_S", 0.0)


@pytest.mark.parametrize("model", MODEL_NAMES)
def test_one_seed_gives_equal_losses_and_equal_files(tmp_path, model):
    first, second = (train(tmp_path, model, name=name) for name in ("a", "b"))
    assert first.summary["history"] == second.summary["history"]
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert files
    for path in files:
        assert (tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes()
    other = train(tmp_path, model, replace(TINY, seed=4, epochs=1), name="c")
    assert other.summary["history"][0] != first.summary["history"][0]


@pytest.mark.parametrize("after", [1, 3])
def test_a_run_that_was_stopped_ends_as_if_it_had_not_been(tmp_path, after):
    whole = train(tmp_path, name="whole")

    def stop(progress):
        if progress.epoch == after + 1:  # while this epoch ends: it is not saved yet
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, progress=stop)
    assert not (tmp_path / "m.safetensors").exists()
    seen = []
    again = train(tmp_path, progress=lambda progress: seen.append(progress.epoch))
    assert again.resumed_from == after
    assert seen == list(range(after + 1, 5))
    assert again.summary["history"] == whole.summary["history"]
    assert (tmp_path / "m.safetensors").read_bytes() == (tmp_path / "whole.safetensors").read_bytes()
    for name in ("metrics.json", "plots/metrics/validation_loss.tsv"):
        assert (tmp_path / "m" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert [path.name for path in tmp_path.glob(".m.*")] == [".m.timings.json"]  # nothing is left behind


def test_other_settings_and_damaged_states_start_anew(tmp_path):
    def stop(progress):
        if progress.epoch == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, progress=stop)
    assert train(tmp_path, settings=replace(TINY, epochs=2), name="m").resumed_from == 0
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, progress=stop)
    (state,) = tmp_path.glob(".m.*.resume")
    state.write_bytes(state.read_bytes()[:5000])
    assert train(tmp_path).resumed_from == 0
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, progress=stop, mark="older code")
    assert train(tmp_path, mark="newer code").resumed_from == 0


def test_it_learns_and_the_best_epoch_is_kept(tmp_path):
    settings = replace(TINY, epochs=12, dropout=0.0, augment=False, points=48)
    result = train_regressor(
        "mlp", sagging_sheet(96), sagging_sheet(20, seed=1), settings, tmp_path / "m.safetensors", device="cpu"
    )
    losses = [row["validation_loss"] for row in result.summary["history"]]
    assert result.summary["best_epoch"] == 1 + int(np.argmin(losses))
    held_out = result.summary["held_out"]
    assert held_out["draws"] == 12
    for row in held_out["parameters"].values():
        assert row["mean_error_of_range"] < 0.6 * row["mean_error_of_range_of_median"]
        assert row["coverage"] == sorted(row["coverage"])
    read = Regressor.read(tmp_path / "m.safetensors")
    clouds = torch.rand(1, 1, 48, 3)
    assert torch.equal(read.predict(clouds).values, result.regressor.predict(clouds).values)


def test_a_patient_training_stops_early(tmp_path):
    # a learning rate this small cannot improve: the second epoch is the last but for the statistics' drift
    result = train(tmp_path, settings=replace(TINY, epochs=50, learning_rate=1e-12, schedule="constant", patience=1))
    assert len(result.summary["history"]) < 50


def test_a_width_per_prediction_can_be_learned(tmp_path):
    result = train(tmp_path, settings=replace(TINY, predict_variance=True, target="logarithmic", draws=16))
    found = result.regressor.predict(torch.rand(4, 1, 24, 3))
    assert found.width.shape == (4, 2)
    assert len(set(found.width[:, 0].tolist())) == 4
    assert (found.values > 0).all()
    assert result.summary["description"]["training"]["draws"] == 16


def test_losses_are_those_of_their_names():
    bounds = torch.tensor([[0.1, 10.0], [1.0, 3.0]])
    scale = OutputScale(bounds, "linear")
    outputs, true = torch.tensor([[0.5, 0.25]]), torch.tensor([[0.4, 0.75]])
    assert parameter_loss(outputs, true, scale, loss="normalised").item() == pytest.approx((0.1 + 0.5) / 2)
    assert parameter_loss(outputs, true, scale, loss="raw").item() == pytest.approx((0.99 + 1.0) / 2)
    # with widths: minus the logarithm of a Laplace density, up to log 2
    widths = torch.tensor([[0.2, 0.7]])
    density = torch.distributions.Laplace(outputs, widths).log_prob(true)
    found = parameter_loss(torch.cat([outputs, widths.log()], dim=1), true, scale, loss="normalised")
    assert found.item() == pytest.approx(-density.mean().item() - np.log(2), rel=1e-5)


def test_clouds_fill_the_unit_sphere_whatever_their_size(tmp_path):
    told = train(tmp_path, settings=replace(TINY, epochs=1)).regressor.description
    small = sagging_sheet(24)
    small = replace(small, nodes=0.1 * small.nodes + 7, length_unit_m=10.0)  # the same noise in its own lengths
    again = train_regressor(
        "mlp", small, replace(sagging_sheet(10), length_unit_m=10.0), replace(TINY, epochs=1), tmp_path / "s.safetensors",
        device="cpu",
    ).regressor.description  # fmt: skip
    assert again.length == pytest.approx(0.1 * told.length, rel=1e-4)
    assert again.centre == pytest.approx([0.1 * value + 7 for value in told.centre], rel=1e-4)


class TestBadInput:
    def test_sets_that_do_not_belong_together(self, tmp_path):
        with pytest.raises(ConfigError, match="different scenarios"):
            train_regressor("mlp", sagging_sheet(8), sagging_sheet(8, scenario="fold"), TINY, tmp_path / "m.safetensors")
        with pytest.raises(ConfigError, match="at least 2 train and 4 test draws, got 8 and 3"):
            train_regressor("mlp", sagging_sheet(8), sagging_sheet(3), TINY, tmp_path / "m.safetensors")

    def test_widths_in_units_of_a_logarithmic_target(self, tmp_path):
        settings = replace(TINY, predict_variance=True, loss="raw", target="logarithmic")
        with pytest.raises(ConfigError, match="Use target: linear, or loss: normalised"):
            train(tmp_path, settings=settings)

    def test_a_loss_that_is_no_number(self, tmp_path):
        with pytest.raises(TrainingError, match=r"The losses of epoch \d are .* Try a learning rate below 1e\+30"):
            train(tmp_path, settings=replace(TINY, learning_rate=1e30))
        assert not (tmp_path / "m.safetensors").exists()

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"epochs": 0}, "epochs must be at least 1, got 0"),
            ({"batch_size": 1}, "batch_size must be at least 2"),
            ({"density": 1.5}, "density must be above 0 and at most 1, got 1.5"),
            ({"dropout": 1.0}, "dropout must be at least 0 and below 1"),
            ({"learning_rate": -1.0}, "learning_rate must be positive"),
        ],
    )
    def test_settings_out_of_range(self, changes, message):
        with pytest.raises(ConfigError, match=message):
            profile_settings("quick", "mlp", **changes)

    def test_unknown_names(self):
        with pytest.raises(ConfigError, match=r"Unknown profile 'fast'\. Allowed: paper, quick, reduced"):
            profile_settings("fast", "mlp")
        with pytest.raises(ConfigError, match="Unknown model 'cnn'"):
            profile_settings("quick", "cnn")
        assert all(profile_settings(profile, model).points for profile in PROFILE_NAMES for model in MODEL_NAMES)


def test_a_git_folder_around_it_is_left_alone(tmp_path, monkeypatch):
    """DVCLive on its own makes it a DVC repository."""
    repository = tmp_path / "repository"
    subprocess.run(["git", "init", "--quiet", str(repository)], check=True)
    before = sorted(repository.rglob("*"))
    monkeypatch.chdir(repository)
    train(tmp_path, settings=replace(TINY, epochs=1))
    assert sorted(repository.rglob("*")) == before
    assert (tmp_path / "m" / "plots" / "metrics" / "validation_loss.tsv").exists()


def test_the_background_is_learned_without_and_kept_for_predictions(tmp_path):
    pole = SurfaceMesh(np.array([[5.0, 0, 0], [6, 0, 0], [5, 0, 9]]), np.array([[0, 1, 2]]))
    sets = [replace(sagging_sheet(runs, seed=seed), obstacle=pole) for runs, seed in ((24, 0), (10, 1))]
    lengths = {}
    for subtract in (True, False):
        settings = replace(TINY, epochs=1, subtract_background=subtract)
        told = train_regressor("mlp", *sets, settings, tmp_path / "m.safetensors", device="cpu").regressor.description
        assert (told.background is not None) == subtract
        lengths[subtract] = told.length
    assert lengths[True] < 2 < 5 < lengths[False]
