"""The likelihood with a variance for each frame, and the fit that it leads to."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from diffcloud.errors import DivergedError
from diffcloud.estimation.joint import JointObjective
from diffcloud.estimation.likelihood import Answer, Estimate, LikelihoodSettings, energy
from diffcloud.estimation.likelihood.descent import Descent
from diffcloud.estimation.likelihood.energy import Likelihood, up_to_horizon
from diffcloud.estimation.likelihood.estimate import places_beside
from diffcloud.estimation.likelihood.frames import Frames
from diffcloud.estimation.likelihood.grasp import in_powers, regripped, that_fits
from diffcloud.estimation.likelihood.recording import Changes, Linear
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace, Variable
from diffcloud.estimation.solvers import fit_likelihood
from diffcloud.scene.scenarios import load_scenario
from diffcloud.scene.scenarios.grid import LIFT, GridScenario, grid_scenario
from tests.conftest import small_lift
from tests.estimation.test_fit import GENTLE, clouds_of

TRUTH = {"stretching": 0.6, "density": 1.7}
SCENARIO = small_lift(**{**GENTLE, "integrator": "implicit", "points": 2000})
POSE = {"x": 0.01, "yaw": 0.05}
SPACE = FitSpace(
    (Variable("stretching", 0.03, 30.0, 10.0), Variable("bending", 0.1, 10.0, 1.5, role="material")),
    {"density": TRUTH["density"]},
)


def objective(scenario=SCENARIO, **changes):
    """Of a cloth on the finer mesh, by which the fit corrects its own."""
    return Objective(scenario, clouds_of(scenario.finer(), **{"points": 2000, **TRUTH, **changes}), nuisance=POSE)


@pytest.fixture(scope="module")
def member():
    return Likelihood([objective()], SPACE, LikelihoodSettings())


FINE = small_lift(**{**GENTLE, "integrator": "implicit", "points": 2000, "nodes": (9, 9)})
"""On a mesh whose faces are small enough to lie on the finer cloth. Larger faces cut its curves short."""


@pytest.fixture(scope="module")
def found():
    return fit_likelihood(objective(FINE), SPACE, LikelihoodSettings())


def frames(squares, variances, variables=1):
    squares, variances = (torch.tensor(part, dtype=torch.float64) for part in (squares, variances))
    shape = (*squares.shape, variables)
    return Frames(squares, torch.zeros(shape), torch.zeros(*shape, variables), torch.zeros(shape), variances)


class TestFrames:
    def test_a_frame_within_its_variance_counts_by_its_squares(self):
        one = frames([[0.2], [0.4]], [[1.0], [1.0]])
        assert one.chi_squares.tolist() == pytest.approx([0.3])
        assert one.energy() == pytest.approx(0.3)

    def test_a_frame_beyond_it_has_a_variance_of_its_own(self):
        """Whatever is known of it: what it says is the logarithm of its squares alone."""
        squares = [[9.0], [9.0]]
        one, other = (frames(squares, [[known], [known]]).energy() for known in (1.0, 3.0))
        assert one == pytest.approx(other) == pytest.approx(1 + math.log(9.0))

    @pytest.mark.parametrize("times", [0.1, 10.0])
    def test_the_weights_are_its_slope(self, times, rng):
        variances, squares = rng.uniform(0.5, 2.0, (2, 3)), times * rng.uniform(0.5, 2.0, (2, 3))
        told = frames(squares.tolist(), variances.tolist()).weights
        for way, frame in np.ndindex(2, 3):
            step = np.zeros((2, 3))
            step[way, frame] = 1e-6 * times
            above, below = (frames((squares + sign * step).tolist(), variances.tolist()).energy() for sign in (1, -1))
            assert (above - below) / (2e-6 * times) == pytest.approx(float(told[way, frame]), rel=1e-6)


class TestRecording:
    def at(self, member, place, shift=None, asked=None):
        (recording,) = member.recordings
        with torch.no_grad():
            return Linear.at(recording, place).frames(place, Changes(shift), asked)

    def test_slopes_are_those_of_the_squares(self, member):
        """By material and pose, forth and back, in all frames but those in which points begin to count."""
        place = member.start({"stretching": 0.8}, 0.0)
        place[2:] = torch.tensor([0.3, -0.2], dtype=torch.float64)
        here, step = self.at(member, place), 2e-3
        for variable in range(len(place)):
            away = torch.zeros_like(place)
            away[variable] = step
            above, below = (self.at(member, place + sign * away).squares for sign in (1, -1))
            central, told = (above - below) / (4 * step), here.slopes[..., variable]
            assert int(((central - told).abs() > 0.02 * told.abs().max()).sum()) <= 2

    def test_what_a_shift_of_the_nodes_does_to_the_slopes(self):
        """Where the cloth lies as it was recorded, from recorded points to the surface."""
        episode = clouds_of(SCENARIO, points=2000, **TRUTH)
        member = Likelihood([Objective(SCENARIO, episode, nuisance=POSE)], SPACE, LikelihoodSettings())
        place = member.start({"stretching": TRUTH["stretching"]}, 0.0)
        lying = self.at(member, place)
        up = torch.zeros(1, lying.squares.shape[1], len(SCENARIO.scene.mesh.nodes), 3).double()
        up[..., 2] = 0.0002
        asked, moved = self.at(member, place, None, up), self.at(member, place, up)
        change = (moved.slopes - lying.slopes)[1]
        assert float((asked.shifted[1] - change).abs().max()) < 0.1 * float(change.abs().max())
        assert float(moved.variances[0, 0] - lying.variances[0, 0]) == pytest.approx(1e-8, rel=1e-6)

    def test_frames_count_up_to_where_the_meshes_part(self, member, monkeypatch):
        for apart, count in ((1.0, 12), (1e-9, 5)):
            monkeypatch.setattr(energy, "_GONE_M", apart)
            monkeypatch.setattr(energy, "_PART_M", apart)
            assert member.horizons(member.start({}, 0.0)) == [count]

    def test_early_frames_are_tried_first(self, monkeypatch):
        """What the finer mesh changes in the frames that count is not simulated again."""
        monkeypatch.setattr(energy, "_EARLY_S", 0.7)
        for apart, count, simulations in ((1.0, 12, 4), (1e-9, 5, 2)):
            monkeypatch.setattr(energy, "_GONE_M", apart)
            monkeypatch.setattr(energy, "_PART_M", apart)
            found = up_to_horizon([objective()], SPACE, LikelihoodSettings())
            assert (found.frames, found.simulations) == (count, simulations)
            (recording,), place = found.recordings, found.start({}, 0.0)
            assert torch.equal(recording.refined[0], place)
            again = recording.change(place, recording.nodes(place), recording.finer)
            torch.testing.assert_close(recording.refined[1], again, rtol=0.0, atol=1e-12)


class TestDeparture:
    def test_the_frames_after_it_do_not_move_the_result(self):
        """In the last three frames, the recorded cloth is 2 cm higher. Without them, the result is the same."""
        whole = clouds_of(FINE.finer(), points=2000, **TRUTH)
        points = whole.points.copy()
        points[whole.offsets[-4] :, 2] += 0.02
        departed = Objective(FINE, replace(whole, points=points), nuisance=POSE)
        told = fit_likelihood(departed, SPACE, LikelihoodSettings()).estimate
        assert told.departs == (True,)
        before = departed.frames[:-3]
        assert told.members[0].frames == before
        assert len(told.best.chi_squares[0]) == len(before)
        assert max(told.best.chi_squares[0]) < energy.FOLLOWS
        alone = fit_likelihood(departed.earliest([len(before)]), SPACE, LikelihoodSettings()).estimate
        assert alone.departs == (False,)
        assert abs(float(told.mean[0] - alone.mean[0])) < 0.3 * float(alone.covariance[0, 0].sqrt())

    def test_later_frames_are_left_out(self, member):
        squares = [0.5] * 12
        assert member.before_departure([squares]) is None
        for first, count in ((8, 8), (2, 5)):
            shorter = member.before_departure([[*squares[:first], 1.6, *squares[first + 1 :]]])
            assert shorter.frames == count
        assert member.earliest([5]).before_departure([[9.0] * 5]) is None


class TestGrasp:
    def scenario(self, size, within=1.5):
        options = {"nodes": (7, 7), "size_m": (0.3, 0.3), "frames": 10, "steps_per_frame": 8, "air": "none"}
        options |= {"grip_m": size, "grip_known_within": within, "initial_state": "none"}
        return grid_scenario(GridScenario.model_validate({**LIFT.model_dump(), **options}))

    def test_what_it_changes_is_that_of_the_simulated_ones(self, generator):
        smaller, larger = torch.randn(2, 1, 3, 5, 3, generator=generator).double()
        first, second = in_powers([smaller, larger])
        torch.testing.assert_close(first + second, larger)
        torch.testing.assert_close(second - first, smaller)
        first, second = in_powers([smaller])
        torch.testing.assert_close(second - first, smaller)
        assert in_powers([smaller, None]) is None
        assert in_powers([]) is None

    def test_its_slope_is_that_of_the_squares(self):
        episode = clouds_of(self.scenario(0.03), points=2000)
        whole = Likelihood([Objective(self.scenario(0.02), episode, nuisance=POSE)], SPACE, LikelihoodSettings())
        (recording,), place = whole.recordings, whole.start({}, 0.0)
        assert len(place) == len(SPACE.names) + len(POSE) + 1
        linear = Linear.at(recording, place)
        grips = [recording.change(place, linear.nodes, other) for other in recording.regripped]
        assert len(grips) == 2
        changes, step, column = Changes(None, in_powers(grips)), 1e-3, len(SPACE.names)
        place[-1] = 0.5
        away = torch.zeros_like(place)
        away[-1] = step
        above, below = (linear.frames(place + sign * away, changes).squares for sign in (1, -1))
        central, told = (above - below) / (4 * step), linear.frames(place, changes).slopes[..., column]
        # from recorded points to the surface; the other way, points jump between faces, whose areas change
        torch.testing.assert_close(told[1], central[1], rtol=1e-3, atol=1e-3 * float(central[1].abs().max()))

    def test_one_that_does_not_fit_is_left_out(self):
        """On a cloth of 30 cm, a pad of 20 cm may be half as large, and not twice."""
        wide = self.scenario(0.2, 2.0)
        assert [one.scene.handles.grasp.size for one in regripped(wide)] == [pytest.approx(0.1)]
        member = SimpleNamespace(scenario=wide)
        assert that_fits([member], -1.0) == -1.0
        assert that_fits([member], 0.9) == 0.225
        assert that_fits([member], 40.0) == 0.0
        assert that_fits([SimpleNamespace(scenario=SCENARIO)], 3.0) == 3.0

    @pytest.mark.slow
    def test_a_grasp_that_was_stated_too_small_is_found(self):
        """Stretching would make up for it."""
        truth = {"stretching": 5.0, "density": 1.0}
        episode = clouds_of(self.scenario(0.024, 1.0).finer(), points=2000, **truth)
        space = FitSpace((Variable("stretching", 0.03, 300.0, 10.0, 1.0),), {"density": 1.0})
        believed, found = (
            fit_likelihood(
                Objective(self.scenario(0.016, within), episode, nuisance={}), space, LikelihoodSettings()
            ).estimate
            for within in (1.0, 1.5)
        )
        assert 0.4 < found.grip < 1.3  # the truth is one deviation larger
        off, believed_off = (math.log(one.values["stretching"] / truth["stretching"]) for one in (found, believed))
        assert believed_off > 0.5
        assert abs(off) < 0.4 * believed_off
        assert {"grasp"} == {*found.sources} - {*believed.sources}
        assert found.members[0].scenario.scene.handles.grasp.size == pytest.approx(0.016 * 1.5**found.grip)


class TestMixture:
    def answers(self, *energies):
        return tuple(
            Answer(
                torch.tensor([float(index)]).double(), torch.tensor([[0.5]]).double(),
                {"recording": torch.tensor([[0.5]]).double()}, energy, True, ([1.0],), ([0.0],), (),
            )
            for index, energy in enumerate(energies)
        )  # fmt: skip

    def test_equally_likely_answers(self):
        found = Estimate(FitSpace((SPACE.variables[0],), {}), self.answers(3.0, 3.0), (), (), None, 2)
        assert found.weights.tolist() == [0.5, 0.5]
        assert float(found.mean) == 0.5
        assert float(found.covariance) == pytest.approx(0.5 + 0.25)
        assert float(found.sources["starts"]) == pytest.approx(0.25)

    def test_an_unlikely_one_hardly_counts(self):
        found = Estimate(FitSpace((SPACE.variables[0],), {}), self.answers(0.0, 40.0), (), (), None, 2)
        assert float(found.mean) < 1e-8
        assert float(found.covariance) == pytest.approx(0.5, abs=1e-7)


class TestCorrections:
    def descended(self, likelihood, place):
        return Descent(likelihood, place, lambda *progress: None).run(math.inf)

    def test_one_serves_all_descents_that_end_near_it(self, found):
        """And fewer frames of the same recording."""
        likelihood = Likelihood(found.estimate.members, SPACE, LikelihoodSettings())
        first = self.descended(likelihood, found.estimate.best.place)
        count, known = len(likelihood.corrections), likelihood.nearest(first.place)
        assert known.distance(first.place, first.covariance.diagonal().sqrt()) < 0.5
        self.descended(likelihood, first.place)
        assert len(likelihood.corrections) == count
        shorter = likelihood.earliest([7])
        (changes,), (recording,) = shorter.nearest(first.place).changes, shorter.recordings
        again = recording.change(known.place, recording.nodes(known.place), recording.finer)
        torch.testing.assert_close(changes.finer, again, rtol=0.0, atol=1e-12)

    def test_elsewhere_it_is_simulated_again(self, found):
        likelihood = Likelihood(found.estimate.members, SPACE, LikelihoodSettings())
        self.descended(likelihood, likelihood.start({}, 2.0))
        places = [one.place for one in likelihood.corrections]
        assert len(places) > 1
        assert likelihood.nearest(places[-1]) is likelihood.corrections[-1]
        deviations = found.estimate.best.covariance.diagonal().sqrt()
        assert likelihood.corrections[0].distance(places[-1], deviations) > 0.5


class TestStartsBesideAResult:
    def test_the_other_variables_are_the_most_likely_ones(self, found):
        """Of a quadratic Φ, whose slope there is along the first variable alone."""
        best, likelihood = found.estimate.best, Likelihood([objective(FINE)], SPACE, LikelihoodSettings())
        for side, place in zip((1, -1), places_beside(best, likelihood), strict=True):
            away = place - best.place
            assert float(away[0]) == pytest.approx(2 * side * float(best.covariance[0, 0].sqrt()))
            slope = torch.linalg.solve(best.covariance, away)
            torch.testing.assert_close(slope[1:], torch.zeros_like(slope[1:]), rtol=0.0, atol=1e-9)

    def test_their_results_are_mixed_in(self, found):
        counts = [
            len(one.estimate.answers) for one in (found, fit_likelihood(objective(), SPACE, LikelihoodSettings(starts=1)))
        ]
        assert counts[0] in (4, 5)
        assert counts[1] == 1


class TestFits:
    def test_the_truth_is_in_the_interval(self, found):
        told = found.estimate
        deviation = float(told.covariance[0, 0].sqrt())
        assert found.stop_reason == "converged"
        assert abs(float(told.mean[0]) - math.log(TRUTH["stretching"])) < 1.645 * deviation
        assert 0.005 < deviation < 0.5
        assert np.median(told.best.chi_squares[0]) < 1.5
        assert told.simulations == found.simulations < 60

    def test_the_sources_add_up_to_the_covariance(self, found):
        best = found.estimate.best
        torch.testing.assert_close(torch.stack([*best.sources.values()]).sum(0), best.covariance)
        assert {"recording", "prior", "bending", "pose", "mesh", "time step"} == set(best.sources)
        assert all(float(torch.linalg.eigvalsh(part)[0]) > -1e-9 for part in best.sources.values())

    def test_two_recordings_say_more_than_one(self):
        one, other = objective(), objective(seed=6)
        alone, joint = (
            float(fit_likelihood(each, SPACE, LikelihoodSettings(starts=1)).estimate.best.sources["recording"][0, 0])
            for each in (one, JointObjective([one, other]))
        )
        assert joint < 0.8 * alone

    def test_ctrl_c_keeps_what_was_reached(self):
        seen = []

        def press(progress):
            seen.append(progress)
            if len(seen) == 2:
                raise KeyboardInterrupt

        told = fit_likelihood(objective(), SPACE, LikelihoodSettings(), progress=press)
        assert told.stop_reason == "interrupted"
        assert told.values == pytest.approx({name: seen[-1].values[name] for name in told.values})
        assert float(told.estimate.covariance[0, 0]) > 0

    def test_before_the_first_place_nothing_is_known(self, monkeypatch):
        def press(*given):
            raise KeyboardInterrupt

        monkeypatch.setattr(Linear, "at", press)
        with pytest.raises(KeyboardInterrupt):
            fit_likelihood(objective(), SPACE, LikelihoodSettings())

    def test_a_motion_that_diverges_from_every_start_is_told(self, monkeypatch):
        def diverge(*given):
            raise DivergedError(3, [0], "no number", {})

        monkeypatch.setattr(Linear, "at", diverge)
        with pytest.raises(DivergedError):
            fit_likelihood(objective(), SPACE, LikelihoodSettings())

    def test_of_its_own_motion_all_frames_count_and_nothing_is_lacking(self):
        """The mesh parts from the finer one early, and the recording is on the same mesh."""
        episode = clouds_of(SCENARIO, points=2000, **TRUTH)
        one = Objective(SCENARIO, episode, nuisance=POSE)
        told = fit_likelihood(one, SPACE, LikelihoodSettings(starts=1, model_error=False)).estimate
        assert told.best.converged
        assert {"recording", "prior", "bending", "pose", "mesh", "time step"} == set(told.best.sources)
        assert all(float(told.best.sources[name].abs().max()) == 0 for name in ("mesh", "time step"))
        assert len(told.members[0].frames) == len(one.frames)
        deviation = float(told.covariance[0, 0].sqrt())
        assert abs(float(told.mean[0]) - math.log(TRUTH["stretching"])) < 1.645 * deviation
        assert deviation < 0.05

    def test_a_descent_over_all_frames_that_does_not_arrive_counts_too(self):
        """Two places of each descent, and the horizon's two motions."""
        one = Objective(SCENARIO, clouds_of(SCENARIO, points=2000, **TRUTH), nuisance=POSE)
        settings = LikelihoodSettings(max_steps=2, starts=1, model_error=False)
        told = fit_likelihood(one, SPACE, settings).estimate
        assert len(told.members[0].frames) < len(one.frames)
        assert told.simulations == 6

    def test_bodies_stand_still_for_every_clock(self):
        """A scene with a body beside the cloth, seen by a clock that is free."""
        scenario = load_scenario("vest_hang")
        scenario = replace(scenario, frames=2, scene=replace(scenario.scene, frame_steps=2))
        assert len(scenario.scene.bodies.faces)
        episode = clouds_of(scenario, points=300)
        one = Objective(scenario, episode, nuisance={"lag": 0.01}, points=100)
        space = FitSpace((Variable("stretching", 0.1, 10.0, 3.0),), {})
        told = fit_likelihood(one, space, LikelihoodSettings(starts=1, max_steps=1))
        assert np.isfinite(told.loss)
