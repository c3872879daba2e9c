"""One set of parameters for several recordings: how losses join, what must be the same, what each says of the others."""

from __future__ import annotations

import os
import signal
import threading
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from diffcloud.errors import ConfigError, DivergedError
from diffcloud.estimation.initial_state import initial_nodes, with_initial_state
from diffcloud.estimation.joint import JointObjective, mean_loss
from diffcloud.estimation.left_out import leave_each_out
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.record import read_fit
from diffcloud.estimation.residuals import Axis
from diffcloud.estimation.result import describe_fit, describe_recording, write_fit
from diffcloud.estimation.solvers import LikelihoodSettings, fit_likelihood, solve
from diffcloud.evaluation.methods import space_of
from diffcloud.sim.properties import one_set
from diffcloud.sim.simulate import rollout
from diffcloud.sim.threads import map_threads, use_threads
from tests.conftest import paper_objective, small_lift
from tests.estimation.rates import check_rates
from tests.estimation.test_fit import GENTLE, clouds_of

TRUTH = {"stretching": 0.6, "density": 1.7}
SPACE = FitSpace.build(["stretching", "density"])
OWN = LikelihoodSettings(model_error=False)
"""For recordings that this simulator made on the same mesh."""
SIDEWAYS = [(0.0, 0.0, 0.0, 0.0), (0.6, 0.12, 0.0, 0.1)]


def motions(**changes):
    """Two scenarios of one cloth: a slow lift, and the same corner pulled to the side."""
    settings = {**GENTLE, "integrator": "implicit", "points": 500, **changes}
    return small_lift(**settings), small_lift(**{**settings, "path": SIDEWAYS})


@pytest.fixture(scope="module")
def askew():
    """Two motions of one cloth that lay askew in each, the fit of all that, and of the material alone."""
    lies = [{"turn": 0.15}, {"turn": -0.1}]
    told = [clouds_of(s, points=4000, **TRUTH, **own) for s, own in zip(motions(), lies, strict=True)]
    members = [Objective(scenario, one, nuisance={}) for scenario, one in zip(motions(), told, strict=True)]
    joint, settings = JointObjective(members), LikelihoodSettings(starts=1, model_error=False, init=TRUTH)
    space = with_initial_state(SPACE, [{"turn": 0.1}] * 2, motions())
    return joint, settings, space, [(one, fit_likelihood(joint, one, settings)) for one in (SPACE, space)]


class TestLaid:
    def test_each_recording_shows_how_its_cloth_lay(self, askew):
        *_, ((_, flat), (_, found)) = askew
        assert [found.values[f"turn@{number}"] for number in (0, 1)] == pytest.approx([0.15, -0.1], abs=0.01)
        assert {name: found.values[name] for name in TRUTH} == pytest.approx(TRUTH, rel=0.05)
        assert abs(np.log(flat.values["stretching"] / TRUTH["stretching"])) > 0.5
        assert found.loss < 0.1 * flat.loss

    def test_of_the_one_left_out_it_is_found_anew(self, askew):
        joint, settings, space, (_, (_, found)) = askew
        told = leave_each_out(joint, space, found.values, settings)
        for one, member, own in zip(told, joint.members, ({"turn": 0.15}, {"turn": -0.1}), strict=True):
            assert set(one.parameters) == set(TRUTH)
            with torch.no_grad():
                true = float(member(one_set({**TRUTH, **own})))
            assert one.loss < 1.5 * true

    def test_records_tell_it_of_each_recording(self, askew, tmp_path):
        joint, settings, space, (_, (_, found)) = askew
        result = describe_fit(joint, space, settings, found, episodes=["a", "b"])
        record = read_fit(write_fit(tmp_path, "joint", result))
        assert [one.nuisance["turn"].value for one in record.episodes] == [found.values[f"turn@{n}"] for n in (0, 1)]
        assert not record.nuisance
        for known, fitted in zip(space_of(record).variables, space.variables, strict=True):
            assert replace(known, low=fitted.low, high=fitted.high) == fitted
            # the record has them in SI units
            assert (known.low, known.high) == pytest.approx((fitted.low, fitted.high), rel=1e-15)
        with torch.no_grad():
            assert float(joint(one_set(record.simulated))) == pytest.approx(record.loss, rel=1e-9)
        for number, (scenario, motion) in enumerate(zip(motions(), result.motions, strict=True)):
            (lies,) = initial_nodes(scenario.scene.mesh, one_set(record.initial_state_in(record.episodes[number])))
            np.testing.assert_allclose(motion.nodes[0], lies, atol=1e-15)

    def test_the_uncertainty_does_not_depend_on_the_order(self, askew):
        joint, settings, space, (_, (_, found)) = askew
        one = found.estimate
        other = fit_likelihood(JointObjective(joint.members[::-1]), space, settings).estimate
        order = [space.names.index({"turn@0": "turn@1", "turn@1": "turn@0"}.get(name, name)) for name in space.names]
        assert "turn" in one.sources
        for name, covariance in one.sources.items():
            np.testing.assert_allclose(other.sources[name][order][:, order], covariance, rtol=1e-6, atol=1e-16)

    def test_how_it_lay_in_one_says_nothing_of_another(self, askew):
        """But for what both say of the material."""
        *_, space, (_, (_, found)) = askew
        precision = torch.linalg.inv(found.estimate.best.covariance)
        first, second = (space.names.index(f"turn@{number}") for number in (0, 1))
        assert abs(float(precision[first, second])) < 1e-9 * float(precision[first, first])


