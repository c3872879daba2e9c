"""Rivals: the solvers under their names, interruption; what counts as a method's parameters."""

from __future__ import annotations

import math

import pytest
import torch

from diffcloud.errors import DivergedError
from diffcloud.estimation.batches import batch_losses, without_diverged
from diffcloud.estimation.parameters import Variable
from diffcloud.estimation.record import History
from diffcloud.estimation.solvers import SOLVER_NAMES, AdamSettings, CmaEsSettings, RandomSearchSettings, fit_adam, solve
from diffcloud.evaluation.methods import (
    clipped,
    first_start,
    fitted,
    middle,
    published,
    searched,
    single_start,
    space_of,
)
from diffcloud.sim.properties import one_set
from tests.estimation.records import parameter_of, record_of
from tests.evaluation.bowls import SPACE, Bowl


def loss_of(bowl, values):
    return float(bowl(one_set(values)))


def summary_of(outcome):
    """The parts of a fit's file that matter here."""
    history = outcome.history
    told = History(
        names=list(history.names),
        loss=[row.tolist() for row in history.losses],
        values=[row.tolist() for row in history.values],
        gradient_norm=[],
    )
    return record_of(stop_reason=outcome.stop_reason, history=told)


@pytest.mark.parametrize("settings", [RandomSearchSettings(23), CmaEsSettings(23)])
def test_searches_are_the_solvers_of_fits(settings):
    told, found = searched(Bowl(), SPACE, settings), solve(Bowl(), SPACE, settings)
    assert told.method == SOLVER_NAMES[type(settings)]
    assert (told.values, told.simulations, told.gradients) == (found.values, 23, False)
    assert set(told.seconds) == {"optimisation"}


def test_one_start_is_the_first_of_many():
    """Starts do not touch one another, so the paper's setting is what the first of nine starts does."""
    settings = AdamSettings(max_steps=12, starts=4)
    alone = single_start(Bowl(), SPACE, settings)
    many = fit_adam(Bowl(), SPACE, settings)
    assert alone.simulations == 13
    summary = summary_of(many)
    found = first_start(summary, SPACE)
    assert found.values == pytest.approx(alone.values, rel=1e-12)
    assert found.simulations == 13
    assert first_start(summary.model_copy(update={"solver": "likelihood"}), SPACE) is None
    for change in ({"smoothing": 0.5}, {"resample": True}):
        assert first_start(summary.model_copy(update={"settings": summary.settings | change}), SPACE) is None
    assert first_start(summary.model_copy(update={"stop_reason": "threshold"}), SPACE) is None
    elsewhere = fit_adam(Bowl(), SPACE, AdamSettings(max_steps=2, init={"density": 1.0}))
    assert first_start(summary_of(elsewhere), SPACE) is None


@pytest.mark.parametrize(
    "baseline",
    [
        lambda bowl: single_start(bowl, SPACE, AdamSettings(max_steps=10)),
        lambda bowl: searched(bowl, SPACE, RandomSearchSettings()),
        lambda bowl: searched(bowl, SPACE, CmaEsSettings()),
    ],
)
def test_an_interrupted_rival_is_no_result(baseline, monkeypatch):
    def interrupt(self, parameters):
        self.calls += 1
        if self.calls == 3:
            raise KeyboardInterrupt
        return real(self, parameters)

    real = Bowl.__call__
    monkeypatch.setattr(Bowl, "__call__", interrupt)
    with pytest.raises(KeyboardInterrupt):
        baseline(Bowl())


@pytest.mark.parametrize(("solver", "gradients"), [("likelihood", True), ("adam", True), ("random_search", False)])
def test_a_fit_by_a_search_had_no_gradients(solver, gradients):
    assert fitted(record_of(solver=solver), 0).gradients is gradients


def test_batches_without_the_diverged_are_the_single_ones():
    bowl = Bowl(diverges_above=3.0)
    values = torch.tensor([[0.5, 1.0], [5.0, 1.0], [2.0, 2.0], [1.0, 4.0]]).double()
    losses = batch_losses(bowl, SPACE, values)
    assert losses.isinf().tolist() == [False, True, False, True]
    for row in (0, 2):
        torch.testing.assert_close(losses[row : row + 1], bowl(SPACE.parameters(values[row : row + 1])))


def test_every_lost_entry_has_its_own_message():
    def run(index):
        bad = [place for place, entry in enumerate(index.tolist()) if entry in (1, 4)][:1]
        if bad:
            raise DivergedError(7, bad, "test")
        return index * 10

    found, kept, lost = without_diverged(6, run)
    assert found.tolist() == [0, 20, 30, 50]
    assert kept.tolist() == [0, 2, 3, 5]
    assert set(lost) == {1, 4}


class TestValues:
    SUMMARY = record_of(
        parameters={
            "stretching": parameter_of(multiplier=2.0, bounds=(20.0, 160.0), prior=3.0),
            "density": parameter_of(multiplier=1.2, fixed=True, bounds=None),
        }
    )

    def test_what_was_given_holds_for_all_methods(self):
        space = space_of(self.SUMMARY)
        assert space.variables == (Variable("stretching", 0.5, 4.0, 3.0),)
        parameters = space.parameters(torch.tensor([[2.0]]).double())
        assert {name: float(value) for name, value in parameters.items()} == {"stretching": 2.0, "density": 1.2}

    @pytest.mark.parametrize(("told", "value"), [({"stretching": 9.0}, 4.0), ({"stretching": -3.0}, 0.5), ({}, 2.25)])
    def test_clipped_to_the_bounds(self, told, value):
        found = clipped({**told, "density": 7.0}, space_of(self.SUMMARY))
        assert found == {"stretching": value, "density": 1.2}

    def test_published_predictions(self):
        told = published({"predictions": {"mlp": {"stretching": -1.0, "density": 3.0}}})
        assert [(one.method, one.values) for one in told] == [("published_mlp", {"stretching": -1.0, "density": 3.0})]
        assert published({}) == []
        assert math.isclose(middle(SPACE).values["density"], 5.05)
