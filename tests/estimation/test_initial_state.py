"""How a cloth lies when its motion begins: where its nodes are, that it is found, and that it is no result."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.errors import ConfigError
from diffcloud.estimation.initial_state import initial_nodes, with_initial_state
from diffcloud.estimation.names import of_all, of_recording, without_recording
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.record import read_fit
from diffcloud.estimation.residuals import Axis
from diffcloud.estimation.result import describe_fit, write_fit
from diffcloud.estimation.settings import FitSettings
from diffcloud.estimation.solvers import LikelihoodSettings, fit_likelihood
from diffcloud.evaluation.methods import space_of
from diffcloud.scene.scenarios import load_scenario, make_scenario
from diffcloud.scene.scenarios.grid import LIFT
from diffcloud.scene.scenarios.initial_state import parse_initial_state
from diffcloud.sim.properties import one_set
from tests.conftest import small_lift
from tests.estimation.rates import check_rates
from tests.estimation.test_fit import GENTLE, clouds_of

SCENARIO = small_lift(**{**GENTLE, "integrator": "implicit"})
ASKED = FitSpace.build(["stretching"], fixed={"density": 1.7})
WAVES = {f"shape_{i}_{j}" for i in range(4) for j in range(4) if 0 < i + j <= 3}
LAID = {"turn": 0.15, "shape_1_1": 0.012, "shape_2_0": -0.008}


def column(**values: float) -> dict[str, torch.Tensor]:
    return one_set(values)


@pytest.fixture(scope="module")
def mesh():
    return SCENARIO.scene.mesh


class TestNodes:
    def test_material_leaves_the_cloth_where_it_is(self, mesh):
        assert initial_nodes(mesh, column(stretch=2.0)) is None

    def test_nothing_off_is_where_the_scene_has_it(self, mesh):
        np.testing.assert_allclose(initial_nodes(mesh, column(turn=0.0, shape_1_0=0.0))[0], mesh.nodes, atol=1e-15)

    def test_a_turn_is_a_rotation_about_the_middle(self, mesh):
        (found,) = initial_nodes(mesh, column(turn=0.3)).numpy()
        middle = mesh.nodes.mean(0)
        cos, sin = math.cos(0.3), math.sin(0.3)
        expected = (mesh.nodes - middle) @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) + middle
        np.testing.assert_allclose(found, expected, atol=1e-15)

    def test_waves_stand_over_the_cloths_own_square(self, mesh):
        """Along the sides of the cloth, however it is turned: here by 45°."""
        (found,) = initial_nodes(mesh, column(shape_1_0=0.01, shape_0_2=-0.004)).numpy()
        u, v = (mesh.verts[:, k] / np.ptp(mesh.verts[:, k]) for k in (0, 1))
        u, v = u - u.min(), v - v.min()
        heights = 0.01 * np.cos(np.pi * u) - 0.004 * np.cos(2 * np.pi * v)
        order = np.argsort(mesh.vert_node)
        np.testing.assert_allclose(found[:, 2] - mesh.nodes[:, 2], (heights - heights.min())[order], atol=1e-12)
        np.testing.assert_array_equal(found[:, :2], mesh.nodes[:, :2])

    def test_no_node_comes_lower(self, mesh, generator):
        values = {name: 0.01 * torch.randn(6, generator=generator, dtype=torch.float64) for name in WAVES}
        lowest = (initial_nodes(mesh, values)[..., 2] - torch.as_tensor(mesh.nodes[:, 2])).amin(-1)
        np.testing.assert_allclose(lowest, 0.0, atol=1e-15)


class TestSpace:
    def test_option(self):
        assert parse_initial_state("none") == {}
        assert parse_initial_state("turn=5deg, shape=5mm") == {"turn": pytest.approx(math.radians(5)), "shape": 0.005}

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("yaw=5deg", "Unknown initial_state variable 'yaw'"),
            ("turn=5", "initial_state 'turn=5': turn takes .* one of rad, deg, such as turn=5deg"),
            ("shape=5deg", "one of m, cm, mm"),
            ("shape=-1mm", "a positive number"),
            ("shape=1mm,shape=2mm", "names shape twice"),
            ("size=0.02", "one of %, such as size=2%"),
            ("track=2cm", "one of %"),
            ("size=50%", "size=50%: at most 20%"),
            ("", "Unknown initial_state variable"),
        ],
    )
    def test_what_it_does_not_take(self, text, message):
        with pytest.raises(ConfigError, match=message):
            parse_initial_state(text)

    def test_a_cloth_that_hangs_does_not_lie(self):
        with pytest.raises(ConfigError, match="lies level at the start; that of vest_hang does not"):
            with_initial_state(ASKED, [{"turn": 0.1}], [load_scenario("vest_hang")])

    def test_each_recording_has_its_own_but_the_cloth_has_one_size(self):
        space = with_initial_state(ASKED, [{"turn": 0.1, "size": 0.02}, {"turn": 0.2, "track": 0.01}], [SCENARIO, SCENARIO])
        assert space.names == ("stretching", "size", "turn@0", "turn@1", "track@1")
        assert [one.deviation for one in space.variables[1:]] == [0.02, 0.1, 0.2, 0.01]
        second, places = space.of_recording(1)
        assert second.names == ("stretching", "size", "turn", "track")
        assert places.tolist() == [0, 1, 3, 4]
        assert space.without_recording(0).names == ("stretching", "size", "turn@0", "track@0")
        assert space.without_recording(0).asked.fixed == {"density": 1.7, "size": 0.0, "turn@0": 0.0, "track@0": 0.0}

    def test_names_of_a_joint_fit_are_those_of_its_recordings(self):
        """What each says, put together and taken apart again; of one recording, plain names stay."""
        each = [{"size": 0.1, "turn": 1.0}, {"size": 0.1, "turn": 2.0}, {"size": 0.1, "shape_1_0": 3.0}]
        joint = of_all(each)
        assert [of_recording(joint, number) for number in range(3)] == each
        assert without_recording(joint, 1) == of_all([each[0], each[2]])
        assert of_all(each[:1]) == each[0]

    def test_a_scenario_says_how_its_cloths_may_lie(self):
        """For fits by derivatives; what the option says comes first."""
        recorded = load_scenario("recorded_lift")
        turn = {"turn": pytest.approx(math.radians(10))}
        said = {**turn, "shape": 0.01}
        assert recorded.initial_state == said
        assert FitSettings().initial_state_within([recorded]) == [said]
        assert FitSettings().initial_state_within([recorded, load_scenario("lift")]) == [said, turn]
        assert FitSettings().initial_state_within([make_scenario(LIFT.model_copy(update={"initial_state": "none"}))]) == [
            {}
        ]
        assert FitSettings().initial_state_within([load_scenario("vest_hang")]) == [{}]
        assert FitSettings(loss="paper", solver="adam").initial_state_within([recorded]) == [{}]
        assert FitSettings(solver="cma_es").initial_state_within([recorded]) == [{}]
        assert FitSettings(initial_state="none").initial_state_within([recorded]) == [{}]
        assert (
            FitSettings(initial_state="turn=5deg").initial_state_within([recorded] * 2)
            == [{"turn": pytest.approx(math.radians(5))}] * 2
        )

    def test_it_stands_behind_what_is_asked_for_in_the_scenes_unit(self):
        space = with_initial_state(ASKED, [{"shape": 0.007, "turn": 0.1}], [replace(SCENARIO, length_unit_m=0.35)])
        assert space.names[:2] == ("stretching", "turn")
        assert set(space.names[2:]) == WAVES
        assert space.asked.fixed == {"density": 1.7, "turn": 0.0, **dict.fromkeys(WAVES, 0.0)}
        assert space.variables[2].deviation == pytest.approx(0.02)
        assert space.variables[1].low == pytest.approx(-0.4)

    def test_its_axis_counts_deviations_and_its_prior_is_normal(self):
        space = with_initial_state(ASKED, [{"turn": 0.1}], [SCENARIO])
        places = torch.tensor([[0.3, -2.0]], dtype=torch.float64)
        values = Axis.of(space).values(places)
        assert values.tolist() == [pytest.approx([math.exp(0.3), -0.2])]
        torch.testing.assert_close(Axis.of(space).places(values), places)
        assert space.prior_factor(values, 1).log().tolist() == [pytest.approx(0.04)]


@pytest.fixture(scope="module")
def objective():
    return Objective(SCENARIO, clouds_of(SCENARIO, points=3000, stretching=0.6, density=1.7, **LAID), nuisance={})


SPACE = with_initial_state(ASKED, [{"turn": 0.1, "shape": 0.01}], [SCENARIO])


@pytest.fixture(scope="module")
def fits(objective):
    settings = LikelihoodSettings(starts=1, model_error=False, init={"stretching": 1.0})
    return [(space, settings, fit_likelihood(objective, space, settings)) for space in (ASKED, SPACE)]


def test_rates_are_those_of_the_motion(objective):
    places = torch.randn(1, len(SPACE.names), generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 0.3
    check_rates(objective, SPACE, places, rtol=1e-6, atol=1e-12)


def test_a_cloth_that_lies_askew_and_uneven_is_found(fits):
    (_, _, flat), (_, _, laid) = fits
    off = [abs(math.log(found.values["stretching"] / 0.6)) for found in (flat, laid)]
    assert off[0] > 0.2
    assert off[1] < 0.1 * off[0]
    assert laid.loss < 0.05 * flat.loss
    assert laid.values["turn"] == pytest.approx(LAID["turn"], abs=0.01)


def test_it_is_told_as_nuisance_and_read_back(objective, fits, tmp_path):
    space, settings, outcome = fits[1]
    result = describe_fit(objective, space, settings, outcome, episodes=["e"])
    record = read_fit(write_fit(tmp_path, "e", result))
    assert list(record.parameters) == ["stretching", "density"]
    assert set(record.nuisance) == set(space.names) - {"stretching"}
    assert record.nuisance["turn"].value == pytest.approx(outcome.values["turn"])
    assert record.nuisance["turn"].of == "cloth"
    assert space_of(record) == space
    with torch.no_grad():
        again = float(objective(column(**record.simulated)))
        flat = float(objective(column(**record.values)))
    assert again == pytest.approx(record.loss, rel=1e-9)
    assert flat > 5 * again
    (lies,) = initial_nodes(SCENARIO.scene.mesh, column(**record.initial_state_in(record.episodes[0])))
    np.testing.assert_allclose(result.motions[0].nodes[0], lies, atol=1e-15)
    for change, message in (({"unit": "s"}, "initial-state variable must be m, rad or 1"), ({"of": "table"}, "cloth")):
        told = json.loads((tmp_path / "e.json").read_text())
        told["episodes"][0]["nuisance"]["turn"] |= change
        (tmp_path / "damaged.json").write_text(json.dumps(told))
        with pytest.raises(ConfigError, match=message):
            read_fit(tmp_path / "damaged.json")
    lost = record.episodes[0].model_copy(update={"nuisance": {"slope": record.nuisance["turn"]}})
    stranger = record.model_copy(update={"episodes": [lost]})
    with pytest.raises(ConfigError, match="Unknown initial-state variable 'slope'"):
        space_of(stranger)


def test_a_fit_may_begin_with_a_turn_to_the_other_side(objective):
    settings = LikelihoodSettings(max_steps=3, starts=1, model_error=False, init={"stretching": 1.0, "turn": -0.1})
    outcome = fit_likelihood(objective, SPACE, settings)
    record = describe_fit(objective, SPACE, settings, outcome, episodes=["e"]).record
    assert record.start["turn"] == pytest.approx(-0.1)
    assert outcome.values["turn"] > 0.0


def test_the_uncertainty_knows_what_it_leaves_open(fits):
    (_, _, flat), (_, _, laid) = fits
    assert {"turn", "shape"} <= set(laid.estimate.sources)
    assert not WAVES & set(laid.estimate.sources)
    assert not {"turn", "shape"} & set(flat.estimate.sources)
    assert all(float(laid.estimate.sources[name][0, 0]) > 0 for name in ("turn", "shape"))
