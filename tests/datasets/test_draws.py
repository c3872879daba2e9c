"""Draws of parameters: inside the bounds, distributed as they say, the same for the same seed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diffcloud.datasets.draws import MODES, ParameterBox, ParameterDraws
from diffcloud.errors import ConfigError

BOX = ParameterBox.build(["stretching", "density"])


def draws(kind, scenario="band_stretch", *, box=BOX, seed=0) -> ParameterDraws:
    return ParameterDraws(box, kind, scenario, seed)


@pytest.mark.parametrize("kind", ["uniform", "sobol", "logarithmic", "modes"])
def test_draws_are_inside_seeded_and_unlike_each_other(kind):
    first = draws(kind).first("train", 300)
    assert first.shape == (300, 2)
    assert ((first >= 0.1) & (first <= 10)).all()
    np.testing.assert_array_equal(first, draws(kind).first("train", 300))
    for other in (draws(kind).first("test", 300), draws(kind, seed=1).first("train", 300)):
        assert not np.isclose(other, first).any()
    np.testing.assert_array_equal(draws(kind).first("train", 200), first[:200])  # more runs leave the first as they are


@pytest.mark.parametrize("kind", ["uniform", "sobol"])
def test_both_fill_the_box_evenly(kind):
    quarters = (draws(kind).first("train", 1024) > 5.05) @ [1, 2]
    assert np.bincount(quarters) == pytest.approx([256] * 4, abs=1 if kind == "sobol" else 60)


def test_logarithmic_draws_fill_every_factor_alike():
    halves = (draws("logarithmic").first("train", 1024) > 1) @ [1, 2]  # 1 is the middle of [0.1, 10]
    assert np.bincount(halves) == pytest.approx([256] * 4, abs=60)


def test_logarithmic_draws_are_uniform_where_the_bounds_begin_at_zero():
    box = ParameterBox.build(["density", "damping"], {"density": (0.1, 10.0), "damping": (0.0, 3.0)})
    halves = (draws("logarithmic", box=box).first("train", 1024) > [1.0, 1.5]) @ [1, 2]
    assert np.bincount(halves) == pytest.approx([256] * 4, abs=60)


@pytest.mark.parametrize("scenario", MODES)
def test_every_draw_of_the_modes_lies_in_a_mode(scenario):
    drawn = draws("modes", scenario).first("train", 2000)

    def inside(ranges, values):
        return np.any([(low <= values) & (values <= high) for low, high in ranges], axis=0)

    of_mode = [inside(stretch, drawn[:, 0]) & inside(mass, drawn[:, 1]) for stretch, mass in MODES[scenario]]
    assert np.any(of_mode, axis=0).all()


def test_modes_of_the_band_are_as_likely_as_published():
    """Soft, medium, stiff and random in equal parts, where random is as stiff."""
    stretch, mass = draws("modes").first("train", 4000).T
    soft, stiff = (stretch <= 1) & (mass >= 5), (stretch >= 1) & (mass <= 1)
    assert soft.mean() == pytest.approx(0.25, abs=0.03)
    assert stiff.mean() == pytest.approx(0.5, abs=0.03)
    assert mass[stiff].mean() == pytest.approx(0.55, abs=0.03)


def test_columns_follow_the_names():
    swapped = draws("modes", box=ParameterBox.build(["density", "stretching"])).first("train", 50)
    np.testing.assert_array_equal(swapped[:, ::-1], draws("modes").first("train", 50))


@pytest.mark.parametrize("kind", ["uniform", "sobol", "logarithmic", "modes"])
def test_a_replacement_depends_on_run_and_attempt(kind):
    again = draws(kind).again("train", 7, 1)
    assert again.shape == (2,)
    assert ((again >= 0.1) & (again <= 10)).all()
    np.testing.assert_array_equal(again, draws(kind).again("train", 7, 1))
    for other in (("train", 7, 2), ("train", 8, 1), ("test", 7, 1)):
        assert (draws(kind).again(*other) != again).all()


def test_other_material_is_off_by_its_factor_whatever_else_is_drawn():
    plain, varied = draws("uniform"), replace(draws("uniform"), uncertain={"bending": 1.5, "air_density": 1.1})
    np.testing.assert_array_equal(plain.first("train", 50), varied.first("train", 50))
    assert plain.uncertain_factors("train", 0, 0) == {}
    found = np.log([list(varied.uncertain_factors("train", run, 0).values()) for run in range(800)])
    np.testing.assert_allclose(found.std(axis=0), np.log([1.5, 1.1]), rtol=0.08)
    np.testing.assert_allclose(found.mean(axis=0), 0, atol=0.05)
    assert abs(np.corrcoef(found.T)[0, 1]) < 0.1
    first = varied.uncertain_factors("train", 3, 0)
    assert first == varied.uncertain_factors("train", 3, 0)
    for other in (("test", 3, 0), ("train", 4, 0), ("train", 3, 1)):
        assert varied.uncertain_factors(*other) != first


def test_bounds_of_a_scenario_count():
    box = ParameterBox.build(["density"], {"density": (2.0, 3.0), "stretching": (0.0, 1.0)})
    drawn = draws("uniform", box=box).first("test", 100)
    assert 2 <= drawn.min() < drawn.max() <= 3


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ParameterBox.build(["weight"]), "Unknown parameter 'weight'"),
        (lambda: ParameterBox.build([]), "at least one"),
        (lambda: ParameterBox.build(["density", "density"]), "listed twice"),
        (lambda: draws("modes", "towel"), "not for 'towel'; use --distribution"),
        (lambda: draws("modes", box=ParameterBox.build(["density", "bending"])), "draw stretching and density"),
        (lambda: ParameterDraws(BOX, "uniform", "lift", 0, {"density": 1.5}), "leave out density"),
        (lambda: draws("modes", box=ParameterBox.build(BOX.names, {"stretching": (1e-2, 2e-2)})).first("train", 3), "hard"),
    ],
)  # fmt: skip
def test_bad_draws_are_refused(make, message):
    with pytest.raises(ConfigError, match=message):
        make()
