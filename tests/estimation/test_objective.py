"""The default measure: pose, cut, usable frames, both directions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.clouds.neighbours import NeighbourIndex
from diffcloud.clouds.sampling import SurfacePoints
from diffcloud.clouds.visibility import seen_places
from diffcloud.errors import ConfigError, DivergedError, EpisodeError
from diffcloud.estimation.joint import JointObjective
from diffcloud.estimation.matching import Pairs, pairs_forth
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.pose import SET_UP
from diffcloud.estimation.residuals import Axis
from diffcloud.estimation.result import describe_recording
from diffcloud.estimation.solvers import LikelihoodSettings, fit_likelihood
from diffcloud.io.episodes import Episode
from diffcloud.scene import load_scenario
from diffcloud.sensing.whole_surface import sample_surface
from diffcloud.sim.properties import one_set
from tests.conftest import small_lift
from tests.estimation.test_fit import GENTLE, clouds_of
from tests.estimation.test_matching import sharp_crop

TRUTH = {"stretching": 0.6, "density": 1.7}
SPACE = FitSpace.build(["stretching", "density"])


def scenario_of(**changes):
    return small_lift(**{**GENTLE, "integrator": "implicit", "points": 2400, **changes})


def moved(episode, *, shift=(0.0, 0.0, 0.0), yaw=0.0):
    """The recording turned about the vertical through the origin, and shifted."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    return replace(episode, points=(episode.points @ turn.T + shift).astype(np.float32))


def found_at(objective, values):
    with torch.no_grad():
        return describe_recording(objective, objective.simulate_to_loss(one_set(values)), "e").model_dump()


@pytest.fixture(scope="module")
def scenario():
    return scenario_of()


@pytest.fixture(scope="module")
def episode(scenario):
    return clouds_of(scenario, points=3000, **TRUTH)


