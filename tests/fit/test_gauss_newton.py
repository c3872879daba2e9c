"""The Gauss–Newton solver: its model of the loss against differences, its steps, its ends."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.clouds.neighbours import NeighbourIndex
from diffcloud.errors import DivergedError
from diffcloud.fit import FitSpace, GaussNewtonSettings, JointObjective, Objective, fit_gauss_newton, residuals
from diffcloud.fit.batches import batch_losses
from diffcloud.fit.bounded import lowest_within
from diffcloud.fit.laid import with_laid
from diffcloud.fit.residuals import Axis, Linearisation, linearise
from diffcloud.fit.solvers import gauss_newton
from diffcloud.scene import load_scenario
from tests.conftest import paper_objective, small_lift
from tests.fit.slopes import linearised
from tests.fit.test_fit import GENTLE, clouds_of

TRUTH = {"stretch": 0.6, "mass": 1.7}
SPACE = FitSpace.build(["stretch", "mass"])


def lifted(*, integrator="implicit", **measure):
    """A slow lift, and the objective of a dense recording of the truth, by default with the paper's measure."""
    scenario = small_lift(**{**GENTLE, "integrator": integrator, "points": 500})
    return Objective(scenario, clouds_of(scenario, points=8000, **TRUTH), **(measure or {"paper": True}))


def rough_pair(**measure):
    """Two recordings of different cloths with the linearised integrator, the first one shifted and turned."""
    scenario = small_lift(**{**GENTLE, "integrator": "linearised", "points": 500})
    episodes = [
        clouds_of(scenario, points=8000, shift=(0.1, 0, 0), yaw=0.2, **TRUTH),
        clouds_of(scenario, points=6000, seed=6, stretch=1.4, mass=0.8),
    ]
    return [Objective(scenario, episode, **measure) for episode in episodes]


def at(objective, space, places):
    return objective(space.parameters(Axis.of(space).values(places)))


ZERO = torch.zeros(1, dtype=torch.float64)


def beside(loss, *, slope=0.0, lowest=0.5):
    """What is found at a place of one variable, with a lower loss below it."""
    sides = torch.tensor([[[0.05]], [[-0.05]]]).double()
    return Linearisation(
        torch.tensor([loss]).double(),
        torch.tensor([[slope]]).double(),
        torch.eye(1).double()[None],
        1,
        (sides, torch.tensor([[2.0], [lowest]]).double()),
    )


