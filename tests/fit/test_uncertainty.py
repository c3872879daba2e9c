"""Standard errors: each source against what repeating it does to a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.evaluation.discretisation import mesh_study, pairs
from diffcloud.evaluation.intervals import state_intervals
from diffcloud.fit import FitSpace, GaussNewtonSettings, JointObjective, Objective, fit_gauss_newton
from diffcloud.fit.parameters import Variable
from diffcloud.fit.pose import SET_UP
from diffcloud.fit.uncertainty import patches, uncertainty
from diffcloud.io.episodes import Episode
from diffcloud.sim.properties import one_set
from tests.conftest import small_lift
from tests.fit.test_fit import GENTLE, clouds_of

TRUTH = {"stretch": 0.6, "mass": 1.7}
SPACE = FitSpace.build(["stretch"], fixed={"mass": TRUTH["mass"]})
CLEAR = {**GENTLE, "integrator": "implicit", "grip": "pad", "grip_m": 0.02, "frames": 9}
"""A lift of which the size of the clouds says much."""
HERE = GaussNewtonSettings(starts=1, screen=0, init={"stretch": TRUTH["stretch"]})


@pytest.fixture(scope="module")
def scenario():
    return small_lift(**{**GENTLE, "integrator": "implicit", "points": 1500})


def recorded(scenario, **changes) -> Episode:
    return clouds_of(scenario, **{"points": 3000, **TRUTH, **changes})


def logarithm(objective, space=SPACE) -> float:
    return float(np.log(fit_gauss_newton(objective, space, HERE).values["stretch"]))


def beside(name: str, value: float, factor: float) -> FitSpace:
    """Material that is known within a factor, and fitted too."""
    doubt = Variable(name, value / 10, value * 10, factor, value, doubtful=True)
    return FitSpace((*SPACE.variables, doubt), {key: known for key, known in SPACE.fixed.items() if key != name})


def apart_mm(objective, values) -> float:
    """From the scenario's mesh to the finer one, RMS over nodes and compared frames."""
    parameters = one_set(values)
    with torch.no_grad():
        nodes = objective.looked_at(objective.simulate_to_loss(parameters))
        way = objective.way_to(objective.scenario.finer(), parameters, nodes)
    return 1e3 * objective.length_unit_m * float(way.square().sum(-1).mean().sqrt())


def deviation(found, source: str) -> float:
    return float(np.sqrt(found.sources[source][0, 0]))


