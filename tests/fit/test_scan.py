"""Scans around a fitted place: what they look at, and that a fit goes on where they meet a lower loss."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from diffcloud.fit import FitSpace, GaussNewtonSettings, fit_gauss_newton, residuals
from diffcloud.fit.record import ScanRecord
from diffcloud.fit.residuals import Axis, Linearisation
from diffcloud.fit.scan import LENGTHS, Scan, scan
from diffcloud.fit.solvers import gauss_newton
from tests.evaluation.bowls import SPACE, Bowl


class TwoWells(Bowl):
    """Of the logarithm u of stretch: u² + 0.02 around 0, and a lower minimum at 0.6 that is too narrow to be felt there."""

    def __call__(self, parameters):
        away = parameters["stretch"].log()
        far = ((away - 0.6) / 0.2).square()
        return torch.minimum(away.square() + 0.02, 0.01 * far + 0.001)


def linearised(objective, space, places):
    """Loss, half of its slope and of its curvature, by automatic differentiation."""
    at = places.detach().requires_grad_(True)
    losses = objective(space.parameters(Axis.of(space).values(at)))
    (slope,) = torch.autograd.grad(losses.sum(), at, create_graph=True)
    (curvature,) = torch.autograd.grad(slope.sum(), at)
    return Linearisation(losses.detach(), slope.detach() / 2, curvature[..., None] / 2, len(places))


def test_a_fit_goes_on_where_a_scan_meets_a_lower_loss(monkeypatch):
    monkeypatch.setattr(gauss_newton, "linearise", linearised)
    space = FitSpace.build(["stretch"])
    settings = GaussNewtonSettings(starts=1, screen=0, init={"stretch": 1.1})
    assert residuals.linearise is not linearised
    alone = fit_gauss_newton(TwoWells(), space, GaussNewtonSettings(**{**settings.__dict__, "scans": 0}))
    assert alone.values["stretch"] == pytest.approx(1.0, rel=1e-3)
    found = fit_gauss_newton(TwoWells(), space, settings)
    assert found.values["stretch"] == pytest.approx(math.exp(0.6), rel=1e-3)
    assert found.stop_reason == "converged"
    assert found.simulations >= alone.simulations + 2 * len(LENGTHS)
    assert [float(row.min()) for row in found.history.losses] == sorted(
        (float(row.min()) for row in found.history.losses), reverse=True
    )


@pytest.mark.parametrize(
    ("apart", "explained", "knows_gaps", "followed"),
    [(0.0, 0.0, False, 2), (0.1, 0.0, False, 3), (0.0, 0.001, True, 3), (0.0, 0.0001, True, 2)],
)
def test_where_it_is_not_known_what_explains_a_recording_two_equal_ends_are_enough(
    monkeypatch, apart, explained, knows_gaps, followed
):
    """Of three starts, each in a well of its own, as deep as stated; and where it is known, above thirty times that."""

    class Wells(Bowl):
        def __call__(self, parameters):
            u = parameters["stretch"].log()
            wells = [0.01 + (u - middle).square() + apart * index for index, middle in enumerate((-2.0, 0.0, 2.0))]
            return torch.stack(wells).amin(0)

    monkeypatch.setattr(gauss_newton, "linearise", linearised)
    space = FitSpace.build(["stretch"], bounds={"stretch": (0.05, 20.0)})
    wells = Wells(explained=explained, knows_gaps=knows_gaps)
    found = fit_gauss_newton(wells, space, GaussNewtonSettings(screen=0, scans=0, starts=3))
    assert int(found.history.losses[-1].isfinite().sum()) == followed


@pytest.mark.parametrize(("floor", "followed"), [(0.05, 4), (0.0095, 1)])
def test_ends_that_agree_and_a_search_that_finds_nothing_lower_are_enough(monkeypatch, floor, followed):
    """Nothing explains the recording, for the model is wrong; or the first start does."""

    class Wide(Bowl):
        def __call__(self, parameters):
            return floor + 0.02 * parameters["stretch"].log().square()

    monkeypatch.setattr(gauss_newton, "linearise", linearised)
    objective = Wide(explained=0.01, knows_gaps=True)
    found = fit_gauss_newton(objective, FitSpace.build(["stretch"]), GaussNewtonSettings(screen=0, scans=0))
    assert math.log(found.values["stretch"]) == pytest.approx(0.0, abs=1e-3)
    assert int(found.history.losses[-1].isfinite().sum()) == followed


@pytest.mark.parametrize(("starts", "ended"), [(None, 1.2), (8, 0.0)])
def test_where_three_starts_explain_nothing_a_search_finds_the_next(monkeypatch, starts, ended):
    """All candidates lie in a wide well around 0; what explains the recording is a deeper one at 1.2. A stated number of
    starts is all that is followed."""

    class Hidden(Bowl):
        def __call__(self, parameters):
            u = parameters["stretch"].log()
            return torch.minimum(0.05 + 0.02 * u.square(), 0.5 * (u - 1.2).square() + 0.001)

    monkeypatch.setattr(gauss_newton, "linearise", linearised)
    monkeypatch.setattr(
        FitSpace, "starts", lambda self, count, **_: (torch.linspace(0.2, 0.5, count)[:, None].double(), None)
    )
    objective = Hidden(explained=0.01, knows_gaps=True)
    found = fit_gauss_newton(objective, FitSpace.build(["stretch"]), GaussNewtonSettings(starts=starts, screen=0, scans=0))
    assert math.log(found.values["stretch"]) == pytest.approx(ended, abs=1e-3)
    begun = int(found.history.losses[-1].isfinite().sum())
    assert (begun, found.best_start) == ((4, 3) if starts is None else (8, found.best_start))


def test_starts_that_diverge_are_passed_over(monkeypatch):
    """Here the first two of three, from above."""

    def cut(objective, space, places):
        found = linearised(objective, space, places)
        found.losses[places[:, 0] > 0.5] = math.inf
        return found

    monkeypatch.setattr(gauss_newton, "linearise", cut)
    space = FitSpace.build(["stretch"])
    values = torch.tensor([[9.0], [5.0], [0.2]]).double()
    monkeypatch.setattr(FitSpace, "starts", lambda self, count, **_: (values, None))
    found = fit_gauss_newton(Bowl(target={"stretch": 0.7}), space, GaussNewtonSettings(screen=0, starts=3))
    assert found.values["stretch"] == pytest.approx(0.7, rel=1e-3)
    assert found.best_start == 2
    assert found.history.losses[0].isfinite().tolist() == [False, False, True]


def test_a_fit_keeps_what_it_saw_where_it_ended(monkeypatch):
    """But not what it saw before it went on, nor anything where it has not looked."""
    monkeypatch.setattr(gauss_newton, "linearise", linearised)
    space = FitSpace.build(["stretch"])
    start = GaussNewtonSettings(starts=1, screen=0, init={"stretch": 1.1})
    found = fit_gauss_newton(TwoWells(), space, start)
    place = Axis.of(space).places(torch.tensor([list(found.values.values())]).double())[0]
    assert float(found.scan.losses.min()) >= found.loss
    again, _ = scan(TwoWells(), space, place, torch.ones(1, 1).double())
    torch.testing.assert_close(found.scan.losses, again.losses)
    assert fit_gauss_newton(TwoWells(), space, replace(start, scans=0)).scan is None
    assert fit_gauss_newton(TwoWells(), space, replace(start, scans=1)).scan is None


def test_it_is_the_same_after_a_file():
    found = Scan(torch.eye(2).double(), torch.tensor([[-0.1, 0.1], [-0.2, 0.3]]).double(), torch.ones(2, 2).double())
    found.losses[1, 0] = math.inf
    told = ScanRecord.model_validate_json(found.record().model_dump_json())
    assert told.losses == [[1.0, 1.0], [None, 1.0]]
    for before, after in zip(vars(found).values(), vars(Scan.of(told)).values(), strict=True):
        assert before.equal(after)


def test_it_goes_along_the_principal_axes_within_the_bounds():
    place = Axis.of(SPACE).places(torch.tensor([9.0, 1.0]).double())
    curvature = torch.tensor([[2.0, -1.9], [-1.9, 2.0]]).double()
    found, simulations = scan(Bowl(), SPACE, place, curvature)
    assert simulations == found.losses.numel() == 2 * 2 * len(LENGTHS)
    torch.testing.assert_close(found.directions @ found.directions.T, torch.eye(2).double())
    flattest = found.directions[0] @ torch.tensor([1.0, 1.0]).double()
    assert abs(float(flattest)) == pytest.approx(math.sqrt(2))
    places = place + found.lengths[..., None] * found.directions[:, None]
    low, high = Axis.of(SPACE).ends
    assert bool((places <= high + 1e-9).all() and (places >= low - 1e-9).all())
    expected = [Bowl()(SPACE.parameters(Axis.of(SPACE).bounded(row))) for row in places]
    torch.testing.assert_close(found.losses, torch.stack(expected))
    where, lowest = found.place(place)
    assert lowest == float(found.losses.min())
    assert float(Bowl()(SPACE.parameters(Axis.of(SPACE).bounded(where[None])))) == pytest.approx(lowest)


def test_of_many_variables_it_looks_along_the_flattest_axes():
    space = FitSpace.build(["stretch", "mass", "bending", "drag", "damping"])
    place = Axis.of(space).places(torch.ones(1, 5).double())[0]
    found, simulations = scan(Bowl(), space, place, torch.tensor([5.0, 4.0, 0.1, 0.3, 0.2]).double().diag())
    assert simulations == 3 * 2 * len(LENGTHS)
    torch.testing.assert_close(found.directions.abs(), torch.eye(5).double()[[2, 4, 3]])
