"""Fits that go on with a finer mesh: where they must, where they must not, and that they find the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diffcloud.errors import DivergedError
from diffcloud.fit import FitSpace, GaussNewtonSettings, JointObjective, Objective, finer_mesh, solve
from diffcloud.fit.finer_mesh import solve_and_refine
from diffcloud.fit.solvers import RandomSearchSettings
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
    found = solve_and_refine(fine, SPACE, QUICK, cuts=1)
    outcome = found.outcome
    assert abs(np.log(first.values["stretch"] / TRUTH["stretch"])) > 0.2
    assert outcome.values["stretch"] == pytest.approx(TRUTH["stretch"], rel=0.05)
    assert first.loss > 10 * fine.explained > 10 * outcome.loss
    assert (found.cuts, found.finer_loss) == (1, None)
    assert len(found.objective.scenario.scene.mesh.nodes) == 81
    assert outcome.simulations > first.simulations
    assert outcome.loss_start == first.loss_start
    assert len(outcome.history.losses) > len(first.history.losses)


def test_a_cloth_in_two_motions_has_one_mesh(scenario, fine):
    other = small_lift(**{**GENTLE, "integrator": "implicit", "points": 1500, "path": [(0, 0, 0, 0), (1.2, 0.1, 0, 0.25)]})
    second = Objective(other, clouds_of(other.finer(), points=3000, **TRUTH), nuisance={})
    found = solve_and_refine(JointObjective([fine, second]), SPACE, QUICK, cuts=1)
    assert found.cuts == 1
    assert [len(member.scenario.scene.mesh.nodes) for member in found.objective.members] == [81, 81]
    assert found.outcome.values["stretch"] == pytest.approx(TRUTH["stretch"], rel=0.05)


def test_a_motion_of_its_own_mesh_is_left_as_it_is(coarse, monkeypatch):
    monkeypatch.setattr(Objective, "finer", refuses)
    found = solve_and_refine(coarse, SPACE, QUICK, cuts=2)
    assert (found.objective, found.cuts, found.finer_loss) == (coarse, 0, None)
    assert found.outcome.values == solve(coarse, SPACE, QUICK).values


@pytest.mark.parametrize(
    "why", ["not asked for", "gaps unknown", "another solver", "the paper's measure", "too many nodes"]
)
def test_no_mesh_is_cut(scenario, fine, monkeypatch, why):
    monkeypatch.setattr(Objective, "finer", refuses)
    settings, objective, cuts = QUICK, fine, 1
    match why:
        case "not asked for":
            cuts = 0
        case "gaps unknown":
            seen = replace(fine.episode, meta={"viewpoints": {"camera": [0.0, -1.0, 1.0]}})
            objective = Objective(scenario, seen, nuisance={})
        case "another solver":
            settings = RandomSearchSettings(simulations=5)
        case "the paper's measure":
            objective = Objective(scenario, fine.episode, paper=True)
        case "too many nodes":
            monkeypatch.setattr(finer_mesh, "_MOST_NODES", 80)
    found = solve_and_refine(objective, SPACE, settings, cuts=cuts)
    assert (found.objective, found.cuts, found.finer_loss) == (objective, 0, None)


def test_a_finer_mesh_that_hardly_helps_is_not_kept(fine, monkeypatch):
    """Here it is the same mesh again."""
    monkeypatch.setattr(Objective, "finer", lambda objective: objective)
    first = solve(fine, SPACE, QUICK)
    found = solve_and_refine(fine, SPACE, QUICK, cuts=1)
    assert (found.objective, found.cuts) == (fine, 0)
    assert found.outcome.values == first.values
    assert found.outcome.simulations > first.simulations
    assert found.finer_loss == pytest.approx(first.loss, rel=0.1)


def test_a_finer_mesh_that_diverges_costs_nothing(fine, monkeypatch):
    first, tried = solve(fine, SPACE, QUICK), []

    def solve_unless_finer(objective, *rest, **given):
        tried.append(objective)
        if objective is not fine:
            raise DivergedError(3, [0], "too fast")
        return first

    monkeypatch.setattr(finer_mesh, "solve", solve_unless_finer)
    found = solve_and_refine(fine, SPACE, QUICK, cuts=1)
    assert (found.objective, found.outcome, found.cuts, len(tried)) == (fine, first, 0, 2)


def test_ctrl_c_on_the_finer_mesh_keeps_the_best_so_far(fine, monkeypatch):
    first = solve(fine, SPACE, QUICK)
    before = len(first.history.losses)
    told = []

    def press(progress):
        told.append(progress)
        if len(told) == before + 2:
            raise KeyboardInterrupt

    found = solve_and_refine(fine, SPACE, QUICK, cuts=1, progress=press)
    assert found.outcome.stop_reason == "interrupted"
    assert found.outcome.loss <= first.loss
    assert len(found.objective.scenario.scene.mesh.nodes) == (81 if found.cuts else 25)


def test_meshes_are_cut_as_often_as_asked(scenario):
    assert scenario.finer(0) is scenario
    once, twice = scenario.finer(), scenario.finer(2)
    assert [len(one.scene.mesh.nodes) for one in (scenario, once, twice)] == [25, 81, 289]
    np.testing.assert_array_equal(twice.scene.mesh.nodes, once.finer().scene.mesh.nodes)
