"""Identifiability against residuals whose matrix is known, and the words that follow from it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from diffcloud.evaluation.identifiability import Coordinates, _end, _lengths, identify
from diffcloud.fit import FitSpace
from tests.evaluation.bowls import SPACE, KnownResiduals

OPTIMUM = {"stretch": 1.0, "mass": 1.0}
RATIO, SCALE = np.array([1.0, -1.0]) / math.sqrt(2), np.array([1.0, 1.0]) / math.sqrt(2)


def told(ratio, scale, **options):
    """Residuals of slope `ratio` and `scale` along these directions, in equal shares."""
    return identify(KnownResiduals([ratio * RATIO, scale * SCALE], OPTIMUM, **options), SPACE, OPTIMUM)


class TestMatrix:
    def test_is_the_mean_of_the_outer_products(self):
        found = told(3.0, 0.5)
        expected = 0.5 * (9.0 * np.outer(RATIO, RATIO) + 0.25 * np.outer(SCALE, SCALE))
        np.testing.assert_allclose(found["matrix"], expected, rtol=1e-6)
        np.testing.assert_allclose(found["eigenvalues"], [4.5, 0.125], rtol=1e-6)
        np.testing.assert_allclose(np.abs(np.array(found["directions"]) @ RATIO), [1.0, 0.0], atol=1e-6)

    def test_predicts_the_measured_intervals_of_a_quadratic_loss(self):
        found = told(3.0, 0.5)
        for predicted, ends in zip(found["predicted"], found["interval"], strict=True):
            for end in ends:
                assert predicted / 2 < end < predicted * 1.3  # the scan goes in steps

    def test_noise_is_that_of_the_mean_loss(self):
        """The loss is about 100 + 20 ε: its mean over 800 points and 4 draws has 2 · 20 · 0.02 / sqrt(3200) twice over."""
        assert told(3.0, 0.5)["noise"] == pytest.approx(2 * 20 * 0.02 / math.sqrt(3200), rel=0.5)


class TestVerdicts:
    @pytest.mark.parametrize(
        ("ratio", "scale", "verdict"),
        [
            (30.0, 30.0, "identified"),
            (30.0, 0.001, "only the ratio"),
            (0.001, 30.0, "only a combination"),
            (0.001, 0.001, "not identified"),
        ],
    )
    def test_in_words(self, ratio, scale, verdict):
        assert set(told(ratio, scale, noise=0.2)["verdicts"].values()) == {verdict}

    def test_each_parameter_has_its_own(self):
        found = identify(KnownResiduals([[30.0, 0.0], [0.0, 0.001]], OPTIMUM), SPACE, OPTIMUM)
        assert found["verdicts"] == {"stretch": "identified", "mass": "not identified"}
        assert found["combination"] == "stretch^+1.00"

    def test_open_ends_lie_at_the_bounds(self):
        found = told(30.0, 0.001)
        assert found["open"] == [[False, False], [True, True]]
        assert found["interval"][1][1] == pytest.approx(math.sqrt(2) * math.log(10), rel=1e-6)


class TestEnd:
    LENGTHS = 0.01 * 3 ** (0.5 * np.arange(8))

    @pytest.mark.parametrize(
        ("rise", "end"),
        [
            (30.0 * LENGTHS**2 / LENGTHS[4] ** 2 / 30, 3),  # a parabola: a third of it, and three times it, at its sides
            ([0.0, 0.1, 0.3, 0.2, 0.8, 1.2, 2.0, 3.0], 4),  # flat: none is hardly told while all is clear beyond
            ([0.1, 9.0, 0.1, 9.0, 9.0, 9.0, 9.0, 9.0], 2),  # a jump nearby does not count
            ([5.0, 9.0, 5.0, 9.0, 5.0, 9.0, 5.0, 9.0], None),  # rough: tells at once
            ([0.8, 0.8, 0.8, 0.8, 0.8, 0.8, 0.8, 0.8], 6),  # the bounds are met before it tells
            ([0.95, 1.1, 0.9, 1.1, 0.9, 1.1, 0.9, 1.1], None),  # rough: nowhere hidden with something to spare
            ([0.1, 5.0, 0.1, 5.0, 0.1, 5.0, 0.1, 0.9], 6),  # three times as far is beyond the bounds
            ([np.inf] * 8, None),
            ([0.0] * 8, 7),
        ],
    )
    def test_is_the_longest_that_keeps_its_promise(self, rise, end):
        assert _end(self.LENGTHS, np.array(rise)) == end

    def test_lengths_hold_each_others_threefold(self):
        lengths = _lengths(1.0, 4)
        assert (lengths[0], lengths[-1]) == (0.0005, 1.0)
        np.testing.assert_allclose(lengths[4:-1] / lengths[:-5], 3.0)
        assert set(_lengths(1.0, 2)) < set(lengths)
        assert _lengths(1e-5, 2).tolist() == [1e-5]
        assert _lengths(0.0, 2).tolist() == [0.0]


class TestCheck:
    def test_fresh_points_agree(self):
        check = told(3.0, 0.5)["check"]
        assert len(check) == 4
        assert all(entry["agrees"] for entry in check)

    @pytest.mark.parametrize("both", [False, True])
    def test_a_rough_loss_has_no_interval(self, both):
        """Whatever moves the mass moves all points by a tenth, as when another contact is met: to one side or to both."""

        class Jumping(KnownResiduals):
            def points(self, run, *, pose=None):
                lower = -run[:, 1] if not both else run[:, 1].abs()
                places = super().points(run)
                places[..., 0] += 0.1 * (lower > 1e-4)[:, None, None]
                return places

        found = identify(Jumping([[3.0, 0.0], [0.0, 1.0]], OPTIMUM), SPACE, OPTIMUM)
        (towards, away) = found["interval"][1]
        assert towards is None
        assert all(entry["agrees"] for entry in found["check"])
        if both:
            assert away is None
            assert len(found["check"]) == 2
            assert found["half_widths"]["mass"] is found["ratio_half_width"] is None
            assert found["verdicts"]["mass"] == "too rough to tell"
        else:
            assert len(found["check"]) == 3
            assert found["half_widths"]["mass"] == pytest.approx(away, rel=0.01)

    def test_a_fit_on_a_bound_ends_there(self):
        edge = {"stretch": 10.0, "mass": 1.0}
        found = identify(KnownResiduals([[3.0, 0.0], [0.0, 0.5]], edge), SPACE, edge)
        assert found["interval"][0][1] == 0.0
        assert found["open"][0] == [False, True]
        assert len(found["check"]) == 3

    def test_nothing_is_asked_beyond_the_bounds(self, monkeypatch):
        asked = []
        real = KnownResiduals.simulate
        monkeypatch.setattr(KnownResiduals, "simulate", lambda self, values: asked.append(values) or real(self, values))
        outside = [entry for entry in told(30.0, 0.001)["check"] if not entry["farther_within_bounds"]]
        assert [entry["rise_farther"] for entry in outside] == [None, None]
        for name in ("stretch", "mass"):
            found = np.concatenate([values[name].numpy() for values in asked[:-1]])  # the last is of the scale, at ½ and 2
            assert found.min() > 0.0999
            assert found.max() < 10.001

    def test_a_lower_loss_beside_the_fit_is_told(self):
        objective = KnownResiduals([3.0 * RATIO, 0.5 * SCALE], {"stretch": 2.0, "mass": 0.5})
        found = identify(objective, SPACE, OPTIMUM)
        assert found["lower"]["loss"] < found["lower"]["loss_fitted"]
        assert found["lower"]["stretch"] == pytest.approx(2.0, rel=0.4)
        assert told(3.0, 0.5)["lower"] is None


def test_coordinates_are_logarithms_or_parts_of_the_range():
    coordinates = Coordinates(FitSpace.build(["stretch", "friction_obstacle"]))
    place = coordinates.of({"stretch": 2.0, "friction_obstacle": 0.3})
    np.testing.assert_allclose(place, [math.log(2.0), 0.2])
    np.testing.assert_allclose(coordinates.values(place[None]), [[2.0, 0.3]])
    np.testing.assert_allclose(coordinates.values(np.array([[0.0, -0.1]])), [[1.0, 0.0]])  # no negative friction
