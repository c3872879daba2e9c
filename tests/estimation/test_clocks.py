"""Cameras whose clocks differ: each one's lag is a variable of the fit, about the offset that the recording states."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.clouds import SurfaceSampler
from diffcloud.clouds.neighbours import NeighbourIndex
from diffcloud.errors import ConfigError, EpisodeError
from diffcloud.estimation.inputs import Inputs
from diffcloud.estimation.matching import pairs_forth
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.pose import SET_UP, PoseSpace, default_priors, priors_by_clock
from diffcloud.estimation.residuals import Axis
from diffcloud.estimation.result import describe_recording, recorded_pose
from diffcloud.estimation.solvers import LikelihoodSettings, fit_likelihood
from diffcloud.io.episodes import Clock, Episode
from diffcloud.sim.properties import one_set
from tests.estimation.rates import check_rates
from tests.estimation.test_matching import at_points, sharp_crop
from tests.estimation.test_objective import SPACE, TRUTH, found_at, scenario_of

PLACED = {"x": 0.1, "y": 0.1, "yaw": 0.5}
CENTRE = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)


def seen_by_two(scenario, *, lags=(0.0, -0.05), points=9000, stated=None):
    """Two cameras that see a lift; a point of each one stamped t shows the motion at t + its lag.

    Args:
        points: of both together.
        stated: camera -> offset and deviation in the recording's meta; None: no clocks.
    """
    system, _ = scenario.scene.build()
    run = Inputs.of(scenario, system, scenario.steps, one_set(TRUTH), None).rollout()
    every = slice(0, -1, scenario.scene.frame_steps)
    times = run.times[every]
    generator = torch.Generator().manual_seed(3)
    sampler = SurfaceSampler.build(torch.as_tensor(system.mesh.faces), points, generator=generator)
    seen = [sampler.sample(run.at(times + lag)[0])[:, number::2] for number, lag in enumerate(lags)]
    track = run.positions[0, every][:, scenario.grasped].mean(1, keepdim=True).numpy()
    meta = {"cameras": ["above", "side"]}
    if stated is not None:
        meta["clocks"] = {name: {"offset_s": offset, "sigma_s": sigma} for name, (offset, sigma) in stated.items()}
    episode = Episode.from_frames(list(torch.cat(seen, dim=1).numpy()), times.numpy(), gripper=track, meta=meta)
    numbers = np.repeat([0, 1], [seen[0].shape[1], seen[1].shape[1]])
    return replace(episode, camera=np.tile(numbers, len(times)).astype(np.uint8))


@pytest.fixture(scope="module")
def scenario():
    return scenario_of()


@pytest.fixture(scope="module")
def episode(scenario):
    """50 ms apart, of which the recording states 40."""
    return seen_by_two(scenario, stated={"side": (-0.04, 0.01)})


def fitted(scenario, episode, **lags):
    objective = Objective(scenario, episode, nuisance={**PLACED, **lags})
    fit = fit_likelihood(objective, SPACE, LikelihoodSettings(model_error=False))
    return fit.values, found_at(objective, fit.values)


class TestFits:
    def test_clocks_and_material_are_found_together(self, scenario, episode):
        """A point stamped t shows the motion at t + lag: the camera that shows what was 50 ms ago has a lag of -50 ms."""
        values, recording = fitted(scenario, episode, lag_above=0.002, lag_side=0.01)
        lags = {name: one["value"] for name, one in recording["nuisance"].items() if one["unit"] == "s"}
        assert lags == pytest.approx({"lag_above": 0.0, "lag_side": -0.05}, abs=2e-3)
        assert values == pytest.approx(TRUTH, rel=0.04)
        together, as_one = fitted(scenario, seen_by_two(scenario, lags=(0.0, 0.0)), lag=0.002)
        assert together == pytest.approx(TRUTH, rel=0.04)
        assert recording["rms_mm"] == pytest.approx(as_one["rms_mm"], rel=0.05)

    def test_one_clock_for_both_finds_another_material(self, scenario, episode):
        """Its stretching is wrong for its mass, and the misfit shows it."""
        common, recording = fitted(scenario, replace(episode, meta={}), lag=0.002)
        assert list(recording["nuisance"])[-1] == "lag"
        off = common["stretching"] / common["density"] / (TRUTH["stretching"] / TRUTH["density"]) - 1
        assert abs(off) > 0.1  # with both clocks, less than a per cent
        assert recording["rms_mm"] > 2.0

    def test_stated_offsets_hold_where_clocks_are_not_free(self, scenario):
        right = seen_by_two(scenario, stated={"above": (0.0, 0.0), "side": (-0.05, 0.01)})
        right, unstated = (
            found_at(Objective(scenario, one, nuisance={}), TRUTH) for one in (right, replace(right, meta={}))
        )
        assert right["nuisance"] == {}
        assert right["clocks"] == {"lag_above": 0.0, "lag_side": -0.05}
        assert right["rms_mm"] < 0.6 * unstated["rms_mm"]

    def test_a_camera_may_miss_frames(self, scenario):
        whole = seen_by_two(scenario, stated={"side": (-0.05, 0.01)})
        frame = np.repeat(np.arange(whole.frame_count), np.diff(whole.offsets))
        kept = (whole.camera == 0) | (frame % 3 == 0)
        offsets = np.cumsum([0, *np.bincount(frame[kept])])
        gappy = replace(whole, points=whole.points[kept], camera=whole.camera[kept], offsets=offsets)
        one, other = (found_at(Objective(scenario, each), TRUTH) for each in (whole, gappy))
        assert one["rms_mm"] < other["rms_mm"] < 2**0.5 * one["rms_mm"]  # up to half of the points are missing
        assert other["nuisance"]["lag_side"]["value"] == pytest.approx(-0.05, abs=3e-3)


class TestDerivatives:
    def test_those_by_the_pose_are_differences(self, scenario, episode):
        """Of pairs that stay, in float64: the loss and half of its slope by each variable, the lag of each clock too."""
        objective = Objective(scenario, episode)
        space, step = objective.pose_space, 1e-6
        with torch.no_grad():
            run = objective.simulate_to_loss(one_set(TRUTH))
            pose = 0.3 * space.deviations[None] * torch.linspace(-1, 1, len(space.names), dtype=torch.float64)
            motion = objective.match(run, pose=pose)
            _, slope, _ = objective.terms(motion)
            for index in range(len(space.names)):
                way = step * torch.nn.functional.one_hot(torch.tensor([index]), len(space.names)).double()
                above, below = (objective.losses(replace(motion, pose=pose + sign * way)).mean() for sign in (1, -1))
                expected = (above - below) / (4 * step)
                torch.testing.assert_close(slope[0, index], expected, rtol=1e-6, atol=1e-10)
        assert {"lag_above", "lag_side"} <= set(space.names)

    def test_columns_add_up_to_the_slope_of_the_loss(self, scenario, episode):
        """The rates of every pair: by what moves the nodes, and by the pose as the kernel has it."""
        objective = Objective(scenario, episode)
        with torch.no_grad():
            motion = objective.match(objective.simulate_to_loss(one_set(TRUTH)))
            rates = torch.randn(2, *motion.nodes.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
            _, of_pose, _ = objective.terms(motion)
            slope = torch.zeros(len(rates) + of_pose.shape[1], dtype=torch.float64)
            for pairs, moved, columns in zip(motion.pairs, *objective.columns(motion, rates), strict=True):
                away = moved - pairs.partners
                weights = torch.where(away.square().sum(-1) < objective.cap**2, pairs.weights, 0.0)
                slope += (weights * (columns * away).sum(-1)).sum((1, 2, 3))
        torch.testing.assert_close(slope[2:], of_pose[0])
        nodes = motion.nodes.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(objective.losses(replace(motion, nodes=nodes)).mean(), nodes)
        torch.testing.assert_close(2 * slope[:2], (rates * gradient).sum((1, 2, 3, 4)))

    def test_those_by_the_material_are_reverse_modes(self, scenario, episode):
        objective = Objective(scenario, episode, nuisance={})
        places = Axis.of(SPACE).places(torch.tensor([[0.7, 1.5], [0.4, 2.0]], dtype=torch.float64))
        check_rates(objective, SPACE, places, rtol=1e-6)


def test_a_fit_tells_how_well_it_knows_each_clock(scenario, episode):
    """Better than was known before it."""
    space, objective = FitSpace.build(["stretching"]), Objective(scenario, episode)
    settings = LikelihoodSettings(starts=1, model_error=False, init={"stretching": 0.6})
    found = fit_likelihood(objective, space, settings).estimate
    assert bool(torch.isfinite(found.covariance).all())
    variances = dict(zip((*space.names, *objective.pose_space.names), found.covariance.diagonal().tolist(), strict=True))
    assert 0 < variances["lag_side"] < 0.5  # of its prior's
    assert 0 < variances["lag_above"] < 1


def test_clocks_that_agree_split_no_cloud(generator):
    """The nearest point of either camera is the nearest of all."""
    moved = torch.rand(2, 2, 40, 3, generator=generator, dtype=torch.float64)
    points = torch.rand(2, 30, 3, generator=generator, dtype=torch.float64)
    crop = sharp_crop(0.2, frames=2)
    whole, _ = pairs_forth(at_points(moved), [moved], [[NeighbourIndex(one) for one in points]], crop=crop, share=0.5)
    views = [[NeighbourIndex(one[side::2]) for one in points] for side in (0, 1)]
    split, _ = pairs_forth(at_points(moved), [moved, moved], views, nodes=40, crop=crop, share=0.5)
    assert torch.equal(split.partners, whole.partners)
    assert torch.equal(split.weights, whole.weights)
    clock = split.places.nodes // 40
    assert torch.equal(split.places.nodes % 40, whole.places.nodes)
    number = torch.tensor(
        [
            [int((one == point).all(-1).nonzero()) for point in near]
            for one, near in zip(points, split.partners[0], strict=True)
        ]
    )
    assert torch.equal(clock[0, ..., 0], number % 2)


class TestPriors:
    def test_the_doubt_of_an_offset_adds_to_that_of_the_episodes_clock(self, episode):
        priors = default_priors(episode)
        assert "lag" not in priors
        assert priors["lag_above"] == SET_UP["lag"]
        assert priors["lag_side"] == pytest.approx(math.hypot(SET_UP["lag"], 0.01))

    def test_one_lag_is_that_of_every_clock(self, scenario, episode):
        objective = Objective(scenario, episode, nuisance={"lag": 0.002})
        assert objective.nuisance == {"lag_above": 0.002, "lag_side": 0.002}

    def test_priors_of_one_recording_serve_another(self):
        assert priors_by_clock({"x": 0.1, "lag_a": 0.01, "lag_b": 0.02}, ["lag"]) == {"x": 0.1, "lag": 0.02}
        assert priors_by_clock({"lag": 0.01, "lag_a": 0.03}, ["lag_a", "lag_c"]) == {"lag_a": 0.03, "lag_c": 0.01}
        assert priors_by_clock({"x": 0.1}, ["lag_a"]) == {"x": 0.1}

    def test_a_clock_that_the_recording_lacks(self):
        with pytest.raises(ConfigError, match=r"Unknown nuisance variable 'lag_front'.*lag_side"):
            PoseSpace.build({"lag_front": 0.1}, CENTRE, length_unit_m=1.0, clocks={"lag_side": 0.0})


def test_records_keep_lags_from_the_time_stamps_on(scenario, episode):
    objective = Objective(scenario, episode)
    with torch.no_grad():
        recording = describe_recording(objective, objective.simulate_to_loss(one_set(TRUTH)), "e")
        pose = objective.pose(objective.simulate_to_loss(one_set(TRUTH)))
    space, values = recorded_pose(recording, length_unit_m=scenario.length_unit_m)
    torch.testing.assert_close(values, pose)
    assert recording.nuisance["lag_side"].value == pytest.approx(-0.04 + float(pose[0, space.names.index("lag_side")]))
    assert space.clocks == {"lag_above": 0.0, "lag_side": -0.04}
    seen = []
    space.moved_motion(lambda times: seen.append(times) or torch.zeros(1, 1, 1, 3), torch.zeros(1).double(), values * 0)
    assert float(seen[0]) == pytest.approx(-0.02)  # a picture of all cameras' points shows the mean of their times


class TestMeta:
    def test_cameras_without_a_clock_have_no_offset(self, episode):
        assert episode.clocks == {"above": Clock(0.0, 0.0), "side": Clock(-0.04, 0.01)}
        assert replace(episode, meta={}).clocks == {}

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"clocks": {"front": {"offset_s": 0.0, "sigma_s": 0.0}}}, "for each of the cameras above, side"),
            ({"clocks": {"side": {"offset_s": math.nan, "sigma_s": 0.0}}}, "sigma_s not negative"),
            ({"clocks": {"side": {"offset_s": 0.0, "sigma_s": -1.0}}}, "sigma_s not negative"),
            ({"clocks": {"side": {"offset_s": True, "sigma_s": 0.0}}}, "sigma_s not negative"),
            ({"clocks": {"side": {"offset_s": 0.0}}}, "offset_s and sigma_s in seconds"),
            ({"clocks": {"side": 0.05}}, "offset_s and sigma_s in seconds"),
            ({"clocks": [1, 2]}, "offset_s and sigma_s in seconds"),
            ({"cameras": None}, "Clocks need the list of the cameras' names"),
            ({"cameras": ["side"]}, "some points name none of them"),
        ],
    )
    def test_clocks_that_are_none(self, scenario, episode, changes, message):
        with pytest.raises(EpisodeError, match=message):
            Objective(scenario, replace(episode, meta={**episode.meta, **changes}))

    def test_points_without_cameras(self, scenario, episode):
        with pytest.raises(EpisodeError, match="some points name none of them"):
            Objective(scenario, replace(episode, camera=None))

    def test_each_camera_looks_from_where_it_stands(self, scenario, episode):
        """Files keep viewpoints in the order of their names."""
        places = {"side": [1.5, 0.3, 0.3], "above": [0.0, 0.0, 1.5]}
        objective = Objective(scenario, replace(episode, meta={**episode.meta, "viewpoints": places}))
        assert objective._target.watching == ([1], [0])
        with torch.no_grad():
            assert bool(objective.match(objective.simulate_to_loss(one_set(TRUTH))).pairs[0].weights.any())
        with pytest.raises(EpisodeError, match="viewpoints of side and, with `clocks`, the cameras above, side"):
            Objective(scenario, replace(episode, meta={**episode.meta, "viewpoints": {"side": places["side"]}}))