class TestLinearisation:
    @pytest.mark.parametrize("measure", [{"paper": True}, {"nuisance": {}}], ids=["paper", "both ways"])
    def test_the_slope_is_that_of_the_loss(self, measure):
        found = linearised(lifted(**measure), SPACE, Axis.of(SPACE).places(SPACE.starts(3, seed=1)[0]))
        assert found.simulations == 3

    def test_the_mean_over_episodes_is_linearised(self):
        scenario = small_lift(integrator="implicit", points=300)
        episodes = [clouds_of(scenario, seed=seed, **TRUTH) for seed in (1, 2)]
        places = Axis.of(SPACE).places(SPACE.starts(2, seed=1)[0])
        members = [paper_objective(scenario, episode) for episode in episodes]
        both = linearise(JointObjective(members), SPACE, places)
        one, other = (linearise(member, SPACE, places) for member in members)
        for name in ("losses", "slope", "curvature"):
            torch.testing.assert_close(getattr(both, name), (getattr(one, name) + getattr(other, name)) / 2)
        assert both.simulations == 4

    def test_differences_agree_with_tangents(self, monkeypatch):
        """Of the same motion, with a step so short that the differences are as good."""
        monkeypatch.setattr(residuals, "STEP", 1e-4)
        objective, found = lifted(), []
        places = Axis.of(SPACE).places(torch.tensor([[0.9, 1.2], [2.0, 0.5]], dtype=torch.float64))
        for integrator in ("implicit", "linearised"):  # which of both ways is taken
            scenario = objective.scenario
            objective.scenario = replace(scenario, scene=replace(scenario.scene, integrator=integrator))
            found.append(linearise(objective, SPACE, places))
        by_tangents, by_differences = found
        assert [one.simulations for one in found] == [2, 10]
        torch.testing.assert_close(by_differences.losses, by_tangents.losses)
        torch.testing.assert_close(by_differences.slope, by_tangents.slope, rtol=1e-3, atol=1e-10)
        torch.testing.assert_close(by_differences.curvature, by_tangents.curvature, rtol=1e-3, atol=1e-10)

    @pytest.mark.parametrize("joint", [False, True], ids=["alone", "joint"])
    @pytest.mark.parametrize("measure", [{"paper": True}, {"nuisance": {"x": 0.1, "yaw": 0.3}}], ids=["paper", "posed"])
    def test_differences_tell_the_losses_beside(self, joint, measure):
        """With the priors, at the pose of the place in the middle; a bound is where it ends."""
        members = rough_pair(**measure)[: 1 + joint]
        objective = JointObjective(members) if joint else members[0]
        space = FitSpace.build(SPACE.names, bounds={"stretch": (0.1, 1.0), "mass": (0.1, 1.5)}, priors={"stretch": 0.7})
        axis = Axis.of(space)
        places = torch.stack([axis.places(torch.tensor([0.9, 1.2]).double()), axis.ends[1]])
        found = linearise(objective, space, places)
        beside, losses = found.beside
        up, down = torch.eye(2).double()[:, None] * residuals.STEP, -torch.eye(2).double()[:, None] * residuals.STEP
        torch.testing.assert_close(beside, torch.cat([places + up, places + down]).minimum(axis.ends[1]))

        def at_pose(member):
            pose = member.match(member.simulate_to_loss(space.parameters(axis.values(places)))).pose.repeat(4, 1)
            run = member.simulate_to_loss(space.parameters(axis.values(beside.flatten(0, 1))))
            return member.frame_losses(run, pose=pose).mean(-1) * member.pose_space.prior_factor(pose)

        of_each = torch.stack([at_pose(one) for one in members])
        mean = of_each.mean(0) if objective.paper else of_each.log().mean(0).exp()
        expected = mean * space.prior_factor(axis.values(beside.flatten(0, 1)), len(members))
        torch.testing.assert_close(losses, expected.reshape(losses.shape))
        own = batch_losses(objective, space, axis.bounded(beside.flatten(0, 1))).reshape(losses.shape)
        assert bool((losses > own * (1 - 1e-4)).all())  # poses are solved for to that
        torch.testing.assert_close(losses[:2, 1], found.losses[1].expand(2))
        implicit = lifted(**measure)
        for one in (implicit, JointObjective([implicit, lifted(**measure)])):
            assert linearise(one, space, places).beside is None

    def test_a_variable_of_one_recording_moves_its_loss_alone(self):
        """The mean loss beside has the other recordings' losses as they are."""
        members = rough_pair(nuisance={})
        space = with_laid(SPACE, [{"turn": 0.1}] * 2, [one.scenario for one in members])
        objective, axis = JointObjective(members), Axis.of(space)
        place = torch.cat(
            [axis.places(space.starts(1, seed=0)[0].double())[:, :2], torch.tensor([[0.8, -1.5]]).double()], 1
        )
        beside, losses = linearise(objective, space, place).beside
        assert beside.shape == (8, 1, 4)
        torch.testing.assert_close(losses[:, 0], batch_losses(objective, space, axis.bounded(beside[:, 0])))
        assert len(losses.round(decimals=9).unique()) == 8

    @pytest.mark.parametrize("integrator", ["implicit", "linearised"])
    def test_a_bound_has_a_slope_too(self, integrator):
        """Differences are halved there, and nothing is simulated beyond."""
        objective = lifted(integrator=integrator)
        found = linearise(objective, SPACE, Axis.of(SPACE).ends[1][None])
        assert bool(torch.isfinite(found.slope).all())
        assert bool((found.slope != 0).all())

    def test_a_place_that_diverges_is_infinite_and_flat(self, monkeypatch):
        objective = lifted()
        whole = objective.scenario.properties

        def broken(system, values):
            found = whole(system, values)
            bad = values["stretch"] > 5
            found.node_mass[bad] = float("nan")
            return found

        monkeypatch.setattr(type(objective.scenario), "properties", lambda self, system, values: broken(system, values))
        places = Axis.of(SPACE).places(torch.tensor([[1.0, 1.0], [9.0, 1.0]], dtype=torch.float64))
        found = linearise(objective, SPACE, places)
        assert found.losses.isfinite().tolist() == [True, False]
        assert bool((found.slope[1] == 0).all())
        assert bool((found.slope[0] != 0).all())

    def test_a_difference_that_diverges_costs_its_place_alone(self, monkeypatch):
        """The second place's: 5 % above it the cloth is too stiff, though not there."""
        objective, real = lifted(integrator="linearised"), Objective.simulate_to_loss

        def broken(self, parameters):
            bad = (parameters["stretch"] > 9.0).nonzero().flatten().tolist()
            if bad:
                raise DivergedError(3, bad, "test")
            return real(self, parameters)

        monkeypatch.setattr(Objective, "simulate_to_loss", broken)
        places = Axis.of(SPACE).places(torch.tensor([[1.0, 1.0], [8.9, 1.0], [2.0, 1.0]], dtype=torch.float64))
        found = linearise(objective, SPACE, places)
        assert found.losses.isfinite().tolist() == [True, False, True]
        assert found.beside[1].isfinite().all(0).tolist() == [True, False, True]
        alone = linearise(objective, SPACE, places[1:2])
        assert alone.losses.isfinite().tolist() == [False]
        assert alone.beside[1].isinf().all()


