"""How motions change with what is fitted, by tangents and by differences; and steps between bounds."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from diffcloud.errors import DivergedError
from diffcloud.estimation import residuals
from diffcloud.estimation.bounded import lowest_within
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.residuals import Axis, moved_by
from tests.conftest import small_lift
from tests.estimation.rates import check_rates
from tests.estimation.test_fit import GENTLE, clouds_of

TRUTH = {"stretching": 0.6, "density": 1.7}
SPACE = FitSpace.build(["stretching", "density"])


def lifted(*, integrator="implicit", **measure):
    """A slow lift, and the objective of a recording of the truth."""
    scenario = small_lift(**{**GENTLE, "integrator": integrator, "points": 500})
    return Objective(scenario, clouds_of(scenario, **TRUTH), **measure)


def places_of(*values):
    return Axis.of(SPACE).places(torch.tensor(values, dtype=torch.float64))


@pytest.mark.parametrize("measure", [{"paper": True}, {"nuisance": {}}], ids=["paper", "both ways"])
def test_rates_are_those_of_the_motion(measure):
    check_rates(lifted(**measure), SPACE, Axis.of(SPACE).places(SPACE.starts(3, seed=1)[0]))


def test_differences_agree_with_tangents(monkeypatch):
    """Of the same motion, with a step so short that the differences are as good."""
    monkeypatch.setattr(residuals, "STEP", 1e-4)
    objective, found = lifted(), []
    for integrator in ("implicit", "arcsim"):  # which of both ways is taken
        scenario = objective.scenario
        objective.scenario = replace(scenario, scene=replace(scenario.scene, integrator=integrator))
        with torch.no_grad():
            found.append(moved_by(objective, SPACE, places_of([0.9, 1.2], [2.0, 0.5])))
    by_tangents, by_differences = found
    torch.testing.assert_close(objective.looked_at(by_differences.run), objective.looked_at(by_tangents.run))
    torch.testing.assert_close(by_differences.rates, by_tangents.rates, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("integrator", ["implicit", "arcsim"])
def test_at_a_bound_motions_change_too(integrator):
    """Differences are halved there, and nothing is simulated beyond."""
    objective, asked = lifted(integrator=integrator), []
    real = objective.inputs
    objective.inputs = lambda parameters, steps: asked.append(parameters) or real(parameters, steps)
    with torch.no_grad():
        rates = moved_by(objective, SPACE, Axis.of(SPACE).ends[1][None]).rates
    assert bool(torch.isfinite(rates).all())
    assert bool((rates.abs().amax((1, 2, 3, 4)) > 0).all())
    assert max(float(value.detach().max()) for one in asked for value in one.values()) <= 10.0 * (1 + 1e-12)


def test_a_difference_that_diverges_names_its_place(monkeypatch):
    """The second place's: 5 % above it the cloth is too stiff, though not there."""
    objective, real = lifted(integrator="arcsim"), Objective.simulate_to_loss

    def broken(self, parameters):
        bad = (parameters["stretching"] > 9.0).nonzero().flatten().tolist()
        if bad:
            raise DivergedError(3, bad, "test")
        return real(self, parameters)

    monkeypatch.setattr(Objective, "simulate_to_loss", broken)
    with pytest.raises(DivergedError) as caught, torch.no_grad():
        moved_by(objective, SPACE, places_of([1.0, 1.0], [8.9, 1.0], [2.0, 1.0]))
    assert caught.value.entries == [1]


def test_a_step_is_the_lowest_between_the_bounds(rng):
    """Cutting off a step at a bound may lead uphill."""
    held = 0
    for _ in range(50):
        root = torch.from_numpy(rng.normal(size=(6, 6)))
        matrix, slope = root @ root.T + 1e-3 * torch.eye(6).double(), torch.from_numpy(rng.normal(size=6))
        least, most = torch.from_numpy(-rng.uniform(0, 1, 6)), torch.from_numpy(rng.uniform(0, 1, 6))
        step = lowest_within(matrix, slope, least, most)
        uphill = slope + matrix @ step
        below, above = step <= least + 1e-12, step >= most - 1e-12
        assert bool(((step >= least - 1e-12) & (step <= most + 1e-12)).all())
        assert bool((uphill[below] > -1e-9).all())
        assert bool((uphill[above] < 1e-9).all())
        assert float(uphill[~below & ~above].abs().sum()) < 1e-8
        held += int(below.sum() + above.sum())
    assert held > 50
