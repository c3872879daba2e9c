"""Material that nobody asked for: what is known of it, that it is fitted too, and that it is not a result."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
import yaml

from diffcloud.errors import ConfigError, SceneError
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace, Variable
from diffcloud.estimation.residuals import Axis
from diffcloud.estimation.settings import FitSettings
from diffcloud.estimation.solvers import LikelihoodSettings, fit_likelihood
from diffcloud.estimation.uncertain import MATERIAL_UNCERTAINTY, with_uncertain
from diffcloud.scene.scenarios import load_scenario
from diffcloud.scene.scenarios.uncertain import parse_uncertain
from tests.conftest import small_lift
from tests.estimation.rates import check_rates
from tests.estimation.test_fit import GENTLE, clouds_of

SCENARIO = small_lift(**{**GENTLE, "integrator": "implicit", "points": 800})
ASKED = FitSpace.build(["stretching"], fixed={"density": 1.7})
BENT = with_uncertain(ASKED, {"bending": 1.5}, [SCENARIO])


def test_option():
    assert parse_uncertain("none") == {}
    assert parse_uncertain("bending=1.5x, air_density=2x") == {"bending": 1.5, "air_density": 2.0}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("bend=2x", "Unknown parameter 'bend'"),
        ("bending=2", "above 1 and with an x, such as bending=1.5x"),
        ("bending=0.5x", "above 1"),
        ("bending=infx", "above 1"),
        ("bending=1500x", "at most 100x"),
        ("bending", "above 1"),
        ("air_density=2x,air_density=3x", "air_density twice"),
        ("", "Unknown parameter"),
    ],
)
def test_what_is_no_doubt_is_refused(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_uncertain(text)


class TestSpace:
    def test_it_stands_behind_what_is_asked_for(self):
        assert BENT.names == ("stretching", "bending")
        assert BENT.asked.names == ("stretching",)
        assert BENT.asked.fixed == {"density": 1.7, "bending": 1.0}
        assert BENT.variables[1] == Variable("bending", 1.5**-4, 1.5**4, 1.5, 1.0, role="material")

    def test_it_is_about_what_is_given_or_else_the_scenarios(self):
        system, _ = SCENARIO.scene.build()
        space = with_uncertain(
            FitSpace.build(["stretching"], fixed={"bending": 2.0}), {"bending": 1.2, "friction": 1.3}, [SCENARIO]
        )
        assert [variable.centre for variable in space.variables] == [
            1.0,
            2.0,
            float(system.properties.friction[0]),
        ]
        assert space.fixed == {}

    def test_what_no_scene_has_is_no_doubt(self):
        dry = small_lift(**{**GENTLE, "friction": 0.0})
        assert with_uncertain(ASKED, {"friction": 1.3, "body_mass": 2.0}, [dry]) == ASKED

    def test_compression_is_uncertain_only_where_the_cloth_gives_way_to_it(self):
        wrinkling = small_lift(**{**GENTLE, "compression": 0.1})
        assert with_uncertain(ASKED, {"compression": 3.0}, [SCENARIO]) == ASKED
        added = with_uncertain(ASKED, {"compression": 3.0}, [wrinkling]).variables[1]
        assert added == Variable("compression", 0.1 / 3.0**4, 1.0, 3.0, 0.1, role="material")

    def test_a_scenario_says_what_is_known_less_well(self):
        own, usual = (FitSettings().known_within([load_scenario(name)]) for name in ("recorded_lift", "lift"))
        assert usual == MATERIAL_UNCERTAINTY
        assert own == {**MATERIAL_UNCERTAINTY, "shear": 3.0, "bending": 3.0}
        assert "shear" not in FitSettings(parameters=["stretching", "shear"]).known_within([load_scenario("recorded_lift")])
        assert FitSettings(uncertain="none").known_within([load_scenario("recorded_lift")]) == {}

    @pytest.mark.parametrize(
        ("uncertain", "message"), [({"sheer": 3.0}, "parameter 'sheer'"), ({"shear": 0.5}, "greater than 1")]
    )
    def test_a_scenario_that_doubts_what_it_cannot(self, uncertain, message, tmp_path):
        path = tmp_path / "own.yaml"
        path.write_text(yaml.safe_dump({"base": "lift", "uncertain": uncertain}))
        with pytest.raises(SceneError, match=message):
            load_scenario(path)

    def test_what_scenes_state_differently_is_left_to_each(self):
        other = small_lift(**{**GENTLE, "integrator": "implicit", "friction": 0.9})
        assert with_uncertain(ASKED, {"friction": 1.3}, [SCENARIO, other]) == ASKED

    def test_what_is_fitted_is_no_doubt(self):
        with pytest.raises(ConfigError, match="stretching is fitted"):
            with_uncertain(ASKED, {"stretching": 1.3}, [SCENARIO])

    def test_starts_spread_over_what_is_asked_for_and_over_what_is_known_of_the_rest(self):
        laid = Variable("turn", -1.0, 1.0, deviation=0.2, centre=0.0, role="initial_state")
        values = replace(BENT, variables=(*BENT.variables, laid)).starts(257, seed=3)[0]
        assert values[0, 1] == 1.0
        bending = values[1:, 1].log() / math.log(1.5)
        assert float(bending.mean()) == pytest.approx(0.0, abs=0.02)
        assert float(bending.std()) == pytest.approx(1.0, abs=0.05)
        stretch = values[1:, 0].log10()
        assert float(stretch.std()) == pytest.approx(2 / math.sqrt(12), abs=0.02)
        assert abs(float(torch.corrcoef(torch.stack([stretch, bending]))[0, 1])) < 0.1
        assert values[:, 2].tolist() == [0.0] * 257  # how a cloth lies
        first, _ = BENT.starts(1, seed=3, first={"stretching": 2.0, "bending": 1.2})
        assert first.tolist() == [[2.0, 1.2]]

    def test_a_start_is_stated_of_what_is_asked_for(self):
        with pytest.raises(ConfigError, match="fitted parameter 'bending'"):
            BENT.check_start({"bending": 1.0})


@pytest.fixture(scope="module")
def objective():
    return Objective(SCENARIO, clouds_of(SCENARIO, points=3000, stretching=0.6, density=1.7), nuisance={})


def test_the_prior_is_about_what_is_known():
    space = with_uncertain(FitSpace.build(["stretching"], fixed={"bending": 2.0}), {"bending": 1.5}, [SCENARIO])
    factor = space.prior_factor(torch.tensor([[7.0, 2.0], [1.0, 3.0], [1.0, 2 / 1.5**2]]).double(), 1)
    assert factor.log().tolist() == pytest.approx([0.0, 0.01, 0.04])


def test_it_moves_the_cloth_as_what_is_asked_for(objective):
    check_rates(objective, BENT, Axis.of(BENT).places(torch.tensor([[0.8, 1.2]]).double()))


def test_a_stiffer_hinge_than_stated_does_not_bend_the_fit():
    """A band whose bending is 1.8 times what the scenario says."""
    band = replace(load_scenario("band_stretch"), points=800)
    objective = Objective(band, clouds_of(band, points=2000, stretching=3.0, density=2.0, bending=1.8), nuisance={})
    asked = FitSpace.build(["stretching"], fixed={"density": 2.0})
    settings = LikelihoodSettings(starts=1, model_error=False, init={"stretching": 2.5})
    exact, uncertain = (
        fit_likelihood(objective, space, settings) for space in (asked, with_uncertain(asked, {"bending": 1.5}, [band]))
    )
    off = [abs(math.log(found.values["stretching"] / 3.0)) for found in (exact, uncertain)]
    assert off[0] > 0.1
    assert off[1] < 0.01
    assert uncertain.loss < 0.1 * exact.loss
    assert uncertain.values["bending"] == pytest.approx(1.8, rel=0.02)


def test_the_defaults_are_parameters():
    assert (
        parse_uncertain(",".join(f"{name}={factor}x" for name, factor in MATERIAL_UNCERTAINTY.items()))
        == MATERIAL_UNCERTAINTY
    )