class TestDoubts:
    def test_doubtful_material_moves_the_fit_as_far_as_it_says(self, scenario):
        """What is known of the mass is off by one deviation: the fit goes where the linearisation has it."""
        objective, factor = Objective(scenario, recorded(scenario), nuisance={}), 1.1
        known, other = (beside("mass", value, factor) for value in (TRUTH["mass"], factor * TRUTH["mass"]))
        moved = logarithm(objective, other) - logarithm(objective, known)
        found = uncertainty(objective, known, TRUTH)
        assert found.names == ("stretch",)
        assert deviation(found, "mass") == pytest.approx(abs(moved), rel=0.25)
        assert deviation(found, "mass") > 0.02

    def test_a_late_clock_moves_the_fit_as_far_as_it_says(self, scenario):
        episode = recorded(scenario, gripper=False)
        late = replace(episode, times=np.append(episode.times[:1], episode.times[1:] - 5 * SET_UP["lag"]))
        one, other = (Objective(scenario, each, nuisance={}) for each in (episode, late))
        moved = logarithm(other) - logarithm(one)
        found = uncertainty(one, SPACE, TRUTH)
        assert 5 * deviation(found, "lag") == pytest.approx(abs(moved), rel=0.4)

    def test_a_clock_that_was_measured_is_doubted_as_little_as_that(self, scenario):
        episode = recorded(scenario, gripper=False)
        measured = replace(episode, meta={"quality": {"refinement": {"lag_sigma_s": SET_UP["lag"] / 4}}})
        one, other = (uncertainty(Objective(scenario, each, nuisance={}), SPACE, TRUTH) for each in (episode, measured))
        assert deviation(other, "lag") == pytest.approx(deviation(one, "lag") / 4, rel=0.1)
        assert deviation(other, "noise") == pytest.approx(deviation(one, "noise"), rel=1e-6)

    def test_clouds_that_are_too_large_move_the_fit_as_far_as_it_says(self):
        """Where the episode says how far their scale may be off, but the fit takes it as exact."""
        lifted, moved, said = small_lift(**{**CLEAR, "points": 1500}), [], []
        for seed in range(3):
            episode = replace(recorded(lifted, seed=seed), meta={"scale_sigma": 0.03})
            one = Objective(lifted, episode, nuisance={})
            centre = one.pose_space.centre.numpy()
            sizes = [(centre + np.exp(part) * (episode.points - centre)).astype(np.float32) for part in (0.03, -0.03)]
            large, small = (logarithm(Objective(lifted, replace(episode, points=each), nuisance={})) for each in sizes)
            moved.append((large - small) / 2)
            said.append(deviation(uncertainty(one, SPACE, TRUTH), "scale"))
        assert np.mean(said) == pytest.approx(abs(np.mean(moved)), rel=0.4)
        exact = Objective(lifted, replace(episode, meta={}), nuisance={})
        assert "scale" not in uncertainty(exact, SPACE, TRUTH).sources

    def test_finer_steps_move_the_fit_as_far_as_it_says(self, scenario):
        episode = recorded(scenario)
        fine = replace(scenario, scene=replace(scenario.scene, frame_steps=4 * scenario.scene.frame_steps))
        one, other = (Objective(each, episode, nuisance={}) for each in (scenario, fine))
        moved = logarithm(other) - logarithm(one)
        found = uncertainty(one, SPACE, TRUTH)
        assert found.refined[0] == pytest.approx(moved, rel=0.3)
        assert deviation(found, "step size") == pytest.approx(abs(found.refined[0]) / np.sqrt(3))

    def test_a_finer_mesh_is_as_far_away_as_simulating_it_says(self, scenario):
        """Compared with the study of discretisation, which knows no recordings."""
        frame = scenario.loss_frames[0]
        stretch, mass = (column[3] for column in pairs(scenario).values())
        values = {"stretch": float(stretch), "mass": float(mass)}
        late, early = (Objective(scenario, recorded(scenario), nuisance={}, frames=[one]) for one in (frame, 1))
        (row,) = mesh_study(scenario, 1)
        found = apart_mm(late, values)
        assert found == pytest.approx(1e3 * row.errors[3], rel=1e-4)  # episodes hold the gripper in single precision
        assert apart_mm(early, values) < found

    def test_a_finer_mesh_lies_as_the_fitted_one_does(self, scenario):
        objective = Objective(scenario, recorded(scenario), nuisance={}, frames=[1])
        straight, turned = (apart_mm(objective, {**TRUTH, "turn": angle}) for angle in (0.0, 0.3))
        assert turned < straight + 0.5

    def test_where_all_is_known_of_a_pose_its_doubts_are_sources(self, scenario):
        found = uncertainty(Objective(scenario, recorded(scenario), nuisance={}), SPACE, TRUTH)
        assert set(SET_UP) | {"step size", "noise"} == set(found.sources)
        assert not found.besides

    def test_the_prior_of_a_pose_moves_the_fit_as_far_as_it_says(self, scenario):
        """Clouds ten deviations of the prior away, along the path: it holds the pose back, and the fit makes up for it."""
        episode, near = recorded(scenario), 0.0002
        displaced = replace(episode, points=episode.points + np.array([0, 10 * near, 0], dtype=np.float32))
        one, other = (Objective(scenario, each, nuisance={"y": near}) for each in (episode, displaced))
        moved = logarithm(other) - logarithm(one)
        found = uncertainty(one, SPACE, TRUTH)
        assert 10 * deviation(found, "y") == pytest.approx(abs(moved), rel=0.3)
        assert "y" in found.besides

    def test_a_free_pose_is_no_doubt(self, scenario):
        found = uncertainty(Objective(scenario, recorded(scenario)), SPACE, TRUTH)
        assert max(deviation(found, name) for name in ("x", "y", "yaw")) < 0.001
        known = uncertainty(Objective(scenario, recorded(scenario), nuisance={}), SPACE, TRUTH)
        assert deviation(found, "z") < 0.3 * deviation(known, "z")


