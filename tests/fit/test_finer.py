"""Fits that go on with a finer mesh: where they must, where they must not, and that they find the truth."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.errors import DivergedError
from diffcloud.fit import FitSpace, GaussNewtonSettings, JointObjective, Objective, finer, fit_gauss_newton, solve
from diffcloud.fit.finer import solve_and_refine
from diffcloud.fit.laid import with_laid
from diffcloud.fit.solvers import FitOutcome, RandomSearchSettings
from diffcloud.fit.solvers.outcome import FitHistory
from tests.conftest import small_lift
from tests.fit.test_fit import GENTLE, clouds_of

TRUTH = {"stretch": 0.6, "mass": 1.7}
SPACE = FitSpace.build(["stretch"], fixed={"mass": TRUTH["mass"]})
QUICK = GaussNewtonSettings(starts=1, screen=4)


@pytest.fixture(scope="module")
def scenario():
    return small_lift(**{**GENTLE, "integrator": "implicit", "points": 1500})


@pytest.fixture(scope="module")
def fine(scenario) -> Objective:
    """A recording of a cloth of half the edge length."""
    return Objective(scenario, clouds_of(scenario.finer(), points=3000, **TRUTH), nuisance={})


@pytest.fixture(scope="module")
def coarse(scenario) -> Objective:
    return Objective(scenario, clouds_of(scenario, points=3000, **TRUTH), nuisance={})


def refuses(*arguments, **given):
    raise AssertionError("no finer mesh was called for")


def test_what_a_coarse_mesh_cannot_explain_is_found_with_a_finer_one(fine):
    first = solve(fine, SPACE, QUICK)
    found = solve_and_refine(fine, SPACE, QUICK, halvings=1)
    outcome = found.outcome
    assert abs(np.log(first.values["stretch"] / TRUTH["stretch"])) > 0.1
    assert outcome.values["stretch"] == pytest.approx(TRUTH["stretch"], rel=0.05)
    assert first.loss > 5 * fine.explained > 5 * outcome.loss
    assert (found.halvings, found.finer_loss) == (1, None)
    assert len(found.objective.scenario.scene.mesh.nodes) == 81
    assert outcome.simulations > first.simulations
    assert outcome.loss_start == first.loss_start
    assert len(outcome.history.losses) > len(first.history.losses)


def test_a_cloth_in_two_motions_has_one_mesh(scenario, fine):
    other = small_lift(**{**GENTLE, "integrator": "implicit", "points": 1500, "path": [(0, 0, 0, 0), (1.2, 0.1, 0, 0.25)]})
    second = Objective(other, clouds_of(other.finer(), points=3000, **TRUTH), nuisance={})
    found = solve_and_refine(JointObjective([fine, second]), SPACE, QUICK, halvings=1)
    assert found.halvings == 1
    assert [len(member.scenario.scene.mesh.nodes) for member in found.objective.members] == [81, 81]
    assert found.outcome.values["stretch"] == pytest.approx(TRUTH["stretch"], rel=0.05)


def test_a_motion_of_its_own_mesh_is_left_as_it_is(coarse, monkeypatch):
    monkeypatch.setattr(Objective, "halved", refuses)
    found = solve_and_refine(coarse, SPACE, QUICK, halvings=2)
    assert (found.objective, found.halvings, found.finer_loss) == (coarse, 0, None)
    assert found.outcome.values == solve(coarse, SPACE, QUICK).values


@pytest.mark.parametrize(
    "why", ["not asked for", "gaps unknown", "another solver", "the paper's measure", "too many nodes"]
)
def test_no_mesh_is_cut(scenario, fine, monkeypatch, why):
    monkeypatch.setattr(Objective, "halved", refuses)
    settings, objective, halvings = QUICK, fine, 1
    match why:
        case "not asked for":
            halvings = 0
        case "gaps unknown":
            seen = replace(fine.episode, meta={"viewpoints": {"camera": [0.0, -1.0, 1.0]}})
            objective = Objective(scenario, seen, nuisance={})
        case "another solver":
            settings = RandomSearchSettings(simulations=5)
        case "the paper's measure":
            objective = Objective(scenario, fine.episode, paper=True)
        case "too many nodes":
            monkeypatch.setattr(finer, "_MOST_NODES", 80)
    found = solve_and_refine(objective, SPACE, settings, halvings=halvings)
    assert (found.objective, found.halvings, found.finer_loss) == (objective, 0, None)


def test_a_finer_mesh_that_hardly_helps_is_not_kept(fine, monkeypatch):
    """Here it is the same mesh again."""
    monkeypatch.setattr(Objective, "halved", lambda objective: objective)
    first = solve(fine, SPACE, QUICK)
    found = solve_and_refine(fine, SPACE, QUICK, halvings=1)
    assert (found.objective, found.halvings) == (fine, 0)
    assert found.outcome.values == first.values
    assert found.outcome.simulations > first.simulations
    assert found.finer_loss == pytest.approx(first.loss, rel=0.1)


def test_a_finer_mesh_that_diverges_costs_nothing(fine, monkeypatch):
    first, tried = solve(fine, SPACE, QUICK), []

    def too_fast(*arguments, **given):
        tried.append(1)
        raise DivergedError(3, [0], "too fast")

    monkeypatch.setattr(finer, "solve", lambda *arguments, **given: first)
    monkeypatch.setattr(finer, "fit_gauss_newton", too_fast)
    found = solve_and_refine(fine, SPACE, QUICK, halvings=1)
    assert (found.objective, found.halvings, found.finer_loss, len(tried)) == (fine, 0, None, 1)
    assert (found.outcome.values, found.outcome.loss, found.outcome.scan) == (first.values, first.loss, first.scan)


@pytest.mark.parametrize(
    ("there", "ends", "followed", "kept"),
    [
        ([5.0, 4.0, 3.0, 9.0], {4.0: 2.0, 2.0: 1.0, 0.5: 3.0}, [2.0, 4.0, 0.5], 2.0),
        ([5.0, 4.0, 3.0, 9.0], {4.0: 1.0, 2.0: 2.0, 0.5: 3.0}, [2.0, 4.0, 0.5], 4.0),
        ([5.0, 4.0, 3.0, 9.0], {4.0: 1.0, 2.0: 0.4}, [2.0], 2.0),
        ([5.0, 4.0, 3.0, 9.0], {4.0: 2.01, 2.0: 2.0}, [2.0, 4.0], 2.0),
        ([5.0, 4.0, 3.0, math.inf], {2.0: 9.5}, [2.0], 2.0),
        ([math.inf, 4.0, 3.0, math.inf], {4.0: 2.0, 2.0: 1.0}, [2.0, 4.0], 2.0),
    ],
    ids=["the first is lowest", "the second is", "explained", "equally low", "no help", "two diverge"],
)
def test_the_ends_of_all_starts_go_on_by_their_losses_there(fine, monkeypatch, there, ends, followed, kept):
    """Ends at 0.5, 4, 2 and 4.1, of which the last is the second one again; a fifth start was not followed."""
    place, known = torch.tensor([[0.5], [4.0], [2.0], [4.1], [7.0]]).double(), torch.tensor([10.0] * 4 + [math.inf])
    history = FitHistory(("stretch",), [known.double()], [place], [torch.zeros(5, 1).double()])
    fitted = FitOutcome({"stretch": 0.5}, 10.0, 0, 50, "converged", 1.0, history)
    began, of_use = [], []

    def descend(objective, space, settings, **given):
        (start,) = settings.init.values()
        began.append(start)
        of_use.append(given["of_use"])
        loss = ends[start]
        row = FitHistory(("stretch",), [torch.tensor([loss]).double()], [place[:1]], [torch.zeros(1, 1).double()])
        return FitOutcome({"stretch": start + 0.1}, loss, 0, 7, "converged", 1.0, row)

    monkeypatch.setattr(finer, "fit_gauss_newton", descend)
    monkeypatch.setattr(finer, "batch_losses", lambda objective, space, values: torch.tensor(there).double())
    monkeypatch.setattr(Objective, "explained", 0.5)
    outcome = finer._gone_on(fine, SPACE, QUICK, fitted, None)
    assert began == followed
    assert outcome.values == {"stretch": kept + 0.1}
    assert outcome.loss == ends[kept]
    assert outcome.best_start == place[:, 0].tolist().index(kept)
    assert outcome.simulations == 50 + 4 + 7 * len(followed)
    assert len(outcome.history.losses) == 1 + len(followed)
    assert of_use[0] == 9.0
    assert of_use[1:] == pytest.approx([1.01 * min(ends[one] for one in followed[:n]) for n in range(1, len(followed))])


@pytest.mark.parametrize(("steps", "moved"), [(1, False), (4, True)])
def test_ctrl_c_on_the_finer_mesh_keeps_the_best_so_far(fine, steps, moved):
    """Which has the lower loss there even before the first step."""
    first, told = solve(fine, SPACE, QUICK), []

    def press(halvings, progress):
        told.append(halvings)
        if told.count(1) == steps:
            raise KeyboardInterrupt

    found = solve_and_refine(fine, SPACE, QUICK, halvings=1, progress=press)
    assert found.outcome.stop_reason == "interrupted"
    assert (found.halvings, found.finer_loss) == (1, None)
    assert len(found.objective.scenario.scene.mesh.nodes) == 81
    assert found.outcome.loss < 0.9 * first.loss
    assert (found.outcome.values["stretch"] == pytest.approx(first.values["stretch"])) != moved


def test_ctrl_c_while_ends_are_tried_on_the_finer_mesh_keeps_the_fit(fine, monkeypatch):
    def pressed(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(finer, "batch_losses", pressed)
    first, found = solve(fine, SPACE, QUICK), solve_and_refine(fine, SPACE, QUICK, halvings=1)
    assert (found.outcome.stop_reason, found.outcome.values, found.halvings) == ("interrupted", first.values, 0)


def test_edges_and_steps_are_halved_as_often_as_asked(scenario):
    assert scenario.halved(0) is scenario
    once, twice = scenario.halved(1), scenario.halved(2)
    assert [len(one.scene.mesh.nodes) for one in (scenario, once, twice)] == [25, 81, 289]
    assert [one.scene.frame_steps for one in (scenario, once, twice)] == [3, 6, 12]
    assert twice.scene.frame_time == scenario.scene.frame_time
    np.testing.assert_array_equal(twice.scene.mesh.nodes, scenario.finer().finer().scene.mesh.nodes)


def test_a_turn_that_made_up_for_a_coarse_mesh_is_given_up(fine, monkeypatch):
    """The cloth lies as the scenario says; from a turned end alone, the finer fit would begin turned."""
    space = with_laid(SPACE, [{"turn": 0.2}], [fine.scenario])
    history = FitHistory(space.names, [torch.tensor([10.0]).double()], [torch.tensor([[0.6, 0.5]]).double()], [])
    fitted = FitOutcome({"stretch": 0.6, "turn": 0.5}, 10.0, 0, 5, "converged", 1.0, history)
    began = []

    def watched(objective, space, settings, **given):
        began.append(settings.init)
        return fit_gauss_newton(objective, space, settings, **given)

    monkeypatch.setattr(finer, "solve", lambda *arguments, **given: fitted)
    monkeypatch.setattr(finer, "fit_gauss_newton", watched)
    found = solve_and_refine(fine, space, QUICK, halvings=1)
    assert began == [{"stretch": pytest.approx(0.6), "turn": 0.0}]
    assert abs(found.outcome.values["turn"]) < 0.02
    assert found.outcome.best_start == 0