class TestPose:
    def test_the_loss_does_not_know_where_the_recording_lies(self, scenario, episode):
        """x, y and yaw are symmetries: of a recording turned and shifted, every parameter set has the same loss."""
        beside = moved(episode, shift=(0.03, -0.02, 0.0), yaw=0.15)
        values = {"stretching": torch.tensor([0.3, 0.6, 2.0]).double(), "density": torch.tensor([1.7, 1.7, 0.8]).double()}
        with torch.no_grad():
            here, there = (Objective(scenario, one)(values) for one in (episode, beside))
        torch.testing.assert_close(there, here, rtol=0.02, atol=1e-7)

    def test_pose_and_parameters_are_found_together(self, scenario):
        yaw, shift = 0.2, np.array([0.03, -0.04, 0.0])
        episode = clouds_of(scenario, points=9000, **TRUTH)  # 3,000 points tell stretch and mass hardly apart
        # cameras that are not doubted: where their tilt is free too, this small cloth hardly tells its weight
        objective = Objective(scenario, moved(episode, shift=shift, yaw=yaw), nuisance={"x": 0.1, "y": 0.1, "yaw": 0.5})
        fit = fit_likelihood(objective, SPACE, LikelihoodSettings(model_error=False))
        assert fit.values == pytest.approx(TRUTH, rel=0.03)
        recording = found_at(objective, fit.values)
        assert recording["nuisance"]["yaw"]["value"] == pytest.approx(yaw, abs=0.01)
        # told about the centre of the recording, while the test turned it about the origin
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        centre = np.array(recording["centre"])[:2]
        told = [recording["nuisance"][name]["value"] for name in ("x", "y")]
        np.testing.assert_allclose(told, shift[:2] - centre + turn @ centre, atol=4e-3)

    def test_height_tilt_and_lag_are_found_where_they_are_free(self, scenario, episode):
        late = replace(episode, times=np.append(episode.times[:1], episode.times[1:] - 0.03), gripper=None)
        objective = Objective(
            scenario,
            moved(late, shift=(0.0, 0.0, 0.02)),
            nuisance={"x": 0.1, "y": 0.1, "z": 0.1, "yaw": 0.5, "tilt_x": 0.1, "tilt_y": 0.1, "lag": 0.1},
        )
        pose = {name: entry["value"] for name, entry in found_at(objective, TRUTH)["nuisance"].items()}
        assert pose["z"] == pytest.approx(0.02, abs=1e-3)
        assert pose["lag"] == pytest.approx(0.03, abs=3e-3)
        assert abs(pose["tilt_x"]) < 0.01
        assert abs(pose["tilt_y"]) < 0.01

    def test_without_nuisance_the_shift_stays_in_the_loss(self, scenario, episode):
        beside = moved(episode, shift=(0.03, 0.0, 0.0))
        fixed, free = (found_at(Objective(scenario, beside, nuisance=one), TRUTH) for one in ({}, None))
        assert fixed["nuisance"] == {}
        assert fixed["rms_mm"] > 3 * free["rms_mm"]

    def test_the_slope_is_that_of_the_loss_at_its_pose(self, scenario, episode):
        """By differences, with the pose found anew on both sides."""
        objective = Objective(scenario, moved(episode, shift=(0.02, 0.01, 0.0), yaw=0.1))
        places = Axis.of(SPACE).places(torch.tensor([[0.9, 1.2]], dtype=torch.float64)).requires_grad_()
        (slope,) = torch.autograd.grad(objective(SPACE.parameters(Axis.of(SPACE).values(places))), places)
        for index in range(2):
            way = torch.zeros_like(places)
            way[0, index] = 0.02
            with torch.no_grad():
                above, below = (
                    float(objective(SPACE.parameters(Axis.of(SPACE).values(places + s * way)))) for s in (1, -1)
                )
            assert float(slope[0, index]) == pytest.approx((above - below) / 0.04, rel=0.15)

    def test_a_pose_is_found_without_a_look_at_other_motions(self, scenario, episode):
        values = SPACE.starts(6, seed=3)[0]
        objective = Objective(scenario, episode)
        with torch.no_grad():
            together = objective(SPACE.parameters(values))
            alone = torch.cat([objective(SPACE.parameters(value[None])) for value in values])
        torch.testing.assert_close(together, alone, rtol=1e-8, atol=0.0)

    def test_the_papers_measure_has_none(self, scenario, episode):
        with pytest.raises(ConfigError, match="leave out the nuisance x"):
            Objective(scenario, episode, paper=True, nuisance={"x": 0.1})


