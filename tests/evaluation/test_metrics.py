"""Metrics against the objective that a fit sees, and a whole episode with all methods."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch

from diffcloud.clouds import NeighbourIndex, chamfer
from diffcloud.errors import DivergedError
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.record import History
from diffcloud.estimation.result import describe_fit
from diffcloud.estimation.solvers import AdamSettings, RandomSearchSettings, fit_adam, solve
from diffcloud.evaluation.episode import compare_episode
from diffcloud.evaluation.landscape import loss_landscape
from diffcloud.evaluation.methods import Estimate, Gap
from diffcloud.evaluation.metrics import EpisodeMeter, success_threshold
from diffcloud.evaluation.settings import ComparisonSettings
from diffcloud.io.episodes import Episode
from tests.conftest import paper_objective, small_lift
from tests.estimation.test_fit import clouds_of

TRUTH = {"stretching": 0.8, "density": 1.5}
OTHER = {"stretching": 4.0, "density": 0.4}


@pytest.fixture(scope="module")
def scenario():
    return small_lift()


@pytest.fixture(scope="module")
def episode(scenario):
    return clouds_of(scenario, **TRUTH)


def batch(*sets):
    return {name: torch.tensor([values[name] for values in sets], dtype=torch.float64) for name in sets[0]}


@pytest.fixture(scope="module")
def rows(scenario, episode):
    return EpisodeMeter(Objective(scenario, episode, frames=[-1], paper=True), draws=2, seed=7).measure([TRUTH, OTHER]).rows


class TestMeter:
    def test_loss_is_the_fits_with_fresh_points(self, scenario, episode, rows):
        with torch.no_grad():
            found = [paper_objective(scenario, episode, seed=seed)(batch(TRUTH, OTHER)) for seed in (7, 8)]
        torch.testing.assert_close(torch.tensor([row["loss"] for row in rows]).double(), torch.stack(found).mean(0))
        assert rows[1]["loss_deviation"] == pytest.approx(float(torch.stack(found).std(0)[1]))
        assert rows[1]["rms_mm"] == pytest.approx(1e3 * math.sqrt(rows[1]["loss"]))

    def test_other_frames_are_all_but_the_first_and_the_fits(self, scenario, episode, rows):
        with torch.no_grad():
            found = paper_objective(scenario, episode, frames=[1, 2, 3, 4], seed=7)(batch(TRUTH, OTHER))
        torch.testing.assert_close(torch.tensor([row["loss_other_frames"] for row in rows]).double(), found)

    def test_two_sided_is_both_directions(self, scenario, episode, rows):
        objective = paper_objective(scenario, episode, seed=7)
        with torch.no_grad():
            points = objective.points(objective.simulate(batch(OTHER)))[:, 0]
        target = NeighbourIndex(torch.as_tensor(episode.frame(-1)).double())
        assert rows[1]["two_sided"] == pytest.approx(float(chamfer(points, [target])))

    def test_errors_vanish_at_the_truth(self, rows):
        assert [rows[0][f"error_{name}"] for name in ("stretching", "density", "ratio")] == pytest.approx([0, 0, 0])
        assert rows[1]["error_stretching"] == pytest.approx(4.0)
        assert rows[1]["error_ratio"] == pytest.approx(10.0 / (0.8 / 1.5) - 1)

    def test_success_is_below_the_papers_threshold(self, scenario, rows):
        assert success_threshold(scenario) == pytest.approx(0.0005 * 0.35**2)
        assert [row["success"] for row in rows] == [row["loss"] < success_threshold(scenario) for row in rows]

    def test_one_that_diverges_after_the_fits_frames_is_measured_at_these(self, scenario, episode, monkeypatch):
        objective = Objective(scenario, episode, frames=[2], paper=True)
        whole = EpisodeMeter(objective, draws=2, seed=7).measure([TRUTH, OTHER])

        def until(self, parameters, *, steps=None):
            if steps is None or steps > self.loss_steps:
                late = (parameters["stretching"] > 3).nonzero().flatten().tolist()
                if late:
                    raise DivergedError(self.loss_steps + 1, late, "later")
            return simulate(self, parameters, steps=steps)

        simulate = Objective.simulate
        monkeypatch.setattr(Objective, "simulate", until)
        found = EpisodeMeter(objective, draws=2, seed=7).measure([TRUTH, OTHER])
        assert found.diverged == {}
        assert found.rows[0] == pytest.approx(whole.rows[0])
        assert found.rows[1]["loss"] == pytest.approx(whole.rows[1]["loss"])
        assert whole.rows[1].keys() - found.rows[1].keys() == {"loss_other_frames", "rms_other_frames_mm"}

    def test_one_that_diverges_costs_only_itself(self, scenario, episode, rows):
        meter = EpisodeMeter(Objective(scenario, episode, frames=[-1], paper=True), draws=2, seed=7)
        found = meter.measure([TRUTH, {"stretching": -1e9, "density": 1.0}, OTHER])
        assert list(found.diverged) == [1]
        assert "diverged at step" in found.diverged[1]
        assert found.rows[1] == {}
        assert found.rows[2]["loss"] == pytest.approx(rows[1]["loss"], rel=1e-9)

    def test_an_episode_of_the_loss_frame_alone(self, scenario, episode):
        short = Episode.from_frames([episode.frame(0), episode.frame(-1)], episode.times[[0, -1]])
        row = EpisodeMeter(Objective(scenario, short, frames=[-1], paper=True), draws=1).measure([TRUTH]).rows[0]
        assert "loss_other_frames" not in row
        assert "success" not in row  # nothing is known of it
        assert row["loss_deviation"] == 0.0


def test_landscape_is_the_loss_on_a_grid(scenario, episode):
    objective, space = paper_objective(scenario, episode), FitSpace.build(["stretching", "density"])
    waiting = [5.0, 5.0]  # of a start that nobody followed
    values = [[[1.0, 2.0], [None, None], waiting], [[1.1, 2.1], [3.0, 3.0], waiting]]
    losses = [[1.0, None, None], [0.9, 0.8, None]]
    history = History(names=["stretching", "density"], loss=losses, values=values, gradient_norm=[])
    found = loss_landscape(objective, space, TRUTH, history, size=3)
    assert found["x"] == pytest.approx([0.1, 1.0, 10.0])
    with torch.no_grad():
        expected = objective({"stretching": torch.tensor([10.0]).double(), "density": torch.tensor([1.0]).double()})
    assert found["loss"][1][2] == pytest.approx(float(expected), rel=1e-9)
    assert found["paths"] == [[[1.0, 2.0], [1.1, 2.1]], [[3.0, 3.0]]]
    assert loss_landscape(objective, FitSpace.build(["density"]), TRUTH, history, size=3) is None


@pytest.fixture(scope="module")
def summary(scenario, episode):
    objective, space = paper_objective(scenario, episode), FitSpace.build(["stretching", "density"])
    settings = AdamSettings(max_steps=3, starts=2)
    outcome = fit_adam(objective, space, settings)
    return describe_fit(objective, space, settings, outcome, episodes=["e"]).record


@pytest.fixture(scope="module")
def found(scenario, episode, summary):
    predictions = [
        Estimate("mlp", {"stretching": 99.0, "density": 1.0}, seconds={"inference": 0.1}),
        Gap("meteornet", "lost"),
    ]
    return compare_episode(
        scenario,
        episode,
        summary,
        name="e",
        predictions=predictions,
        transfers={"e0": TRUTH},
        settings=ComparisonSettings(draws=2, landscape_size=3),
    )


class TestEpisode:
    def test_all_methods_are_there_and_measured(self, found, summary):
        rows = {row["method"]: row for row in found.record["methods"]}
        assert list(rows) == ["diffcloud", "single_start", "middle", "random_search", "cma_es", "mlp"]
        assert [row["simulations"] for row in rows.values()] == [8, 4, 0, 4, 4, 0]
        assert rows["mlp"]["clipped"] == {"stretching": 10.0, "density": 1.0}
        assert not rows["mlp"]["inside"]
        assert rows["diffcloud"]["clipped"] == summary.values
        assert found.record["gaps"] == [{"method": "meteornet", "reason": "lost", "expected": True}]
        assert found.seconds["mlp"] == {"inference": 0.1}
        assert found.seconds["diffcloud"] == {"optimisation": summary.seconds}

    def test_the_start_is_measured_as_the_methods_are(self, scenario, episode, found, summary):
        meter = EpisodeMeter(Objective(scenario, episode, paper=True), draws=2)
        assert found.record["start"] == pytest.approx(meter.measure([summary.start]).rows[0])

    def test_transfer_is_measured_as_the_methods_are(self, found):
        (row,) = found.record["transfers"]
        assert row["source"] == "e0"
        assert row["loss"] <= min(one["loss"] for one in found.record["methods"])  # these are the true parameters

    def test_the_record_is_plain_and_holds_no_wall_time(self, found):
        text = json.dumps(found.record, allow_nan=False)
        assert "seconds" not in text
        assert found.record["intervals"] is None  # Adam knows none
        assert np.array(found.record["landscape"]["loss"]).shape == (3, 3)

    def test_a_fit_by_a_search_is_compared_as_others_are(self, scenario, episode):
        objective, space = Objective(scenario, episode, seed=1000), FitSpace.build(["stretching", "density"])
        settings = RandomSearchSettings(max_simulations=6, seed=1000)
        summary = describe_fit(objective, space, settings, solve(objective, space, settings), episodes=["e"]).record
        chosen = ComparisonSettings(draws=1, seed=1000, level=None, landscape_size=2)
        record = compare_episode(scenario, episode, summary, name="e", settings=chosen).record
        rows = {row["method"]: row for row in record["methods"]}
        assert [row["simulations"] for row in rows.values()] == [6, 6, 0, 6, 6]
        assert not rows["diffcloud"]["gradients"]
        assert rows["diffcloud"]["values"] == rows["random_search"]["values"]  # the same code, points and seed
        assert len(record["landscape"]["paths"]) == 1

    def test_a_rival_that_fails_leaves_a_gap(self, scenario, episode, summary, monkeypatch):
        real = Objective.__call__

        def fragile(self, parameters):
            return real(self, {**parameters, "stretching": torch.full_like(parameters["stretching"], -1e9)})

        monkeypatch.setattr(Objective, "__call__", fragile)
        settings = ComparisonSettings(baselines=["random_search"], draws=1, level=None)
        record = compare_episode(scenario, episode, summary, name="e", settings=settings).record
        assert [row["method"] for row in record["methods"]] == ["diffcloud"]
        assert [gap["method"] for gap in record["gaps"]] == ["random_search"]