class TestMean:
    def test_in_the_papers_measure_losses_are_averaged(self):
        scenario = small_lift()
        values = {"stretching": torch.tensor([1.0, 3.0]).double()}
        members = [
            paper_objective(scenario, clouds_of(scenario, stretching=s, density=1.0), frames=[2, 5]) for s in (0.5, 2.0)
        ]
        alone = torch.stack([member(values) for member in members])
        torch.testing.assert_close(JointObjective(members)(values), alone.mean(0))

    def test_else_what_each_gains_counts_as_a_part_of_its_own_loss(self, generator):
        losses = torch.rand(3, 4, generator=generator).double() + 0.1
        scaled = losses * torch.tensor([[1.0], [100.0], [0.01]])
        together = mean_loss(losses, paper=False)
        torch.testing.assert_close(mean_loss(scaled, paper=False), together)  # 100 and 1/100
        torch.testing.assert_close(together, losses.prod(0) ** (1 / 3))

    @pytest.mark.parametrize("paper", [False, True])
    def test_a_recording_twice_as_noisy_weighs_a_quarter(self, paper):
        """Weights go with the inverse of each recording's own loss, but in the paper's measure."""
        losses = torch.tensor([[1e-6], [4e-6]], dtype=torch.float64, requires_grad=True)
        (weights,) = torch.autograd.grad(mean_loss(losses, paper=paper).sum(), losses)
        assert float(weights[0] / weights[1]) == pytest.approx(1.0 if paper else 4.0)