class TestWhatCounts:
    def test_every_frame_after_the_start(self, scenario, episode):
        objective = Objective(scenario, episode)
        assert objective.frames == tuple(range(1, 13))
        assert objective.point_count == 200

    def test_named_frames_are_kept(self, episode):
        named = replace(scenario_of(), every_frame=False, loss_frames=(3, -1))
        assert Objective(named, episode).frames == (3, 12)
        assert Objective(scenario_of(), episode, frames=[-2]).frames == (11,)
        assert Objective(scenario_of(), episode, paper=True).frames == (12,)

    def test_below_the_height_where_a_recording_ends_nothing_counts(self, scenario, episode):
        height = 0.05
        frames = [frame[frame[:, 2] > height] for frame in map(episode.frame, range(13))]
        kept = [index for index, frame in enumerate(frames) if len(frame) > 10]
        cut = Episode.from_frames([frames[index] for index in kept], episode.times[kept])
        objective = Objective(scenario, cut)
        assert objective.cut == pytest.approx(height, abs=0.01)
        assert 0 < len(objective.frames) < len(kept)
        recording = found_at(objective, TRUTH)
        assert min(recording["counted"]) < 0.1 < max(recording["counted"])
        assert recording["rms_mm"] < 6.0

    def test_its_first_frames_alone(self, scenario, episode):
        """They have the losses that they have among all, of a motion that ends sooner."""
        whole = Objective(scenario, episode, nuisance={}, points=200)
        early = whole.earliest([6])
        assert early.frames == whole.frames[:6]
        assert early.loss_steps < whole.loss_steps
        with torch.no_grad():
            part, full = (one.frame_losses(one.simulate_to_loss(one_set({"stretching": 2.0}))) for one in (early, whole))
        torch.testing.assert_close(part, full[:, :6])
        assert whole.earliest([12]).frames == whole.frames
        backwards = Objective(scenario, episode, nuisance={}, frames=[-1, 5, 4, 3, 2, 1]).earliest([5])
        assert backwards.frames == (5, 4, 3, 2, 1)  # as they were named
        both = JointObjective([whole, whole]).earliest([6, 2])
        assert [one.frames for one in both.members] == [early.frames, early.frames[:2]]

    def test_a_whole_recording_has_no_cut(self, scenario, episode):
        assert Objective(scenario, episode).cut is None

    def test_an_episode_without_a_usable_frame(self, scenario, episode):
        early = Episode.from_frames([episode.frame(0)], np.array([0.0]))
        with pytest.raises(EpisodeError, match="No frame of the episode can be compared"):
            Objective(scenario, early)

    def test_scraps_cost_no_more_than_the_cap(self, scenario, episode, rng):
        """A tenth of every frame is of something else, half a metre away: the fit stays where it was."""
        frames = []
        for frame in map(episode.frame, range(13)):
            scraps = frame[: len(frame) // 10] + np.float32([0.5, 0.2, 0.3])
            frames.append(np.concatenate([frame, scraps]))
        dirty = Episode.from_frames(frames, episode.times, gripper=episode.gripper)
        space = FitSpace.build(["stretching"], fixed={"density": TRUTH["density"]})
        found = fit_likelihood(Objective(scenario, dirty), space, LikelihoodSettings(model_error=False))
        assert found.values["stretching"] == pytest.approx(TRUTH["stretching"], rel=0.05)

    def test_what_no_camera_could_see_does_not_count(self, scenario, episode):
        """Seen from one side alone, and recorded so: a part of the cloth has no points. The truth is then twice as near to
        the recording as where the camera's place is not known."""
        eye = [1.5, 0.3, 0.3]
        faces = torch.as_tensor(scenario.scene.mesh.faces)
        with torch.no_grad():
            run = Objective(scenario, episode).simulate_to_loss(one_set(TRUTH))
        motion = run.at(torch.as_tensor(episode.times))
        frames = []
        for index in range(episode.frame_count):
            points = torch.as_tensor(episode.frame(index)).double()[None, None]
            eyes = torch.tensor([[eye]]).double()
            seen = seen_places(motion[:, index : index + 1], faces, points, eyes, near=0.008)
            frames.append(episode.frame(index)[seen[0, 0].numpy()])
        recorded = Episode.from_frames(frames, episode.times, gripper=episode.gripper)
        known = replace(recorded, meta={"viewpoints": {"side": eye}})
        without, with_ = (found_at(Objective(scenario, one, nuisance={}), TRUTH) for one in (recorded, known))
        assert min(with_["counted"]) < 0.9
        assert with_["rms_to_recording_mm"] < 0.5 * without["rms_to_recording_mm"]

    @pytest.mark.parametrize("plane", [[1.0, 0.0, 0.0, 0.02], [0.6, -0.8, 0.0, 0.0]])
    def test_what_lies_below_the_cut_plane_of_the_only_camera_does_not_count(self, scenario, episode, plane):
        """A camera high above sees all of the cloth, and its points on one side of a plane were removed. If the plane is
        known, the truth is near to the recording, and about as many points count as were recorded."""
        kept = episode.points @ np.float32(plane[:3]) >= plane[3]
        recorded = replace(episode, meta={"cameras": ["above"], "viewpoints": {"above": [0.1, 0.1, 9.0]}}).select(kept)
        known = replace(recorded, meta={**recorded.meta, "cut_planes": {"above": plane}})
        without, with_ = (found_at(Objective(scenario, one, nuisance={}), TRUTH) for one in (recorded, known))
        assert with_["rms_to_recording_mm"] < 0.3 * without["rms_to_recording_mm"]
        ratio = np.array(with_["counted"]) / np.array(without["counted"])
        assert ratio.mean() == pytest.approx(kept.mean(), abs=0.1)

    def test_what_another_camera_shows_below_the_plane_counts(self, scenario, episode):
        """Of two cameras at one place, one is cut: all counts as before."""
        place = [0.1, 0.1, 9.0]
        meta = {"cameras": ["one", "two"], "viewpoints": {"one": place, "two": place}}
        planes = {"two": [0.0, 0.0, 1.0, 9.0]}
        whole, cut = (
            found_at(Objective(scenario, replace(episode, meta=told), nuisance={}), TRUTH)["counted"]
            for told in (meta, meta | {"cut_planes": planes})
        )
        assert cut == whole
        with pytest.raises(EpisodeError, match=r"of the cloth lies above the cut, 9\.000 m"):
            Objective(scenario, replace(episode, meta=meta | {"cut_planes": planes | {"one": planes["two"]}}))

    def test_a_named_frame_needs_points_above_the_cut(self, scenario, episode):
        meta = {"cameras": ["one"], "viewpoints": {"one": [0.1, 0.1, 9.0]}, "cut_planes": {"one": [0.0, 0.0, 1.0, 0.05]}}
        with pytest.raises(EpisodeError, match=r"^Frames 0, 1 have no point above the crop height, 0\.050 m"):
            Objective(scenario, replace(episode, meta=meta), frames=[0, 12, 1])

    def test_frames_are_those_with_enough_above_the_lowest_cut_plane(self, scenario, episode):
        """Also where the points alone would not show that they were cut."""
        meta = {"cameras": ["one", "two"], "viewpoints": {"one": [0.1, 0.1, 9.0], "two": [0.1, 0.2, 9.0]}}
        heights = episode.points[:, 2]
        low, high = (float(np.quantile(heights, part)) for part in (0.9, 0.95))
        planes = {"one": [0.0, 0.0, 1.0, high], "two": [0.0, 0.0, 2.0, 2 * low]}
        told = Objective(scenario, replace(episode, meta=meta | {"cut_planes": planes}), nuisance={})
        assert told.cut == pytest.approx(low)
        assert len(told.frames) < len(Objective(scenario, replace(episode, meta=meta), nuisance={}).frames)

    @pytest.mark.parametrize(
        "told",
        [{"a": [0, 0, 1]}, {"a": [0, 0, 0, 1]}, {"a": [0, 0, math.nan, 1]}, {"a": "low"}, {"b": [0, 0, 1, 0]}, [1], "low"],
    )
    def test_cut_planes_that_are_none(self, scenario, episode, told):
        meta = {"cameras": ["a"], "viewpoints": {"a": [0, 0, 1]}, "cut_planes": told}
        with pytest.raises(EpisodeError, match="cut_planes of the episode's meta are"):
            Objective(scenario, replace(episode, meta=meta))

    def test_a_frame_that_the_camera_lost_altogether_leaves_a_pose(self, scenario, episode):
        eye = {"size": [8, 1], "focal": [1, 1], "centre": [4, 0], "T_camera_scene": np.eye(4)[:3].tolist()}
        lost = np.full((episode.frame_count, 1, 1), 255, np.uint8)
        meta = {"viewpoints": {"side": [0, 0, 0]}, "pinholes": {"side": eye}}
        objective = Objective(scenario, replace(episode, meta=meta, lost=lost))
        with torch.no_grad():
            assert torch.isfinite(objective(one_set(TRUTH))).all()

    def test_lost_pixels_are_of_the_cameras_whose_places_are_known(self, scenario, episode):
        pinhole = {"size": [2, 2], "focal": [1, 1], "centre": [0, 0], "T_camera_scene": np.eye(4)[:3].tolist()}
        meta = {"viewpoints": {"side": [1.5, 0.3, 0.3]}, "pinholes": {"above": pinhole}}
        lost = np.zeros((episode.frame_count, 1, 1), np.uint8)
        with pytest.raises(EpisodeError, match="pinholes of above and viewpoints of side"):
            Objective(scenario, replace(episode, meta=meta, lost=lost))

    @pytest.mark.parametrize("told", [{"a": [0, 1]}, {"a": "here"}, {"a": [0, 1, math.nan]}, [1, 2], {"a": None}])
    def test_viewpoints_that_are_none(self, scenario, episode, told):
        with pytest.raises(EpisodeError, match="viewpoints of an episode's meta"):
            Objective(scenario, replace(episode, meta={"viewpoints": told}))

    def test_the_prior_of_the_lag_is_what_preprocessing_measured(self, scenario, episode):
        def prior(told: object) -> float:
            return Objective(scenario, replace(episode, meta={"quality": {"refinement": told}})).nuisance["lag"]

        assert prior({"lag_sigma_s": 0.0007}) == 0.0007
        assert prior({"lag_sigma_s": 0.0}) == prior({}) == prior(None) == prior([]) == SET_UP["lag"]

    @pytest.mark.parametrize("told", [-0.001, math.nan, math.inf, True, "0.001", [0.001]])
    def test_measures_of_the_lag_that_are_none(self, scenario, episode, told):
        with pytest.raises(EpisodeError, match="lag_sigma_s of an episode's refinement"):
            Objective(scenario, replace(episode, meta={"quality": {"refinement": {"lag_sigma_s": told}}}))

    def test_the_scale_is_free_where_the_episode_says_how_far_it_may_be_off(self, scenario, episode):
        assert "scale" not in Objective(scenario, episode).nuisance
        assert Objective(scenario, replace(episode, meta={"scale_sigma": 0.04})).nuisance["scale"] == 0.04

    def test_the_recording_says_how_far_its_pose_may_be_off(self, scenario, episode):
        found = Objective(scenario, replace(episode, meta={"pose_sigmas": {"x": 0.05, "tilt_x": 0.1}})).nuisance
        assert found == Objective(scenario, episode).nuisance | {"x": 0.05, "tilt_x": 0.1}

    @pytest.mark.parametrize(
        "told",
        [{"x": -0.01}, {"x": 0}, {"x": math.nan}, {"x": True}, {"x": "1cm"}, {"x": [0.01]}, [0.01], "x", {"east": 0.01}],
    )
    def test_deviations_of_the_pose_that_are_none(self, scenario, episode, told):
        with pytest.raises(EpisodeError, match=r"pose_sigmas of an episode's meta .* remove `pose_sigmas`"):
            Objective(scenario, replace(episode, meta={"pose_sigmas": told}))

    @pytest.mark.parametrize("scale", [-0.2, 0.3])
    def test_a_wrong_scale_of_the_basis_material_costs_nothing(self, scenario, episode, scale):
        objective = Objective(scenario, replace(episode, meta={"scale_sigma": 0.04}))
        assert objective.pose_space.names[-1] == "scale"
        losses = []
        for start in (0.0, scale):
            objective._first = objective._first_pose().clone()
            objective._first[:, -1] = start
            with torch.no_grad():
                losses.append(float(objective(one_set(TRUTH))))
        assert losses[1] <= losses[0] * (1 + 1e-9)

    @pytest.mark.parametrize("told", [-0.01, 0, 1.5, math.nan, True, "4%", [0.04]])
    def test_scales_that_are_none(self, scenario, episode, told):
        with pytest.raises(EpisodeError, match="scale_sigma in an episode's meta"):
            Objective(scenario, replace(episode, meta={"scale_sigma": told}))

    def test_points_that_are_sure_count_more(self, scenario, episode):
        """Half of the recorded points are 2 cm too high; said to be uncertain, they move the loss less."""
        points = episode.points.copy()
        points[::2, 2] += 0.02
        sigma = np.full(len(points), 0.001, np.float32)
        unsure = sigma.copy()
        unsure[::2] = 0.05
        rows = [found_at(Objective(scenario, replace(episode, points=points, sigma=s)), TRUTH) for s in (sigma, unsure)]
        assert rows[1]["rms_to_cloth_mm"] < 0.5 * rows[0]["rms_to_cloth_mm"]

    def test_a_recorded_body_is_no_cloth(self):
        """The pole that the recording shows lies where the scene has it: the truth still has next to no loss."""
        band = load_scenario("band_stretch")
        objective = Objective(band, clouds_of(band), nuisance={}, frames=[12])
        with torch.no_grad():
            run = objective.simulate_to_loss({"stretching": torch.ones(1, dtype=torch.float64)})
        nodes = run.at(objective.times)[0].numpy()
        recorded = sample_surface(
            nodes, band.scene.mesh.faces, objective.times.numpy(), band.scene.bodies, points=3000, seed=1, meta={}
        )
        found = Objective(band, recorded, nuisance={}, frames=[0])
        assert describe_recording(found, run, "e").rms_to_cloth_mm < 0.1

    def test_a_motion_that_hides_below_the_cut_has_the_largest_loss(self, generator):
        moved = torch.rand(1, 2, 5, 3, generator=generator, dtype=torch.float64)
        moved[:, 1, :, 2] -= 5.0
        clouds = [NeighbourIndex(torch.rand(30, 3, generator=generator, dtype=torch.float64))] * 2
        nodes = torch.arange(5).reshape(1, 1, 5, 1).expand(1, 2, 5, 3)
        places = SurfacePoints(nodes, torch.full_like(moved, 1 / 3))
        pairs, _ = pairs_forth(places, [moved], [clouds], crop=sharp_crop(0.0, frames=2), share=0.5)
        losses = pairs.losses(moved, 0.05)[0]
        assert float(losses[1]) == pytest.approx(0.25 * 0.05**2)
        assert float(losses[0]) <= float(losses[1])


def test_with_a_lag_the_loss_does_not_depend_on_how_far_is_simulated(scenario, episode):
    """A velocity at the last compared frame needs what comes after it."""
    objective = Objective(scenario, episode, nuisance={"lag": 0.05}, frames=[4, 8])
    with torch.no_grad():
        short, whole = objective.simulate_to_loss(one_set(TRUTH)), objective.simulate(one_set(TRUTH))
        assert len(short.times) < len(whole.times)
        torch.testing.assert_close(objective.frame_losses(short), objective.frame_losses(whole))


def test_a_basis_that_diverges_costs_no_parameter_set(scenario, episode, monkeypatch):
    """The first pose is looked for with the nominal material; without its motion, steps begin at zero."""
    objective = Objective(scenario, episode)
    real = Objective.simulate

    def fragile(self, parameters, **options):
        if not parameters:
            raise DivergedError(3, [0], "test")
        return real(self, parameters, **options)

    monkeypatch.setattr(Objective, "simulate", fragile)
    with torch.no_grad():
        assert bool(torch.isfinite(objective(one_set(TRUTH))).all())


def test_millimetres_are_those_of_distances_whatever_the_loss(scenario, episode, monkeypatch):
    """A loss in metres, as CONTRIBUTING tells to write one, changes no `rms_mm`."""
    values = {"stretching": torch.tensor([1.0]), "density": torch.tensor([1.0])}
    objective = Objective(scenario, episode, nuisance={})
    expected = found_at(objective, {"stretching": 1.0, "density": 1.0})
    assert expected["rms_mm"] == pytest.approx(1e3 * expected["loss"] ** 0.5)
    monkeypatch.setattr(Pairs, "losses", lambda self, moved, cap: self.squares(moved, cap).sqrt())
    other = found_at(objective, {"stretching": 1.0, "density": 1.0})
    assert other["loss"] != pytest.approx(expected["loss"], rel=0.1)
    for name in ("rms_mm", "frame_rms_mm", "rms_to_recording_mm", "rms_to_cloth_mm"):
        assert other[name] == expected[name]
    assert float(objective(values)) == pytest.approx(other["loss"])
