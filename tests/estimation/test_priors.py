"""Priors of parameters: what they say, when they decide, and what is refused."""

from __future__ import annotations

import math

import pytest
import torch

from diffcloud.errors import ConfigError
from diffcloud.estimation.batches import posterior_losses
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.priors import DEFAULT_FACTOR, parameter_priors
from diffcloud.estimation.solvers import LikelihoodSettings, fit_likelihood
from tests.conftest import small_lift
from tests.estimation.test_fit import GENTLE, clouds_of

BOUNDS = {"stretching": (0.1, 10.0), "density": (0.1, 10.0), "damping": (0.0, 0.1), "bending": (2.0, 8.0)}


class TestOption:
    def test_by_default_every_multiplier_has_a_weak_one(self):
        assert parameter_priors(None, ["stretching", "damping", "bending"], BOUNDS) == {"stretching": DEFAULT_FACTOR}
        assert parameter_priors("none", ["stretching"], BOUNDS) == {}

    def test_factors_are_taken_and_the_others_stay(self):
        found = parameter_priors("density=1.5x", ["stretching", "density"], BOUNDS)
        assert found == {"stretching": DEFAULT_FACTOR, "density": 1.5}

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("density=1.5", "above 1 and with an x, such as density=3x"),
            ("density=1x", "above 1"),
            ("density=0.5x", "above 1"),
            ("density=infx", "above 1"),
            ("density=1e7x", "at most 1e"),
            ("density", "above 1"),
            ("air_density=3x", "fitted parameter"),
            ("damping=3x", "no multiplier"),
            ("bending=3x", r"bounds of bending are \[2.0, 8.0\]"),
        ],
    )
    def test_what_is_no_prior_is_refused(self, text, message):
        with pytest.raises(ConfigError, match=message):
            parameter_priors(text, ["stretching", "density", "damping", "bending"], BOUNDS)


def test_the_prior_raises_the_loss_by_a_hundredth_at_one_deviation():
    """Of two recordings together, by one of two hundred."""
    space, values = (
        FitSpace.build(["stretching", "density"], priors={"density": 3.0}),
        [[7.0, 3.0], [7.0, 1.0], [7.0, 1 / 9]],
    )
    for recordings in (1, 2):
        factor = space.prior_factor(torch.tensor(values).double(), recordings)
        assert factor.log().tolist() == pytest.approx([0.01 / recordings, 0.0, 0.04 / recordings])


@pytest.fixture(scope="module")
def objective():
    scenario = small_lift(**{**GENTLE, "integrator": "implicit", "points": 500})
    return Objective(scenario, clouds_of(scenario, points=1000, stretching=0.6, density=1.7), nuisance={})


def test_the_loss_has_it(objective):
    space = FitSpace.build(["stretching", "density"], priors={"stretching": 1.2, "density": 3.0})
    values = torch.tensor([[0.8, 1.2]]).double()
    with torch.no_grad():
        found, without = posterior_losses(objective, space, values), objective(space.parameters(values))
    off = [math.log(value) / math.log(known) for value, known in ((0.8, 1.2), (1.2, 3.0))]
    assert float(found / without) == pytest.approx(math.exp((off[0] ** 2 + off[1] ** 2) / 100))


def test_it_decides_only_what_the_recording_does_not_show(objective):
    """The ratio is what a lift shows in sparse clouds; the scale of both is the prior's."""
    settings = LikelihoodSettings(model_error=False)
    wide, narrow = (
        fit_likelihood(objective, FitSpace.build(["stretching", "density"], priors=priors), settings).values
        for priors in ({}, {"density": 1.05})
    )
    assert narrow["stretching"] / narrow["density"] == pytest.approx(wide["stretching"] / wide["density"], rel=0.03)
    assert abs(math.log(narrow["density"])) < 0.5 * abs(math.log(wide["density"]))