class TestFit:
    def test_two_motions_of_one_cloth_give_its_parameters(self):
        members = [Objective(scenario, clouds_of(scenario, points=6000, **TRUTH), nuisance={}) for scenario in motions()]
        joint = JointObjective(members)
        found = fit_likelihood(joint, SPACE, OWN)
        assert found.values == pytest.approx(TRUTH, rel=0.03)
        left = leave_each_out(joint, SPACE, found.values, OWN)
        for one, member in zip(left, members, strict=True):
            # a single motion tells the ratio; how heavy the cloth is, it hardly tells
            ratio = one.parameters["stretching"] / one.parameters["density"]
            assert ratio == pytest.approx(TRUTH["stretching"] / TRUTH["density"], rel=0.1)
            assert one.loss == pytest.approx(float(member(one_set(one.parameters))), rel=1e-9)

    def test_what_is_left_out_has_no_say(self):
        """Recordings of two cloths: each is predicted with the parameters of the other."""
        first, second = motions()
        members = [
            Objective(first, clouds_of(first, points=6000, stretching=0.4, density=1.0), nuisance={}),
            Objective(second, clouds_of(second, points=6000, stretching=2.5, density=1.0), nuisance={}),
        ]
        space = FitSpace.build(["stretching"], fixed={"density": 1.0})
        one, other = leave_each_out(JointObjective(members), space, {"stretching": 1.0}, OWN)
        assert one.parameters["stretching"] == pytest.approx(2.5, rel=0.1)  # stiff cloth hardly stretches
        assert other.parameters["stretching"] == pytest.approx(0.4, rel=0.05)

    def test_it_does_not_matter_which_points_a_solver_drew_last(self):
        members = [Objective(one, clouds_of(one, points=1000, **TRUTH), nuisance={}) for one in motions()]
        joint, space, told = (
            JointObjective(members),
            FitSpace.build(["stretching"], fixed={"density": TRUTH["density"]}),
            [],
        )
        for drawn in (0, 7):
            joint.reseed(drawn)
            told.append(leave_each_out(joint, space, {"stretching": TRUTH["stretching"]}, OWN))
        assert told[0] == told[1]

    def test_the_misfit_of_what_is_left_out_has_no_prior_of_a_pose(self):
        """As that of the joint fit, beside which it is held."""
        members = []
        for scenario in motions():
            episode = clouds_of(scenario, points=6000, **TRUTH)
            higher = replace(episode, points=episode.points + np.array([0.0, 0.0, 0.003], dtype=np.float32))
            members.append(Objective(scenario, higher, nuisance={"z": 1e-3}))
        space = FitSpace.build(["stretching"], fixed={"density": 1.0})
        left = leave_each_out(JointObjective(members), space, {"stretching": TRUTH["stretching"]}, OWN)
        for one, member in zip(left, members, strict=True):
            told = describe_recording(member, member.simulate_to_loss(one_set(one.parameters)), "one")
            assert one.rms_mm == pytest.approx(told.rms_mm, rel=1e-9)
            assert one.loss < 0.99 * float(member(one_set(one.parameters)))

    def test_each_recording_is_measured_again_with_its_own_pose_and_frames(self):
        members = [
            Objective(scenario, clouds_of(scenario, **TRUTH), nuisance=nuisance, frames=frames)
            for scenario, nuisance, frames in zip(
                motions(), ({"x": 0.1}, {"x": 0.1, "scale": 0.02}), ([3, 4], [2]), strict=True
            )
        ]
        space, settings = (
            FitSpace.build(["stretching"], fixed={"density": 1.0}),
            LikelihoodSettings(starts=1, model_error=False, max_steps=2),
        )
        joint = JointObjective(members)
        record = describe_fit(joint, space, settings, solve(joint, space, settings), episodes=["a", "b"]).record
        for place, member in enumerate(members):
            again = Objective(member.scenario, member.episode, **record.measured_by(place))
            assert (again.nuisance, again.frames) == (member.nuisance, member.frames)
            told = describe_recording(again, again.simulate_to_loss(one_set(record.values)), "again")
            assert told.loss == pytest.approx(record.episodes[place].loss, rel=1e-6)

    def test_variables_move_the_motions_of_their_recording(self, generator):
        """Of the material those of both, of how a cloth lies one alone."""
        members = [Objective(s, clouds_of(s, points=4000, **TRUTH), nuisance={}) for s in motions()]
        space = with_initial_state(SPACE, [{"turn": 0.1, "shape": 0.01, "size": 0.05}, {"turn": 0.1}], motions())
        places = 0.3 * torch.randn(1, len(space.names), generator=generator).double()
        moving = torch.zeros(2, len(space.names), dtype=torch.long)
        for number, member in enumerate(members):
            own, columns = space.of_recording(number)
            moving[number, columns] += 1
            check_rates(member, own, places[:, columns], rtol=1e-6, atol=1e-12)
        both = [name for name, count in zip(space.names, moving.sum(0).tolist(), strict=True) if count == 2]
        assert both == ["stretching", "density", "size"]
        assert moving[:, [space.names.index(f"turn@{number}") for number in (0, 1)]].tolist() == [[1, 0], [0, 1]]

    def test_threads_change_nothing(self):
        """To the last bit; and in threads, too, gradients are recorded where they are wanted, and only there."""
        objectives = [Objective(s, clouds_of(s, points=500, **TRUTH)) for s in motions()]
        places = Axis.of(SPACE).places(torch.tensor([[0.8, 1.2], [0.5, 2.0], [0.6, 1.7]]).double())
        found = {}
        try:
            for threads in (1, 2, 3):
                use_threads(threads)
                joint = JointObjective(objectives)
                wanted = {name: value.requires_grad_() for name, value in SPACE.parameters(places.exp()).items()}
                loss = joint(wanted)
                slope = torch.autograd.grad(loss.sum(), wanted["stretching"])[0]
                with torch.no_grad():
                    assert not joint(wanted).requires_grad
                fit = fit_likelihood(joint, SPACE, LikelihoodSettings(starts=1, max_steps=2, model_error=False))
                found[threads] = [loss.detach(), slope, fit.estimate.best.place, fit.estimate.covariance]
        finally:
            use_threads(None)
        for threads in (2, 3):
            assert all(torch.equal(one, other) for one, other in zip(found[threads], found[1], strict=True))

    def test_results_of_threads_come_in_order_and_errors_come_through(self):
        def diverging(one: int) -> int:
            if one == 2:
                raise DivergedError(3, [0], "as it should")
            return one

        try:
            use_threads(2)
            assert map_threads(diverging, [1, 3, 5]) == [1, 3, 5]
            with pytest.raises(DivergedError, match="as it should"):
                map_threads(diverging, [1, 2, 3])
        finally:
            use_threads(None)

    @pytest.mark.parametrize("nested", [False, True])
    def test_ctrl_c_ends_what_threads_simulate(self, nested):
        """They would take minutes."""
        system, _ = small_lift().scene.build()
        rollout(system, 1)  # compiled
        began = time.monotonic()
        threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
        try:
            use_threads(2)
            simulate = partial(map_threads, lambda steps: rollout(system, steps))
            with pytest.raises(KeyboardInterrupt):
                map_threads(simulate, [[100_000] * 2] * 2) if nested else simulate([100_000] * 3)
        finally:
            use_threads(None)
        assert time.monotonic() - began < 10  # on a busy machine


class TestOneCloth:
    def test_scenarios_of_different_materials_are_refused(self):
        first = small_lift()
        other = small_lift(material="denim")
        members = [Objective(s, clouds_of(s, stretching=1.0)) for s in (first, other)]
        with pytest.raises(ConfigError, match=r"one cloth, whose \w+ = 1 means \S+ N/m in lift and"):
            JointObjective(members)

    def test_measures_are_not_mixed(self):
        scenario = small_lift()
        episode = clouds_of(scenario, stretching=1.0)
        with pytest.raises(ConfigError, match="one measure"):
            JointObjective([Objective(scenario, episode), paper_objective(scenario, episode)])