class TestNoise:
    @pytest.mark.parametrize(("times", "knows", "widened"), [(0.9, True, False), (2.0, True, True), (2.0, False, False)])
    def test_an_unexplained_misfit_may_be_common_to_all_places(self, scenario, monkeypatch, times, knows, widened):
        """Half of the loss is above what explains it: with it common to all, and the rest as it was."""
        objective = Objective(scenario, recorded(scenario), nuisance={})
        monkeypatch.setattr(Objective, "knows_gaps", False)
        plain = uncertainty(objective, SPACE, TRUTH)
        monkeypatch.setattr(Objective, "knows_gaps", knows)
        monkeypatch.setattr(Objective, "noise_loss", float(plain.losses[0]) / times)
        found = uncertainty(objective, SPACE, TRUTH)
        wider = 1 + 0.5 * (plain.clusters - 1) if widened else 1.0
        assert plain.clusters > 10
        assert found.sources["noise"][0, 0] == pytest.approx(wider * plain.sources["noise"][0, 0])
        assert all(found.sources[name] == pytest.approx(plain.sources[name]) for name in plain.sources if name != "noise")

    @pytest.mark.slow
    def test_refits_of_new_noise_scatter_as_it_says(self, scenario, monkeypatch):
        """Each place of the cloth has an error of its own, the same in all frames: 20 recordings. It is known here that no
        cause is common to all places, which is assumed of what noise does not explain."""
        monkeypatch.setattr(Objective, "knows_gaps", False)
        rng, found, stated = np.random.default_rng(4), [], []
        clean = recorded(scenario, points=1500)
        where = patches(clean.frame(0), 16)
        for _ in range(20):
            shift = 0.003 * rng.standard_normal((16, 3))[where]
            frames = [clean.frame(index) + shift for index in range(clean.frame_count)]
            objective = Objective(scenario, Episode.from_frames(frames, clean.times, gripper=clean.gripper), nuisance={})
            fit = fit_gauss_newton(objective, SPACE, HERE).values
            found.append(float(np.log(fit["stretch"])))
            stated.append(deviation(uncertainty(objective, SPACE, fit), "noise"))
        assert np.sqrt(np.mean(np.square(stated))) == pytest.approx(np.std(found, ddof=1), rel=0.4)

    def test_two_recordings_say_more_than_one(self, scenario):
        members = [Objective(scenario, recorded(scenario, seed=seed), nuisance={}) for seed in (1, 2)]
        one, other, both = (
            uncertainty(each, beside("bending", 1.0, 1.03), {**TRUTH, "bending": 1.0})  # known better than clouds show it
            for each in (*members, JointObjective(members))
        )
        assert both.clusters == one.clusters + other.clusters
        lags, bends = ([deviation(each, name) for each in (one, other)] for name in ("lag", "bending"))
        assert deviation(both, "lag") == pytest.approx(np.hypot(*lags) / 2, rel=0.15)  # each recording has its own
        assert deviation(both, "bending") == pytest.approx(np.mean(bends), rel=0.15)  # of the one cloth


