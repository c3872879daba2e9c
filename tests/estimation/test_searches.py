"""Searches: the same laws for both. They find a minimum, within budget and bounds, and survive what diverges."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from diffcloud.errors import ConfigError, DivergedError
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.record import read_fit
from diffcloud.estimation.result import describe_fit, write_fit
from diffcloud.estimation.solvers import SOLVER_NAMES, SOLVERS, CmaEsSettings, RandomSearchSettings, solve
from tests.conftest import small_lift
from tests.estimation.test_fit import clouds_of
from tests.evaluation.bowls import SPACE, Bowl


class Counted(Bowl):
    """A bowl that remembers what it was asked for."""

    def __post_init__(self):
        super().__post_init__()
        self.asked = []

    def __call__(self, parameters):
        losses = super().__call__(parameters)
        self.asked += zip(*(parameters[name].tolist() for name in self.target), strict=True)
        return losses


@pytest.mark.parametrize("settings", [CmaEsSettings, RandomSearchSettings], ids=lambda kind: SOLVER_NAMES[kind])
class TestSearch:
    def test_finds_the_minimum_of_a_bowl(self, settings):
        found = solve(Bowl(), SPACE, settings(max_simulations=400))
        assert found.loss < 0.01 * found.loss_start
        assert found.values == pytest.approx({"stretching": 0.7, "density": 2.0}, rel=0.2)
        assert float(Bowl()({name: torch.tensor([value]) for name, value in found.values.items()})) == pytest.approx(
            found.loss, rel=1e-6
        )

    @pytest.mark.parametrize("simulations", [1, 5, 17, 50])
    def test_spends_its_budget_and_no_more(self, settings, simulations):
        bowl = Counted()
        found = solve(bowl, SPACE, settings(max_simulations=simulations))
        assert found.simulations == len(bowl.asked) == simulations
        assert found.stop_reason == "simulations"

    def test_begins_in_the_middle_or_where_it_is_told_and_stays_inside(self, settings):
        for init, first in (({}, (5.05, 5.05)), ({"density": 10.0}, (5.05, 10.0))):
            bowl = Counted()
            found = solve(bowl, SPACE, settings(max_simulations=60, init=init))
            assert bowl.asked[0] == first
            assert tuple(found.start.values()) == first
            assert 0.1 <= min(map(min, bowl.asked)) <= max(map(max, bowl.asked)) <= 10.0

    def test_the_history_holds_the_lowest_so_far(self, settings):
        found = solve(Bowl(), SPACE, settings(max_simulations=60))
        losses = torch.cat(found.history.losses)
        assert bool((losses.diff() <= 0).all())
        assert (float(losses[0]), float(losses[-1])) == (found.loss_start, found.loss)
        assert found.history.values[-1].tolist() == [list(found.values.values())]
        assert found.iterations == len(losses) - 1

    def test_the_seed_decides_and_nothing_else(self, settings):
        np.random.seed(0)  # noqa: NPY002 - the state that must not count, and must not be touched
        state = np.random.get_state()[1].tolist()  # noqa: NPY002
        one = solve(Bowl(), SPACE, settings(max_simulations=30))
        assert np.random.get_state()[1].tolist() == state  # noqa: NPY002
        np.random.seed(1)  # noqa: NPY002
        again, other = (solve(Bowl(), SPACE, settings(max_simulations=30, seed=seed)) for seed in (0, 1))
        assert one.values == again.values != other.values

    def test_stops_below_the_threshold(self, settings):
        found = solve(Bowl(), SPACE, settings(max_simulations=500, threshold=0.5))
        assert found.stop_reason == "threshold"
        assert found.loss < 0.5
        assert found.simulations < 500
        at_once = solve(Bowl(), SPACE, settings(threshold=1e3))
        assert (at_once.simulations, at_once.iterations, at_once.stop_reason) == (1, 0, "threshold")

    def test_goes_on_where_some_diverge_the_first_among_them(self, settings):
        found = solve(Bowl(diverges_above=4.0), SPACE, settings(max_simulations=120))
        assert max(found.values.values()) <= 4.0
        assert max(found.start.values()) <= 4.0
        assert math.isfinite(found.loss_start)
        assert found.loss < 0.5

    def test_fails_where_all_diverge(self, settings):
        with pytest.raises(DivergedError, match="all 30 parameter sets diverged"):
            solve(Bowl(diverges_above=0.0), SPACE, settings(max_simulations=30))

    def test_ctrl_c_keeps_the_best_so_far(self, settings):
        told = []

        def interrupt(progress):
            told.append(progress)
            if progress.iteration == 2:
                raise KeyboardInterrupt

        found = solve(Bowl(), SPACE, settings(), progress=interrupt)
        assert found.stop_reason == "interrupted"
        assert found.simulations == told[-1].simulations
        assert (found.loss, found.values) == (told[-1].best, told[-1].values)

    def test_ctrl_c_within_a_simulation_or_before_the_first_loss(self, settings):
        class Stopped(Bowl):
            def __call__(self, parameters):
                if self.calls == stop_at:
                    raise KeyboardInterrupt
                return super().__call__(parameters)

        stop_at = 2
        assert solve(Stopped(), SPACE, settings()).stop_reason == "interrupted"
        stop_at = 0
        with pytest.raises(KeyboardInterrupt):
            solve(Stopped(), SPACE, settings())

    def test_one_variable_with_a_known_other(self, settings):
        space = FitSpace.build(["stretching"], fixed={"density": 2.0})
        found = solve(Bowl(), space, settings(max_simulations=60))
        assert found.values == pytest.approx({"stretching": 0.7}, rel=0.2)

    def test_a_range_from_zero_is_searched_linearly(self, settings):
        """Where a logarithm would never come near the bound."""

        class Line(Bowl):
            def __call__(self, parameters):
                return (10 * parameters["damping"] - 0.2).square() + (parameters["density"] / 2).log().square()

        space = FitSpace.build(["damping", "density"], bounds={"damping": (0.0, 0.1)})
        found = solve(Line(), space, settings(max_simulations=300))
        assert found.values["damping"] == pytest.approx(0.02, abs=0.01)

    def test_needs_a_simulation(self, settings):
        with pytest.raises(ConfigError, match="one or more, got 0"):
            settings(max_simulations=0)

    def test_files_tell_the_solver_and_its_settings(self, settings, tmp_path):
        scenario = small_lift()
        objective = Objective(scenario, clouds_of(scenario, stretching=0.6, density=1.0))
        chosen = settings(max_simulations=9, seed=2)
        found = solve(objective, SPACE, chosen)
        told = read_fit(write_fit(tmp_path, "e", describe_fit(objective, SPACE, chosen, found, episodes=["e"])))
        assert SOLVERS[told.solver] is settings
        assert told.simulations == told.settings["max_simulations"] == 9
        assert told.settings["seed"] == told.measure.seed == 2
        assert told.history.gradient_norm == []
        assert "starts" not in told.settings


def test_cma_es_beats_random_search_in_a_bowl():
    adapted, drawn = (
        solve(Bowl(), SPACE, kind(max_simulations=100)).loss for kind in (CmaEsSettings, RandomSearchSettings)
    )
    assert adapted < 0.1 * drawn


def test_cma_es_says_when_it_has_arrived():
    found = solve(Bowl(), SPACE, CmaEsSettings(max_simulations=5000))
    assert found.stop_reason == "converged"
    assert found.simulations < 5000


def test_a_larger_budget_begins_with_the_draws_of_a_smaller_one():
    few, many = Counted(), Counted()
    for bowl, simulations in ((few, 21), (many, 50)):
        solve(bowl, SPACE, RandomSearchSettings(max_simulations=simulations))
    assert many.asked[:21] == few.asked
