"""Intervals and verdicts from known covariances."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm, t

from diffcloud.evaluation import intervals as module
from diffcloud.evaluation.intervals import significant, state_intervals
from diffcloud.evaluation.summary import largest_sources
from diffcloud.fit import FitSpace, Objective
from diffcloud.fit.uncertainty import STEP_SIZE, Uncertainty, noise_mm, uncertainty
from tests.conftest import small_lift
from tests.fit.test_fit import clouds_of

VALUES = {"stretch": 0.7, "mass": 1.0}
SPACE = FitSpace.build(["stretch", "mass"], priors={"stretch": 10.0, "mass": 10.0})


@pytest.fixture(scope="module")
def objective():
    scenario = small_lift()
    return Objective(scenario, clouds_of(scenario, **VALUES))


@pytest.fixture
def told(objective, monkeypatch):
    """Intervals of stated variances."""

    def tell(sources, *, space=SPACE, values=VALUES, step=0.0, refined=0.0, clusters=16, loss=1.0, **options):
        k = len(space.names)
        moves = np.broadcast_to(refined, k)
        places = np.log([values[name] for name in space.names])
        covariances = {name: np.array(value, dtype=float).reshape(k, k) for name, value in sources.items()}
        covariances[STEP_SIZE] = np.outer(moves, moves) / 3
        losses = np.array([loss * objective.noise_loss])
        found = Uncertainty(space.names, places, losses, 1.0, covariances, moves, clusters, np.full(k, step), np.eye(k))
        monkeypatch.setattr(module, "uncertainty", lambda *arguments, **given: found)
        return state_intervals(objective, space, values, **options)

    return tell


def known_ratio(scale, ratio):
    """Covariance with a deviation of the common factor, and one of stretch / mass."""
    return scale**2 * np.ones((2, 2)) + ratio**2 / 4 * np.array([[1, -1], [-1, 1]])


class TestEnds:
    def test_of_doubts_alone_the_quantile_is_the_normal_one(self, told):
        found = told({"noise": np.zeros((2, 2)), "z": np.diag([0.04, 0.01])}, level=0.95)
        entry = found.parameters["stretch"]
        assert math.log(entry.high / entry.value) == pytest.approx(0.2 * norm.ppf(0.975), rel=1e-6)
        assert entry.low * entry.high == pytest.approx(entry.value**2)
        assert (entry.physical, entry.physical_unit) == (pytest.approx(4.0 * 0.7), "N/m")
        assert entry.physical_high == pytest.approx(4.0 * entry.high)

    def test_of_noise_alone_it_is_that_of_its_few_clusters(self, told):
        found = told({"noise": np.diag([0.04, 0.01])}, clusters=5)
        entry = found.parameters["stretch"]
        assert math.log(entry.high / entry.value) == pytest.approx(0.2 * t.ppf(0.95, 4), rel=1e-6)

    def test_they_reach_further_to_where_finer_steps_have_it(self, told):
        found = told({"noise": np.zeros((2, 2)), "z": np.diag([0.04, 0.01])}, refined=[-0.3, 0.1])
        entry, other, ratio = found.parameters["stretch"], found.parameters["mass"], found.ratio
        width = math.log(entry.high / entry.value)
        assert math.log(entry.value / entry.low) == pytest.approx(width + 0.3, rel=1e-6)
        assert entry.factor == pytest.approx(entry.value / entry.low)
        assert math.log(other.high / other.value) - math.log(other.value / other.low) == pytest.approx(0.1, rel=1e-6)
        assert math.log(ratio.value / ratio.low) - math.log(ratio.high / ratio.value) == pytest.approx(0.4, rel=1e-6)

    @pytest.mark.parametrize("moved", [0.0, 1e-3, 0.1, 0.3, 1.5])
    def test_they_hold_a_truth_at_either_end_of_that_reach_as_often_as_they_say(self, told, moved):
        known = told({"noise": np.zeros((2, 2)), "z": np.diag([0.04, 0.01])}, refined=[moved, -moved / 4])
        few = told({"noise": np.diag([0.04, 0.01])}, refined=[moved, 0.0], clusters=5)
        for entry, scale, far, law in (
            (known.parameters["stretch"], 0.2, moved, norm),
            (known.parameters["mass"], 0.1, -moved / 4, norm),
            (known.ratio, math.hypot(0.2, 0.1), 1.25 * moved, norm),
            (few.parameters["stretch"], 0.2, moved, t(4)),
        ):
            below, above = math.log(entry.value / entry.low), math.log(entry.high / entry.value)
            for truth in (0.0, far):  # where fits scatter around 0
                held = law.cdf((truth + below) / scale) - law.cdf((truth - above) / scale)
                assert held == pytest.approx(0.9, abs=1e-6)

    def test_they_stop_at_the_bounds(self, told):
        entry = told({"noise": np.diag([25.0, 25.0])}).parameters["stretch"]
        assert (entry.low, entry.high) == (0.1, 10.0)
        assert entry.at_bounds == [0.1, 10.0]

    def test_a_linear_axis_has_a_linear_interval(self, told):
        space = FitSpace.build(["friction_obstacle"])
        found = told({"noise": [[0.0]], "z": [[0.01]]}, space=space, values={"friction_obstacle": 0.3})
        entry = found.parameters["friction_obstacle"]
        assert entry.high - entry.value == pytest.approx(0.1 * norm.ppf(0.95) * 1.5)  # a part of the range
        assert entry.value - entry.low == pytest.approx(entry.high - entry.value)

    def test_the_ratio_takes_both_along(self, told):
        found = told({"noise": np.zeros((2, 2)), "z": known_ratio(1.0, 0.1)})
        assert found.ratio.value == pytest.approx(0.7)
        assert math.log(found.ratio.factor) == pytest.approx(0.1 * norm.ppf(0.95), rel=1e-6)
        assert str(found.best) in ("stretch^+1.00 · mass^-1.00", "stretch^-1.00 · mass^+1.00")
        assert found.worst.factor > found.best.factor


class TestVerdicts:
    @pytest.mark.parametrize(
        ("sources", "verdict"),
        [
            ({"noise": np.diag([0.01, 0.01])}, "identified"),
            ({"noise": np.zeros((2, 2)), "z": known_ratio(1.0, 0.1)}, "only the ratio"),
            ({"noise": np.diag([1.0, 1.0])}, "not identified"),
            ({"noise": np.diag([0.1, 0.1]), "prior": np.diag([1.0, 1.0])}, "the prior speaks"),
        ],
    )
    def test_from_variances(self, told, sources, verdict):
        assert told(sources).parameters["stretch"].verdict == verdict

    def test_of_other_pairs_only_a_combination_is_known(self, told):
        space = FitSpace.build(["stretch", "bending"])
        found = told(
            {"noise": np.zeros((2, 2)), "z": known_ratio(1.0, 0.1)}, space=space, values={"stretch": 1, "bending": 1}
        )
        assert found.parameters["bending"].verdict == "only a combination"
        assert found.ratio is None

    @pytest.mark.parametrize(
        ("names", "covariance"),
        [
            (["stretch"], [[0.01]]),  # at a bound, and one parameter is no combination
            (["stretch", "friction_cloth"], known_ratio(1.0, 0.1)),  # which has no logarithm, as it may be zero
        ],
    )
    def test_what_is_no_product_of_several_is_no_combination(self, told, names, covariance):
        space = FitSpace.build(names, bounds={"stretch": (0.1, 10.0), "friction_cloth": (0.0, 1.5)})
        values = {"stretch": 0.1 if len(names) == 1 else 1.0, "friction_cloth": 0.5}
        found = told({"noise": np.zeros((len(names),) * 2), "z": np.array(covariance)}, space=space, values=values)
        assert found.parameters["stretch"].verdict == "not identified"

    def test_a_named_factor_decides(self, told):
        sources = {"noise": np.zeros((2, 2)), "z": np.diag([0.04, 0.04])}
        assert told(sources, within=1.2).parameters["stretch"].verdict == "not identified"
        assert told(sources, within=1.5).parameters["stretch"].verdict == "identified"

    def test_a_fit_that_has_not_arrived_has_none(self, told):
        found = told({"noise": np.diag([0.01, 0.01])}, step=0.21)
        assert not found.arrived
        assert found.parameters["stretch"].low is found.ratio.low is None
        assert found.parameters["stretch"].verdict == "the fit has not arrived"
        assert "fit again" in found.reason

    def test_what_is_left_of_its_way_is_a_source(self, told):
        still, moving = (told({"z": np.diag([0.01, 0.01]), "noise": np.zeros((2, 2))}, step=step) for step in (0.0, 0.15))
        widths = [math.log(one.parameters["stretch"].factor) for one in (still, moving)]
        assert widths[1] / widths[0] == pytest.approx(math.hypot(0.1, 0.15) / 0.1)
        assert moving.arrived
        assert moving.ratio.factor == pytest.approx(still.ratio.factor)  # both go the same way
        assert moving.sources["next step"]["stretch"] == pytest.approx(0.15)

    def test_a_misfit_far_above_the_noise_is_no_statement_on_the_cloth(self, told, objective):
        found = told({"noise": np.diag([0.01, 0.01])}, loss=2.1)
        assert not found.explains
        assert found.parameters["stretch"].verdict == "the model does not explain the recording"
        assert found.parameters["stretch"].low is not None
        rms = 1e3 * (2.1 * objective.noise_loss) ** 0.5
        assert f"{rms:.1f} mm RMS" in found.reason

    def test_where_nobody_knows_what_cameras_missed_the_allowance_is_coarse(self, told, objective, monkeypatch):
        monkeypatch.setattr(Objective, "knows_gaps", False)
        coarse = 1e-6 * (2 * noise_mm(objective)) ** 2 / objective.noise_loss
        assert coarse > 2.1
        assert told({"noise": np.diag([0.01, 0.01])}, loss=0.99 * coarse).explains
        assert not told({"noise": np.diag([0.01, 0.01])}, loss=1.01 * coarse).explains

    def test_a_loss_somewhat_above_what_noise_leaves_is_remarked_on(self, told):
        right, doubted = (told({"noise": np.diag([0.01, 0.01])}, loss=loss) for loss in (1.1, 1.7))
        assert right.remark == ""
        assert doubted.sentences == [doubted.remark[0].upper() + doubted.remark[1:] + "."]
        assert "the loss is 1.7 times what noise" in doubted.remark
        assert doubted.parameters["stretch"] == right.parameters["stretch"]

    @pytest.mark.parametrize("why", ["not explained", "gaps unknown", "no noise"])
    def test_nothing_is_remarked_where_a_reason_is_given_or_the_noise_is_not_known(self, told, monkeypatch, why):
        if why != "not explained":
            monkeypatch.setattr(Objective, *{"gaps unknown": ("knows_gaps", False), "no noise": ("noise_loss", 0.0)}[why])
        found = told({"noise": np.diag([0.01, 0.01])}, loss=2.1 if why == "not explained" else 1.7)
        assert found.remark == ""
        assert found.explains == (why != "not explained")


def test_the_misfit_is_the_fits_own(objective):
    def loss_at(stretch):
        space = FitSpace.build(["stretch"], fixed={"mass": 1.0})
        return float(uncertainty(objective, space, {"stretch": stretch}).losses[0])

    rms, accounted, excess = module._misfit(objective, loss_at(0.7))
    assert excess == pytest.approx(rms / accounted / 2**0.5)
    assert excess < 0.8
    assert module._misfit(objective, loss_at(0.1))[2] > 1.2 * excess


def test_what_to_improve_first():
    sources = {"noise": {"stretch": 0.1}, "friction_obstacle": {"stretch": 0.3}, "z": {"stretch": 0.001}}
    assert largest_sources(sources, "stretch") == "friction obstacle 90 %, noise 10 %"
    assert largest_sources({"noise": {"stretch": 0.0}}, "stretch") == ""


@pytest.mark.parametrize(
    ("low", "high", "told"), [(0.5, 2.0, "1.2"), (1.1, 1.3, "1.23"), (1.23, 1.24, "1.235"), (None, None, "1.23")]
)
def test_digits_are_those_that_the_interval_bears(low, high, told):
    assert significant(low, high)(1.2346) == told
    assert significant(low, high)(None) == "–"


def test_numbers_of_everyday_size_are_written_out():
    shown = significant(46.0, 110.0)
    assert [shown(value) for value in (107.0, 2345.6, 0.00001234, 3.2e7)] == ["110", "2300", "1.2e-05", "3.2e+07"]


def test_a_note_where_mass_multiplies_a_part_of_the_cloth(told, objective, monkeypatch):
    sources = {"noise": np.diag([0.01, 0.01])}
    assert told(sources).sentences == []
    scenario = objective.scenario
    monkeypatch.setattr(objective, "scenario", replace(scenario, node_sets={"mass": np.arange(5)}))
    (sentence,) = told(sources).sentences
    assert f"5 of {len(scenario.scene.mesh.nodes)} nodes" in sentence