class TestPrior:
    def test_where_nothing_is_shown_the_prior_is_all_there_is(self, scenario):
        """No fluid: drag changes nothing."""
        still = replace(
            scenario,
            scene=replace(scenario.scene, surrounding=replace(scenario.scene.surrounding, air_density=0.0, air_drag=0.0)),
        )
        space = FitSpace.build(["drag"], fixed=TRUTH, priors={"drag": 3.0})
        found = uncertainty(Objective(still, recorded(still), nuisance={}), space, {"drag": 1.0})
        assert np.sqrt(found.covariance[0, 0]) == pytest.approx(np.log(3.0), rel=1e-6)

    @pytest.mark.parametrize("names", [("stretch", "friction_cloth"), ("friction_cloth",)])
    @pytest.mark.parametrize("nuisance", [{}, None])
    def test_without_one_nothing_is_known(self, scenario, nuisance, names):
        """Beside what is shown: the interval of the friction ends at the bounds, that of the stretch stays."""
        alone = replace(
            scenario,
            scene=replace(scenario.scene, surrounding=replace(scenario.scene.surrounding, self_contact=False)),
        )
        space = FitSpace.build(names, fixed={name: TRUTH[name] for name in TRUTH if name not in names})
        objective = Objective(alone, recorded(alone), nuisance=nuisance)
        for stretch, friction in ((0.6, 0.3), (0.604, 0.75), (0.597, 1.2)):
            values = {"stretch": stretch, "friction_cloth": friction, "mass": TRUTH["mass"]}
            found = state_intervals(objective, space, values)
            entry = found.parameters["friction_cloth"]
            assert (entry.low, entry.high, entry.verdict) == (0.0, 1.5, "not identified")
            assert "stretch" not in names or found.parameters["stretch"].verdict == "identified"
        known = uncertainty(objective, SPACE, TRUTH)
        assert "unseen" not in known.sources

    def test_where_much_is_shown_it_says_little(self, scenario):
        space = FitSpace.build(["stretch"], fixed={"mass": 1.7}, priors={"stretch": 10.0})
        found = uncertainty(Objective(scenario, recorded(scenario)), space, TRUTH)
        assert deviation(found, "prior") < 0.1 * np.sqrt(found.covariance[0, 0])


def test_the_next_step_is_that_of_the_solver(scenario):
    objective = Objective(scenario, recorded(scenario), nuisance={})
    away = uncertainty(objective, SPACE, {"stretch": 0.66})
    assert away.step[0] == pytest.approx(np.log(0.6 / 0.66), rel=0.2)
    assert away.places[0] == pytest.approx(np.log(0.66))


def test_patches_are_of_one_size():
    nodes = np.stack(np.meshgrid(np.arange(8.0), np.arange(8.0), [0.0]), axis=-1).reshape(-1, 3)
    found = patches(nodes, 16)
    assert np.bincount(found).tolist() == [4] * 16
    for index in range(16):
        assert np.ptp(nodes[found == index], axis=0).max() == 1.0


def test_the_losses_are_those_of_the_recordings(scenario):
    members = [Objective(scenario, recorded(scenario, seed=seed)) for seed in (1, 2)]
    found = uncertainty(JointObjective(members), SPACE, TRUTH)
    values = {name: torch.tensor([value]).double() for name, value in TRUTH.items()}
    with torch.no_grad():
        runs = [member.simulate_to_loss(values) for member in members]
        shown = [float(member.frame_losses(run).mean()) for member, run in zip(members, runs, strict=True)]
        assert found.losses.tolist() == pytest.approx(shown, rel=1e-3)
        assert found.loss == pytest.approx(float(JointObjective(members)(values)), rel=1e-3)


def test_the_sum_of_the_sources_is_the_covariance(scenario):
    found = uncertainty(Objective(scenario, recorded(scenario)), SPACE, TRUTH)
    np.testing.assert_allclose(found.covariance, sum(found.sources.values()))
    assert torch.isfinite(torch.tensor(found.covariance)).all()
