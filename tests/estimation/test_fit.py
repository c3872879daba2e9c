"""Fits: the bounded space, recovery of known parameters, offsets, joint fits, interruption, divergence."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.errors import ConfigError, DivergedError, EpisodeError
from diffcloud.estimation.inputs import Inputs
from diffcloud.estimation.joint import JointObjective
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.record import FittedParameter, read_fit
from diffcloud.estimation.result import describe_fit, read_motion, write_fit
from diffcloud.estimation.solvers import AdamSettings, fit_adam
from diffcloud.estimation.targets import track_displacement
from diffcloud.estimation.visibility import visibility_map
from diffcloud.io.episodes import Episode
from diffcloud.scene import load_scenario
from diffcloud.sim.properties import one_set
from studies.gradient_agreement import Agreement, gradient_agreement, random_parameters
from studies.timings import time_contact
from tests.conftest import paper_objective, small_lift


def clouds_of(scenario, *, points=800, seed=5, gripper=True, shift=(0, 0, 0), yaw=0.0, **truth):
    """A noise-free episode of known parameters, also of how the cloth lies, sampled with its own random points."""
    from diffcloud.clouds import SurfaceSampler

    system, _ = scenario.scene.build()
    run = Inputs.of(scenario, system, scenario.steps, one_set(truth), None).rollout()
    nodes = run.positions[0, :: scenario.scene.frame_steps]
    generator = torch.Generator().manual_seed(seed)
    sampler = SurfaceSampler.build(torch.as_tensor(system.mesh.faces), points, generator=generator)
    frames = sampler.sample(nodes).numpy()
    if yaw or any(shift):
        middle = frames[-1].mean(0)
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        frames = (frames - middle) @ turn.T + middle + np.array(shift)
    times = run.times[:: scenario.scene.frame_steps].numpy()
    track = nodes[:, scenario.grasped].mean(1, keepdim=True).numpy() if gripper else None
    return Episode.from_frames(list(frames), times, gripper=track, meta={"truth": truth})


GENTLE = {"frames": 12, "steps_per_frame": 3, "path": [(0, 0, 0, 0), (1.2, 0, -0.1, 0.3)], "points": 600}
"""A slow lift, whose loss is smooth."""


class TestSpace:
    @pytest.mark.parametrize("logarithmic", [False, True])
    def test_values_and_unbounded_are_inverse(self, logarithmic):
        space = FitSpace.build(["stretching", "damping"])
        scale = torch.tensor([logarithmic] * 3)
        values = torch.tensor([[0.2, 0.01], [5.05, 0.05], [9.0, 0.09]], dtype=torch.float64)
        torch.testing.assert_close(space.values(space.unbounded(values, scale), scale), values)

    def test_zero_is_the_middle_of_the_papers_scale(self):
        space = FitSpace.build(["stretching", "density"])
        starts, logarithmic = space.starts(1, seed=0)
        assert starts.tolist() == [[5.05, 5.05]]
        assert space.unbounded(starts, logarithmic).abs().max() < 1e-12

    def test_extra_starts_spread_logarithmically_inside_the_box(self):
        starts, logarithmic = FitSpace.build(["stretching", "density"]).starts(33, seed=0)
        assert logarithmic.tolist() == [False] + [True] * 32
        assert ((starts >= 0.1) & (starts <= 10)).all()
        assert 13 <= int((starts[1:, 0] < 1.0).sum()) <= 19  # half of them below the geometric middle

    def test_fixed_and_first_values(self):
        space = FitSpace.build(["stretching", "density"], fixed={"density": 1.2})
        assert space.names == ("stretching",)
        parameters = space.parameters(torch.tensor([[3.0]]).double())
        assert parameters["density"].tolist() == [1.2]
        assert space.starts(1, seed=0, first={"stretching": 2.0})[0].tolist() == [[2.0]]

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"names": ["strech"]}, "Unknown parameter 'strech'. Did you mean 'stretching'?. Allowed: .*stretching"),
            ({"names": ["stretching", "stretching"]}, "twice"),
            ({"names": ["stretching"], "bounds": {"stretching": (2.0, 1.0)}}, r"in order \(low < high\), got \[2.0, 1.0\]"),
            ({"names": ["density"], "fixed": {"density": 1.0}}, "Nothing is left"),
            (
                {"names": ["stretching"], "bounds": {"stretching": (-1.0, 1.0)}},
                r"A bound of stretching, \[-1.0, 1.0\], must be above 0",
            ),
            (
                {"names": ["stretching"], "bounds": {"densty": (0.5, 1.0)}},
                "Unknown parameter 'densty'. Did you mean 'density'",
            ),
            (
                {"names": ["stretching"], "fixed": {"density": 0.0}},
                "The fixed value of density must be above 0, got 0",
            ),
        ],
    )
    def test_bad_spaces(self, options, message):
        with pytest.raises(ConfigError, match=message):
            FitSpace.build(**options)

    @pytest.mark.parametrize(
        ("first", "message"),
        [
            ({"strech": 0.3}, "--init: Unknown fitted parameter 'strech'. Did you mean 'stretching'"),
            ({"density": 0.0}, r"--init density=0 is outside of its bounds \[0.1, 10\]; the nearest allowed value is 0.1"),
            (
                {"density": 1e9},
                r"--init density=1e\+09 is outside of its bounds \[0.1, 10\]; the nearest allowed value is 10",
            ),
            ({"density": float("nan")}, "--init density=nan is outside"),
            ({"bending": 1.0}, "--init: Unknown fitted parameter 'bending'"),
        ],
    )
    def test_starts_that_are_typed_wrongly(self, first, message):
        with pytest.raises(ConfigError, match=message):
            FitSpace.build(["stretching", "density"]).check_start(first)

    def test_predicted_starts_are_brought_inside(self):
        space = FitSpace.build(["stretching", "density"])
        assert space.nearest({"stretching": 12.0, "density": 0.01, "bending": 1.0}) == {"stretching": 10.0, "density": 0.1}


class TestRecovery:
    def test_the_ratio_is_recovered_from_a_start_far_away(self):
        scenario = small_lift(**GENTLE)
        episode = clouds_of(scenario, stretching=0.8, density=1.5)
        space = FitSpace.build(["stretching"], fixed={"density": 1.5})
        outcome = fit_adam(paper_objective(scenario, episode), space, AdamSettings(max_steps=40))
        assert outcome.loss < 0.25 * outcome.loss_start
        assert outcome.values["stretching"] == pytest.approx(0.8, rel=0.1)

    def test_a_known_mass_in_other_units_fixes_the_scale(self):
        """Halving the given mass halves the fitted stretch: the clouds only know the ratio."""
        scenario = small_lift(**GENTLE, air_density=0.0)
        episode = clouds_of(scenario, stretching=0.8, density=1.5)
        found = []
        for mass in (1.5, 0.75):
            space = FitSpace.build(["stretching"], fixed={"density": mass})
            settings = AdamSettings(max_steps=25, init={"stretching": mass})
            found.append(fit_adam(paper_objective(scenario, episode), space, settings).values["stretching"])
        assert found[0] / found[1] == pytest.approx(2.0, rel=0.15)

    def test_truth_has_the_lowest_loss(self):
        scenario = small_lift(points=4000, path=[(0, 0, 0, 0), (0.5, 0, -0.05, 0.3)])
        objective = paper_objective(scenario, clouds_of(scenario, stretching=1.0, density=1.0))
        stretch = torch.tensor([0.5, 0.8, 1.0, 1.25, 2.0]).double()
        assert int(objective({"stretching": stretch}).argmin()) == 2


class TestRun:
    @pytest.fixture
    def scenario(self):
        return small_lift()

    @pytest.fixture
    def objective(self, scenario):
        return paper_objective(scenario, clouds_of(scenario, stretching=0.6, density=1.0))

    def test_same_seed_same_result_and_best_iterate_kept(self, scenario, objective):
        space = FitSpace.build(["stretching", "density"])
        settings = AdamSettings(max_steps=6, smoothing=0.3, starts=2)
        first, second = (fit_adam(objective, space, settings) for _ in range(2))
        assert first.values == second.values
        assert first.loss == second.loss
        assert first.loss <= min(float(losses.min()) for losses in first.history.losses)
        assert first.simulations == 7 * (2 + 8)

    def test_losses_and_gradients_that_grow_beyond_a_record_are_none_in_it(self, objective):
        """A rough loss may well have a gradient that no file need hold."""
        space, settings = FitSpace.build(["stretching"]), AdamSettings(max_steps=1)
        outcome = fit_adam(objective, space, settings)
        outcome.history.gradients[0][...] = 1e20
        outcome.history.losses[-1][...] = math.inf
        told = describe_fit(objective, space, settings, outcome, episodes=["e"]).record.history
        assert told.gradient_norm[0] == [None]
        assert told.loss[-1] == [None]
        assert told.loss[0][0] > 0

    def test_threshold_stops(self, objective):
        outcome = fit_adam(objective, FitSpace.build(["stretching"]), AdamSettings(threshold=1.0))
        assert outcome.stop_reason == "threshold"
        assert outcome.iterations == 0

    def test_ctrl_c_leaves_the_best_so_far(self, objective):
        def interrupt(progress):
            if progress.iteration == 2:
                raise KeyboardInterrupt

        outcome = fit_adam(objective, FitSpace.build(["stretching"]), AdamSettings(), progress=interrupt)
        assert outcome.stop_reason == "interrupted"
        assert outcome.iterations == 2
        assert np.isfinite(outcome.loss)

    def test_a_start_that_diverges_is_dropped_and_named(self, objective, monkeypatch, tmp_path):
        real = Objective.__call__

        def fragile(self, parameters):
            bad = (parameters["stretching"] > 5.0).nonzero().flatten().tolist()
            if bad:
                raise DivergedError(3, bad, "test")
            return real(self, parameters)

        monkeypatch.setattr(Objective, "__call__", fragile)
        space, settings = FitSpace.build(["stretching"]), AdamSettings(starts=4, max_steps=3, smoothing=0.3)
        outcome = fit_adam(objective, space, settings)
        assert outcome.values["stretching"] <= 5.0
        assert outcome.start["stretching"] <= 5.0
        path = write_fit(tmp_path, "e", describe_fit(objective, space, settings, outcome, episodes=["e"]))
        assert read_fit(path).failures
        assert any("start 0 (stretching=5.05)" in failure for failure in outcome.failures)
        with pytest.raises(DivergedError, match=r"stretching=5\.05"):
            fit_adam(objective, FitSpace.build(["stretching"]), AdamSettings())

    def test_a_motion_that_diverges_after_the_compared_frames_is_recorded_as_far_as_it_goes(self, monkeypatch, tmp_path):
        scenario = small_lift(**GENTLE)
        objective = Objective(scenario, clouds_of(scenario, stretching=2.0), frames=range(5), nuisance={})
        space, settings = FitSpace.build(["stretching"]), AdamSettings(max_steps=2)
        outcome = fit_adam(objective, space, settings)
        whole = describe_fit(objective, space, settings, outcome, episodes=["e"])
        assert not whole.record.failures
        real, reached, fragile = Objective.simulate, 7, set[float]()

        def simulate(self, parameters, *, steps=None):
            last = (self.scenario.steps if steps is None else steps) // scenario.scene.frame_steps
            if last > reached and float(parameters["stretching"]) in fragile:
                raise DivergedError(reached * scenario.scene.frame_steps + 2, [0], "test")
            return real(self, parameters, steps=steps)

        monkeypatch.setattr(Objective, "simulate", simulate)
        for values in (outcome.values, outcome.start):
            fragile = {values["stretching"]}
            told = describe_fit(objective, space, settings, outcome, episodes=["e"])
            assert told.record.loss == whole.record.loss
            assert "e: the motion is recorded up to" in told.record.failures[0]
            np.testing.assert_array_equal(told.motions[0].nodes, whole.motions[0].nodes[: reached + 1])
            read_motion(write_fit(tmp_path, "e", told).with_suffix(".npz"))
        # first values that do not even reach the compared frames cut nothing off
        reached, fragile = 3, {outcome.start["stretching"]}
        told = describe_fit(objective, space, settings, outcome, episodes=["e"])
        np.testing.assert_array_equal(told.motions[0].start_nodes, told.motions[0].nodes)
        np.testing.assert_array_equal(told.motions[0].nodes, whole.motions[0].nodes)
        assert not told.record.failures
        assert told.record.loss == whole.record.loss
        fragile = {outcome.values["stretching"]}
        with pytest.raises(DivergedError):
            describe_fit(objective, space, settings, outcome, episodes=["e"])

    def test_a_copy_that_diverges_does_not_cost_its_start(self, objective, monkeypatch):
        real = Objective.__call__

        def fragile(self, parameters):
            bad = (parameters["stretching"] > 5.5).nonzero().flatten().tolist()
            if bad:
                raise DivergedError(3, bad, "test")
            return real(self, parameters)

        monkeypatch.setattr(Objective, "__call__", fragile)
        outcome = fit_adam(objective, FitSpace.build(["stretching"]), AdamSettings(max_steps=1, smoothing=0.5))
        assert outcome.start["stretching"] == pytest.approx(5.05)
        assert not outcome.failures

    def test_divergence_beyond_the_first_chunk_names_the_right_entry(self, objective):
        stretch = torch.ones(25, dtype=torch.float64)
        stretch[23] = float("nan")
        with pytest.raises(DivergedError) as caught:
            objective({"stretching": stretch})
        assert caught.value.entries == [23]

    def test_the_loss_with_fresh_points_is_the_objectives_own(self, scenario):
        episodes = [clouds_of(scenario, stretching=stretch, density=1.0, shift=(0.0, 0.0, 0.002)) for stretch in (0.7, 1.4)]
        objective = JointObjective([Objective(scenario, episode) for episode in episodes])
        space = FitSpace.build(["stretching"])
        settings = AdamSettings(max_steps=2, seed=3)
        outcome = fit_adam(objective, space, settings)
        told = describe_fit(objective, space, settings, outcome, episodes=["a", "b"], resampled_seeds=2).record
        parameters = space.parameters(torch.tensor([list(outcome.values.values())], dtype=torch.float64))
        members = objective.members
        runs = [member.simulate(parameters) for member in members]
        objective.reseed(0)  # as it was made; the pose is that of the fit's own points
        poses, losses = [member.pose(run) for member, run in zip(members, runs, strict=True)], []
        for seed in (10_004, 10_005):
            objective.reseed(seed)
            one, other = (
                float(member.frame_losses(run, pose=pose).mean())
                for member, run, pose in zip(members, runs, poses, strict=True)
            )
            losses.append((one * other) ** 0.5)
        assert told.loss_resampled == pytest.approx(np.mean(losses), rel=1e-9)

    def test_result_files(self, scenario, objective, tmp_path):
        space = FitSpace.build(["stretching"], fixed={"density": 1.2})
        settings = AdamSettings(max_steps=2)
        outcome = fit_adam(objective, space, settings)
        path = write_fit(tmp_path, "e", describe_fit(objective, space, settings, outcome, episodes=["e"]))
        found = read_fit(path)
        stretch = found.parameters["stretching"]
        assert stretch.value == pytest.approx(4.0 * stretch.multiplier)
        assert stretch.unit == "N/m"
        mass = found.parameters["density"]
        assert mass.value == pytest.approx(0.24)
        assert mass.model_copy(update={"meaning": "", "value": 0.24}) == FittedParameter(
            value=0.24, unit="kg/m²", meaning="", nominal=0.2, multiplier=1.2, fixed=True
        )
        with np.load(tmp_path / "e.npz") as run:
            assert run["nodes"].shape == (scenario.frames + 1, 25, 3)

    def test_frames_that_the_episode_lacks(self, scenario):
        episode = clouds_of(scenario, stretching=1.0)
        with pytest.raises(EpisodeError, match="Frame 24 is missing"):
            paper_objective(scenario, episode, frames=[24])

    def test_frames_after_the_end_of_the_simulation(self, scenario):
        late = clouds_of(small_lift(frames=9), stretching=1.0)
        with pytest.raises(EpisodeError, match="simulates only"):
            paper_objective(scenario, late)


def test_a_track_drives_the_handle_as_the_scenes_motion_does():
    """With and without the recorded track the same episode gives nearly the same motion."""
    scenario = small_lift()
    values = {"stretching": torch.tensor([0.7]).double()}
    with_track = paper_objective(scenario, clouds_of(scenario, stretching=0.7)).simulate(values)
    without = paper_objective(scenario, clouds_of(scenario, stretching=0.7, gripper=False)).simulate(values)
    assert (with_track.positions - without.positions).abs().max() < 3e-3
    assert (with_track.positions - without.positions).abs().max() > 0


def test_track_is_held_after_its_end():
    times = np.array([0.0, 0.1, 0.2])
    episode = Episode.from_frames([np.zeros((1, 3))] * 3, times, gripper=np.outer(times, [1.0, 0, 2.0])[:, None])
    moved = track_displacement(episode, ["any"], 6, 0.05)
    np.testing.assert_allclose(moved[:, 0, 0], [0.05, 0.1, 0.15, 0.2, 0.2, 0.2], atol=1e-12)


def test_tracks_belong_to_grippers_by_name():
    times, tracks = np.array([0.0, 0.1, 0.2]), np.zeros((3, 2, 3))
    tracks[:, 0, 0], tracks[:, 1, 2] = times, 2 * times
    episode = Episode.from_frames([np.zeros((1, 3))] * 3, times, gripper=tracks, grippers=("left", "right"))
    moved = track_displacement(episode, ["right", "left"], 4, 0.05)
    np.testing.assert_allclose(moved[:, 0], np.outer([0.1, 0.2, 0.3, 0.4], [0, 0, 1]), atol=1e-12)
    np.testing.assert_allclose(moved[:, 1], np.outer([0.05, 0.1, 0.15, 0.2], [1, 0, 0]), atol=1e-12)
    for others in (["left"], ["left", "middle"], []):
        with pytest.raises(EpisodeError, match="the episode's left, right"):
            track_displacement(episode, others, 4, 0.05)


@pytest.mark.slow
@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("name", ["lift", "fold", "shake"])
def test_the_box_of_parameters_is_visible_at_camera_noise(name, linear):
    """At least 80 % of neighbouring pairs of a 5 x 5 grid differ by more than 4 mm RMS at the loss frame."""
    found = visibility_map(load_scenario(name), size=5, linear=linear)
    assert found.visible_fraction(4.0) >= 0.8


def test_what_shows_is_that_of_the_recorded_motion():
    """Under the track of its own motion a scenario shows what it does by itself; under a gripper that rests, how deep
    the cloth sinks into the repulsion of the table."""
    scenario = small_lift(frames=20, rate_hz=40.0, steps_per_frame=1)
    episode = clouds_of(scenario, stretching=1.0, density=1.0)
    own, moved = (visibility_map(scenario, episode=one, size=3) for one in (None, episode))
    assert (
        0.2 < np.median(moved.along_stretching_mm / own.along_stretching_mm) < 1
    )  # over all frames, not at the last alone
    still = replace(episode, gripper=np.repeat(episode.gripper[:1], len(episode.times), axis=0))
    assert visibility_map(scenario, episode=still, size=3).visible_fraction(2.0) == 0 < moved.visible_fraction(2.0)
    first = [episode.frame(index) for index in range(3)]
    short = Episode.from_frames(first, episode.times[:3], gripper=episode.gripper[:3])
    early = visibility_map(scenario, episode=short, size=3)
    assert early.along_density_mm.max() < moved.along_density_mm.max()
    with pytest.raises(EpisodeError, match="no gripper track"):
        visibility_map(scenario, episode=clouds_of(scenario, gripper=False, stretching=1.0, density=1.0), size=2)


class Rough:
    """The squared logarithmic distance to a place, in ripples that are a sixth of a unit wide."""

    members = (None,)

    def __call__(self, parameters):
        away = torch.stack([(parameters["stretching"] / 0.13).log(), (parameters["density"] / 7.0).log()])
        return (away.square() + 1 - (40 * away).cos()).sum(0)


def test_smoothed_gradients_find_the_valley_of_a_rough_loss():
    """Where ripples are as steep as ten valleys, the exact gradient goes nowhere."""
    space = FitSpace.build(["stretching", "density"])
    exact = fit_adam(Rough(), space, AdamSettings(max_steps=60))
    found = [fit_adam(Rough(), space, AdamSettings(max_steps=60, smoothing=0.5, seed=seed)) for seed in range(4)]
    assert max(one.loss for one in found) < 0.1 * exact.loss


class TestGradientAgreement:
    def test_smooth_losses_agree(self, monkeypatch):
        """In the air, where only truncation is between them, and kinks of the material's table, if the step is longer."""
        monkeypatch.setattr("studies.gradient_agreement.STEP", 1e-5)
        scenario = small_lift(gap_m=0.5)
        (found,) = gradient_agreement(scenario, np.array([[0.5, 0.3], [2.0, 1.5], [1.2, 0.8]]))
        assert found.same_sign.all()
        np.testing.assert_allclose(found.gradient, found.difference, rtol=1e-4)

    def test_a_wrong_gradient_is_seen(self):
        difference = np.array([[1.0, 1.0], [1.0, 0.0]])
        found = Agreement(np.ones((2, 2)), np.array([[0.6, -1.0], [2.5, 0.0]]), difference)
        assert found.same_sign.tolist() == [[True, False], [True, False]]
        assert found.same_size.tolist() == [[True, False], [False, False]]

    def test_more_pairs_begin_with_the_same(self):
        scenario = small_lift()
        assert (random_parameters(scenario, 5, seed=1)[:3] == random_parameters(scenario, 3, seed=1)).all()


@pytest.mark.slow
def test_contacts_of_a_cloth_on_a_sphere_are_counted_and_timed():
    timing = time_contact(8, steps=12, repeats=1)
    assert timing.contacts > 0
    assert min(timing.touching, timing.free) > 0