class TestSurface:
    def test_normals_of_a_sphere(self, generator):
        points = torch.randn(3000, 3, generator=generator, dtype=torch.float64)
        points /= points.norm(dim=-1, keepdim=True)
        cloud = NeighbourIndex(points)
        assert float((cloud.normals * points).sum(-1).abs().min()) > 0.98
        assert cloud.spacing == pytest.approx(0.5 * math.sqrt(4 * math.pi / 3000), rel=0.1)  # of a Poisson process

    @pytest.mark.parametrize("count", [1, 2])
    def test_too_few_points_have_none(self, count):
        cloud = NeighbourIndex(torch.rand(count, 3, dtype=torch.float64))
        assert bool((cloud.normals == 0).all())
        assert cloud.spacing == 0.0
        assert cloud.from_surface == (0.0, 0.0)

    def test_how_far_points_and_their_surface_are_apart(self, generator):
        """Of a Poisson process on a plane, E|x - nearest|² = 1 / (π density); across it, the points' own noise."""
        points = torch.rand(20_000, 3, generator=generator, dtype=torch.float64)
        points[:, 2] = 1e-4 * torch.randn(20_000, generator=generator, dtype=torch.float64)
        along, across = NeighbourIndex(points).from_surface
        assert along == pytest.approx(1 / (math.pi * 20_000), rel=0.1)
        assert across**0.5 == pytest.approx(1e-4 * (1 + 1 / 12) ** 0.5, rel=0.1)


