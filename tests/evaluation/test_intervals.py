"""Intervals and statuses from known covariances."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from diffcloud.errors import ConfigError
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.record import EstimateRecord, Followed
from diffcloud.evaluation.intervals import intervals_of, significant
from diffcloud.evaluation.summary import largest_sources
from tests.conftest import small_lift
from tests.estimation.records import record_of

VALUES = {"stretching": 0.7, "density": 1.0}
SPACE = FitSpace.build(["stretching", "density"], priors={"stretching": 10.0, "density": 10.0})
SCENARIO = small_lift()


def told(
    sources, *, space=SPACE, values=VALUES, scenario=SCENARIO, chi_squares=(1.0, 1.0, 9.0), stop="converged", **options
):
    """Intervals of stated variances."""
    estimate = EstimateRecord(
        mean=values,
        sources={name: np.array(part, dtype=float).reshape([len(values)] * 2).tolist() for name, part in sources.items()},
        starts=[values],
        weights=[1.0],
        recordings=[Followed(horizon_s=1.0, chi_squares=list(chi_squares), finer_mm=[0.1] * len(chi_squares))],
    )
    record = record_of(solver="likelihood", estimate=estimate, stop_reason=stop)
    return intervals_of(record, space, scenario, **options)


def known_ratio(scale, ratio):
    """Covariance with a deviation of the common factor, and one of stretch / mass."""
    return scale**2 * np.ones((2, 2)) + ratio**2 / 4 * np.array([[1, -1], [-1, 1]])


class TestEnds:
    def test_they_are_as_far_as_all_variances_together_say(self):
        found = told({"recording": np.diag([0.03, 0.0]), "z": np.diag([0.01, 0.01])}, level=0.95)
        entry = found.parameters["stretching"]
        assert math.log(entry.high / entry.value) == pytest.approx(0.2 * norm.ppf(0.975), rel=1e-6)
        assert entry.low * entry.high == pytest.approx(entry.value**2)
        assert (entry.value, entry.unit) == (pytest.approx(4.0 * 0.7), "N/m")

    def test_they_stop_at_the_bounds(self):
        entry = told({"recording": np.diag([25.0, 25.0])}).parameters["stretching"]
        assert (entry.low, entry.high) == (0.4, 40.0)
        assert entry.at_bounds == [0.4, 40.0]

    def test_a_linear_axis_has_a_linear_interval(self):
        space = FitSpace.build(["friction"])
        found = told({"recording": [[0.01]]}, space=space, values={"friction": 0.3})
        entry = found.parameters["friction"]
        assert entry.high - entry.value == pytest.approx(0.1 * norm.ppf(0.95) * 1.5)  # a part of the range
        assert entry.value - entry.low == pytest.approx(entry.high - entry.value)

    def test_the_ratio_takes_both_along(self):
        found = told({"recording": known_ratio(1.0, 0.1)})
        assert found.ratio.value == pytest.approx(0.7 * 4.0 / 0.2)
        assert math.log(found.ratio.factor) == pytest.approx(0.1 * norm.ppf(0.95), rel=1e-6)
        assert found.ratio.high / found.ratio.value == pytest.approx(found.ratio.value / found.ratio.low)
        assert str(found.best) in ("stretching^+1.00 · density^-1.00", "stretching^-1.00 · density^+1.00")
        assert found.worst.factor > found.best.factor


class TestStatus:
    @pytest.mark.parametrize(
        ("sources", "status"),
        [
            ({"recording": np.diag([0.01, 0.01])}, "identified"),
            ({"recording": known_ratio(1.0, 0.1)}, "ratio_only"),
            ({"recording": np.diag([1.0, 1.0])}, "not_identified"),
            ({"recording": np.diag([0.1, 0.1]), "prior": np.diag([1.0, 1.0])}, "prior_dominated"),
        ],
    )
    def test_from_variances(self, sources, status):
        assert told(sources).parameters["stretching"].status == status

    def test_of_other_pairs_only_a_combination_is_known(self):
        space = FitSpace.build(["stretching", "bending"])
        found = told({"recording": known_ratio(1.0, 0.1)}, space=space, values={"stretching": 1, "bending": 1})
        assert found.parameters["bending"].status == "combination_only"
        assert found.ratio is None

    @pytest.mark.parametrize(
        ("names", "covariance"),
        [
            (["stretching"], [[0.01]]),  # at a bound, and one parameter is no combination
            (["stretching", "self_friction"], known_ratio(1.0, 0.1)),  # which has no logarithm, as it may be zero
        ],
    )
    def test_what_is_no_product_of_several_is_no_combination(self, names, covariance):
        space = FitSpace.build(names, bounds={"stretching": (0.1, 10.0), "self_friction": (0.0, 1.5)})
        values = {"stretching": 0.1 if len(names) == 1 else 1.0, "self_friction": 0.5}
        found = told({"recording": np.array(covariance)}, space=space, values={name: values[name] for name in names})
        assert found.parameters["stretching"].status == "not_identified"

    def test_a_named_factor_decides(self):
        sources = {"recording": np.diag([0.04, 0.04])}
        assert told(sources, within=1.2).parameters["stretching"].status == "not_identified"
        assert told(sources, within=1.5).parameters["stretching"].status == "identified"

    def test_of_uncertain_material_there_is_none(self):
        uncertain = replace(FitSpace.build(["bending"], priors={"bending": 1.5}).variables[0], role="material")
        space = FitSpace((*SPACE.variables, uncertain), {})
        assert set(told({"recording": np.diag([0.01, 0.01])}, space=space).parameters) == {"stretching", "density"}

    def test_a_cloth_that_is_far_from_the_recording_most_of_the_time_says_nothing(self):
        found = told({"recording": np.diag([0.01, 0.01])}, chi_squares=(1.0, 9.0, 9.0))
        assert not found.fits_to_noise
        assert found.parameters["stretching"].status == "model_error"
        assert "3.0 times as far" in found.reason
        assert found.sentences[0].startswith("In e the cloth is 3.0 times")

    def test_a_descent_that_took_all_its_steps_is_remarked_on(self):
        right, cut = (told({"recording": np.diag([0.01, 0.01])}, stop=stop) for stop in ("converged", "iterations"))
        assert right.sentences == []
        assert "--max-steps" in cut.warning
        assert cut.parameters == right.parameters


def test_fits_by_other_solvers_have_no_intervals():
    with pytest.raises(ConfigError, match="by adam"):
        intervals_of(record_of(solver="adam"), SPACE, SCENARIO)


def test_what_to_improve_first():
    sources = {"noise": {"stretching": 0.1}, "friction": {"stretching": 0.3}, "z": {"stretching": 0.001}}
    assert largest_sources(sources, "stretching") == "friction 90 %, noise 10 %"
    assert largest_sources({"noise": {"stretching": 0.0}}, "stretching") == ""


@pytest.mark.parametrize(
    ("low", "high", "told"), [(0.5, 2.0, "1.2"), (1.1, 1.3, "1.23"), (1.23, 1.24, "1.235"), (None, None, "1.23")]
)
def test_digits_are_those_that_the_interval_bears(low, high, told):
    assert significant(low, high)(1.2346) == told
    assert significant(low, high)(None) == "–"


def test_numbers_of_everyday_size_are_written_out():
    shown = significant(46.0, 110.0)
    assert [shown(value) for value in (107.0, 2345.6, 0.00001234, 3.2e7)] == ["110", "2300", "1.2e-05", "3.2e+07"]


def test_a_note_where_mass_multiplies_a_part_of_the_cloth():
    sources = {"recording": np.diag([0.01, 0.01])}
    assert told(sources).sentences == []
    (sentence,) = told(sources, scenario=replace(SCENARIO, node_sets={"density": np.arange(5)})).sentences
    assert f"5 of {len(SCENARIO.scene.mesh.nodes)} nodes" in sentence


class TestBendingOnACoarseMesh:
    """The cloth of the scenario has edges of 66 mm and a bending length of 13 mm."""

    SPACE = FitSpace.build(["bending"], bounds={"bending": (0.01, 1e4)})

    def of(self, mesh, bending):
        sources = {"recording": [[0.01]], "mesh": [[mesh]]}
        return told(sources, space=self.SPACE, values={"bending": bending})

    def test_it_depends_on_the_mesh(self):
        found = self.of(0.001, 1.0)
        assert found.parameters["bending"].status == "mesh_dependent"
        mesh, nominal = SCENARIO.scene.mesh, {name: SCENARIO.nominal(name) for name in ("bending", "density")}
        edge = float(np.linalg.norm(mesh.nodes[1] - mesh.nodes[0]))
        length = (nominal["bending"] / (nominal["density"] * 9.81)) ** (1 / 3)
        assert f"edges are {1e3 * edge:.0f} mm long" in found.sentences[-1]
        assert f"cloth is {1e3 * length:.0f} mm" in found.sentences[-1]

    def test_a_stiff_cloth_bends_with_the_mesh(self):
        mesh, density = SCENARIO.scene.mesh, SCENARIO.nominal("density")
        edge = float(np.linalg.norm(mesh.nodes[1] - mesh.nodes[0]))
        enough = edge**3 * density * 9.81 / SCENARIO.nominal("bending")
        assert self.of(0.001, 0.99 * enough).parameters["bending"].status == "mesh_dependent"
        assert self.of(0.001, 1.01 * enough).parameters["bending"].status == "identified"

    def test_a_motion_of_the_same_mesh_has_no_error_of_it(self):
        found = self.of(0.0, 1.0)
        assert found.parameters["bending"].status == "identified"
        assert found.sentences == []