class TestFits:
    def test_the_truth_is_found_in_few_runs(self):
        found = fit_gauss_newton(lifted(), SPACE, GaussNewtonSettings(starts=2, screen=15, iterations=60))
        assert found.stop_reason == "converged"
        assert found.simulations <= 70
        assert found.values["stretch"] / found.values["mass"] == pytest.approx(TRUTH["stretch"] / TRUTH["mass"], rel=0.05)
        noise = lifted()({name: torch.tensor([value]).double() for name, value in TRUTH.items()})
        assert found.loss <= 1.02 * float(noise)  # the fit's own points, to which it adapts

    def test_it_does_not_matter_where_it_starts(self):
        """From below, and from above."""
        space = FitSpace.build(["stretch"], fixed={"mass": TRUTH["mass"]})
        ends = [
            fit_gauss_newton(
                lifted(), space, GaussNewtonSettings(screen=0, starts=1, iterations=40, init={"stretch": first})
            ).values["stretch"]
            for first in (0.1, 3.0)
        ]
        assert ends[0] == pytest.approx(ends[1], rel=0.01)
        np.testing.assert_allclose(ends, TRUTH["stretch"], rtol=0.03)

    def test_a_start_that_is_given_is_followed(self):
        found = fit_gauss_newton(
            lifted(), SPACE, GaussNewtonSettings(starts=2, screen=7, init={"stretch": 9.0, "mass": 9.0})
        )
        assert found.start == {"stretch": pytest.approx(9.0), "mass": pytest.approx(9.0)}

    def begun(self, objective, place):
        """Where a step on the first half leads."""
        init = dict(zip(SPACE.names, place.tolist(), strict=True))
        return fit_gauss_newton(
            objective.until(0.5), SPACE, GaussNewtonSettings(starts=1, screen=0, iterations=1, init=init)
        ).values

    def test_a_single_start_is_the_best_of_the_screen_on_the_first_half_and_descends_there_first(self):
        objective, values = lifted(nuisance={}), SPACE.starts(8, seed=2)[0].double()
        found = fit_gauss_newton(objective, SPACE, GaussNewtonSettings(starts=1, screen=7, iterations=1, seed=2))
        early, late = (batch_losses(one, SPACE, values).argmin() for one in (objective.until(0.5), objective))
        assert early != late  # else this shows nothing
        assert found.start == pytest.approx(self.begun(objective, values[early]))
        start = torch.tensor([list(found.start.values())]).double()
        assert found.loss_start == pytest.approx(float(batch_losses(objective, SPACE, start)), rel=1e-9)
        assert found.simulations == 8 + 2 + 2

    def test_from_the_first_half_on_all_starts_come_to_the_truth(self):
        """Descents on the whole alone end beside it, where the cloth has folded in another way."""
        scenario, truth = load_scenario("lift"), {"stretch": 1.4, "mass": 2.1}
        objective = Objective(scenario, clouds_of(scenario, points=1500, **truth), nuisance={}, points=300)
        space = FitSpace.build(["stretch"], bounds=scenario.bounds, fixed={"mass": truth["mass"]})
        ends = fit_gauss_newton(objective, space, GaussNewtonSettings(starts=3, threshold=1e-30)).history.values[-1]
        np.testing.assert_allclose(ends, truth["stretch"], rtol=0.05)

    def test_without_a_screen_starts_are_spread(self):
        found = fit_gauss_newton(lifted(), SPACE, GaussNewtonSettings(starts=3, screen=0, iterations=1))
        assert found.simulations == 6
        torch.testing.assert_close(found.history.values[0], SPACE.starts(3, seed=0)[0].double())

    def test_where_the_chosen_start_diverges_later_the_next_candidate_is_taken(self, monkeypatch):
        objective, values = lifted(nuisance={}), SPACE.starts(8, seed=0)[0].double()
        order = batch_losses(objective.until(0.5), SPACE, values).argsort()

        def failing(objective, space, places):
            found = linearise(objective, space, places)
            diverges = torch.allclose(Axis.of(space).values(places)[0], values[order[0]])
            return replace(found, losses=torch.full_like(found.losses, math.inf)) if diverges else found

        monkeypatch.setattr(gauss_newton, "linearise", failing)
        found = fit_gauss_newton(objective, SPACE, GaussNewtonSettings(starts=1, screen=7, iterations=1))
        assert found.start == pytest.approx(self.begun(objective, values[order[1]]))

    def test_bounds_hold_and_the_rest_goes_on(self):
        space = FitSpace.build(["stretch", "mass"], bounds={"stretch": (1.5, 10.0)})
        found = fit_gauss_newton(lifted(), space, GaussNewtonSettings(starts=2, screen=7))
        assert found.values["stretch"] == pytest.approx(1.5)
        assert found.values["mass"] > TRUTH["mass"]
        assert found.stop_reason == "converged"

    def test_the_same_settings_give_the_same_fit(self):
        settings = GaussNewtonSettings(starts=2, screen=7, iterations=4)
        one, other = (fit_gauss_newton(lifted(), SPACE, settings) for _ in range(2))
        assert one.values == other.values
        assert one.simulations == other.simulations

    @pytest.mark.parametrize(("settings", "reason"), [({"threshold": 1.0}, "threshold"), ({"iterations": 1}, "iterations")])
    def test_other_ends(self, settings, reason):
        found = fit_gauss_newton(lifted(), SPACE, GaussNewtonSettings(starts=1, screen=0, **settings))
        assert found.stop_reason == reason
        assert found.iterations == len(found.history.losses) - 1 == (0 if reason == "threshold" else 1)

    def test_ctrl_c_keeps_the_best_so_far(self):
        def interrupt(progress):
            if progress.iteration == 2:
                raise KeyboardInterrupt

        found = fit_gauss_newton(lifted(), SPACE, GaussNewtonSettings(starts=2, screen=7), progress=interrupt)
        assert found.stop_reason == "interrupted"
        assert found.loss == float(found.history.losses[-1].min())

    def test_losses_never_rise(self):
        found = fit_gauss_newton(lifted(), SPACE, GaussNewtonSettings(starts=3, screen=7))
        losses = torch.stack(found.history.losses)
        begun = losses[-1].isfinite()
        assert bool((losses[:, begun].diff(dim=0).nan_to_num() <= 0).all())

    def test_starts_are_followed_one_after_the_other_until_one_explains_the_recording(self, monkeypatch):
        settings, fits = GaussNewtonSettings(starts=3, screen=7), []
        for explained, threshold in ((1e-12, 0.0), (1.0, 0.0), (1.0, 1e-30)):  # never, at once, not low enough
            monkeypatch.setattr(Objective, "explained", explained)
            fits.append(fit_gauss_newton(lifted(), SPACE, replace(settings, threshold=threshold)))
        every, enough, lower = fits
        begun = [torch.stack(found.history.losses).isfinite().sum(0).tolist() for found in (every, enough)]
        assert begun[1][1:] == [0, 0]
        assert begun[0][0] > begun[0][1] > begun[0][2] > 0
        assert enough.simulations < every.simulations == lower.simulations
        assert enough.stop_reason == every.stop_reason == "converged"

    def test_two_equal_ends_are_enough_unless_a_number_of_starts_or_a_threshold_is_given(self, monkeypatch):
        monkeypatch.setattr(Objective, "explained", 1e-12)
        monkeypatch.setattr(gauss_newton, "_EQUALLY", math.inf)
        monkeypatch.setattr(gauss_newton, "_MOST", 3)
        followed = [
            sum(torch.stack(found.history.losses).isfinite().any(0).tolist())
            for found in (
                fit_gauss_newton(lifted(), SPACE, GaussNewtonSettings(screen=7, iterations=3, **given))
                for given in ({}, {"threshold": 1e-30}, {"starts": 3})
            )
        ]
        assert followed == [2, 3, 3]

    def test_a_step_is_the_lowest_between_the_bounds(self, rng):
        """Cutting off a step at a bound may lead uphill, which looked like the end of a descent."""
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

    def test_a_way_that_runs_into_a_bound_goes_on_along_it(self):
        """Both variables of a valley fall together; the second one is nearly at its lower bound."""
        curvature = torch.tensor([[1.0, -0.99], [-0.99, 1.0]]).double()
        slope = torch.tensor([0.1, 0.3]).double()
        way = gauss_newton._Way(
            torch.tensor([0.0, -0.99]).double(), Linearisation(torch.ones(1).double(), slope[None], curvature[None], 1), 3
        )
        tried = way.propose(torch.full((2,), -1.0).double(), torch.full((2,), 1.0).double())
        torch.testing.assert_close(tried, torch.tensor([-0.1 - 0.99 * 0.01, -1.0]).double(), atol=0.01, rtol=0)
        assert way._predicted > 0

    def test_a_step_in_vain_makes_the_next_one_shorter_and_a_good_one_longer(self):
        """The lowest place of a flat valley lies 20 away."""
        curvature, slope = torch.tensor([[1.0, 0.0], [0.0, 1e-6]]).double(), torch.tensor([0.0, 2e-5]).double()
        end = torch.full((2,), 100.0).double()

        def told(loss):
            return Linearisation(torch.tensor([loss]).double(), slope[None], curvature[None], 1)

        way, steps = gauss_newton._Way(torch.zeros(2).double(), told(1e-3), 9), []
        for part in (-1, -1, 1, 0.1, 0.4, 1, 1, 1, 1, 0, 0):  # of the predicted decrease
            tried = way.propose(-end, end)
            steps.append(float((tried - way.place).abs().max()))
            way.judge(tried, told(way.loss - part * way._predicted))
        assert steps == pytest.approx([1.0, 0.2, 0.04, 0.12, 0.06, 0.06, 0.18, 0.54, 1.0, 1.0, 0.2])
        assert way.end is None

    @pytest.mark.parametrize(
        ("predicted", "part", "end"),
        [(5e-5, 1, "converged"), (5e-4, 1, None), (5e-4, -1, "converged"), (5e-3, -1, None)],
        ids=["little to gain", "enough to gain", "rough over that length", "a shorter step may help"],
    )
    def test_what_ends_a_way(self, predicted, part, end):
        """By the predicted decrease, as a part of the loss, and what part of that a step brings."""
        slope = torch.tensor([predicted / 2]).double()
        flat = torch.tensor([[1e-9]]).double()
        way = gauss_newton._Way(
            torch.zeros(1).double(), Linearisation(torch.ones(1).double(), slope[None], flat[None], 1), 9
        )
        tried = way.propose(torch.full((1,), -9.0).double(), torch.full((1,), 9.0).double())
        assert way._predicted == pytest.approx(predicted, rel=1e-3)
        loss = torch.tensor([1.0 - part * way._predicted]).double()
        way.judge(tried, Linearisation(loss, slope[None], flat[None], 1))
        assert way.end == end

    def test_where_no_step_lowers_a_loss_it_is_rough(self):
        """However much is predicted."""
        slope, curvature = torch.tensor([[0.5]]).double(), torch.eye(1).double()[None]
        found = Linearisation(torch.ones(1).double(), slope, curvature, 1)
        way, end, steps = gauss_newton._Way(torch.zeros(1).double(), found, 20), torch.ones(1).double(), 0
        while way.end is None:
            way.judge(way.propose(-9 * end, 9 * end), replace(found, losses=torch.full((1,), 2.0).double()))
            steps += 1
        assert (way.end, steps) == ("rough", 4)

    def test_a_rough_way_goes_on_from_the_lowest_place_that_it_passed_by(self):
        """Down a slope with ripples that are wider than the last steps, and narrower than the differences."""

        def loss(places):
            return 1 + (places - 0.3).square() + 0.03 * (37 * places).sin()

        def told(place, *, beside):
            sides = place + residuals.STEP * torch.tensor([[1.0], [-1.0]]).double()
            slope = (loss(sides[0]) - loss(sides[1])) / (4 * residuals.STEP)
            return Linearisation(
                loss(place), slope[None], torch.eye(1).double()[None], 1, (sides[:, None], loss(sides)) if beside else None
            )

        ends, starts, lower = torch.full((1,), 9.0).double(), torch.linspace(-2, 2, 9).double(), 0
        for start in starts:
            reached = []
            for beside in (False, True):
                place = start[None]
                first = told(place, beside=beside)
                way, seen = gauss_newton._Way(place, first, 40), first.beside[1].flatten().tolist() if beside else []
                while way.end is None:
                    tried = way.propose(-ends, ends)
                    found = told(tried, beside=beside)
                    seen += [] if found.beside is None else found.beside[1].flatten().tolist()
                    way.judge(tried, found)
                reached.append(way.loss)
            assert way.end in ("converged", "rough")
            assert way.loss <= min(seen) / (1 - 1e-3)
            assert reached[1] <= reached[0]
            lower += reached[1] < 0.99 * reached[0]
        assert lower > 3

    @pytest.mark.parametrize("there", [math.inf, 1.5])
    @pytest.mark.parametrize("end", ["converged", "rough"])
    def test_a_place_passed_by_that_is_not_lower_after_all_is_tried_once(self, end, there):
        """Its motion goes astray, or its pose does: the way ends where it stands, and why it stands stays true."""
        way, ends = gauss_newton._Way(ZERO, beside(1.0, slope=0.0 if end == "converged" else 0.5), 20), 9 + 0 * ZERO
        while not way._aside:
            way.judge(way.propose(-ends, ends), beside(2.0))
        assert way.end is None
        assert way.propose(-ends, ends).tolist() == pytest.approx([-0.05])
        way.judge(way.propose(-ends, ends), replace(beside(there), beside=None))
        assert (way.end, way.loss, way.place.tolist()) == (end, 1.0, [0.0])

    def test_a_way_without_steps_has_not_arrived_while_a_lower_place_is_known(self):
        way, ends = gauss_newton._Way(ZERO, beside(1.0), 1), 9 + 0 * ZERO
        way.judge(way.propose(-ends, ends), beside(1.0))
        assert way.end == "iterations"

    def test_candidates_are_compared_by_fewer_points(self, monkeypatch):
        """One frame has all of a scenario's."""

        def losses(objective, *given):
            screened.append(len(objective.sampler.choice))
            return batch_losses(objective, *given)

        screened = []
        monkeypatch.setattr(gauss_newton, "batch_losses", losses)
        monkeypatch.setattr(gauss_newton, "_SCREENED_POINTS", 100)
        fit_gauss_newton(
            lifted(nuisance={"x": 0.1}, frames=[-1]), SPACE, GaussNewtonSettings(screen=3, starts=1, iterations=1)
        )
        assert screened == [100]

    def test_a_joint_fit_follows_as_many_starts_as_are_asked_for(self):
        pair = JointObjective([lifted(nuisance={}), lifted(nuisance={})])
        settings = GaussNewtonSettings(screen=3, iterations=1, starts=2)
        assert len(fit_gauss_newton(pair, SPACE, settings).history.losses[-1]) == 2

    def test_the_truth_explains_a_recording_and_others_do_not(self):
        objective = lifted(nuisance={})
        told = {name: torch.tensor([TRUTH[name], 1.3 * TRUTH[name]]).double() for name in TRUTH} | {
            "mass": torch.tensor([TRUTH["mass"]] * 2).double()
        }
        right, wrong = objective(told).tolist()
        assert right < objective.explained < wrong
        assert lifted().explained == 0.0  # the paper's measure
        whole = objective.explained
        objective.episode = replace(objective.episode, camera=np.zeros(len(objective.episode.points), np.uint8))
        assert not objective.knows_gaps  # a camera may have missed a part of it
        assert objective.explained == pytest.approx(2.0 / 1.25 * whole)

    def test_a_first_start_beyond_the_bounds_begins_at_the_bound(self):
        settings = GaussNewtonSettings(starts=1, screen=0, init={"stretch": 40.0, "mass": 1.0})
        found = fit_gauss_newton(lifted(), SPACE, settings)
        assert found.history.values[0][0].tolist() == pytest.approx([float(Axis.of(SPACE).high[0]), 1.0])
        assert found.loss < float(found.history.losses[0][0])

    def test_when_all_diverge(self, monkeypatch):
        objective = lifted()

        def diverges(*_, **__):
            raise DivergedError(3, list(range(1)), "too soft")

        monkeypatch.setattr("diffcloud.fit.inputs.rollout_tangents", diverges)
        with pytest.raises(DivergedError, match="starts diverged"):
            fit_gauss_newton(objective, SPACE, GaussNewtonSettings(screen=0, starts=1))
