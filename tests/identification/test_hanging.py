"""Cloths that hang at the start: the start is found, late stamps are corrected, and the command fits them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from diffcloud.errors import EpisodeError, SceneError
from diffcloud.identification import found_cloth, found_layout, prepared
from diffcloud.identification.hanging import hanging_size, hangs
from diffcloud.io.episodes import Episode
from diffcloud.io.stamps import corrected_stamps, stamp_lags
from diffcloud.jobs.view import proposed_scene
from diffcloud.scene.scenarios import built_in, make_scenario
from diffcloud.scene.scenarios.catalogue import own_options
from diffcloud.scene.scenarios.hang import HangScenario, hang_scenario
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.sim.simulate import rollout
from tests.cli.invoke import invoke

MATERIAL = {"density_kg_m2": 0.2, "stretching_n_m": 80.0, "bending_n_m": 1e-5, "poisson": 0.2, "damping_s": 0.002}
PATH = [
    (0, 0, 0, 0),
    (0.6, 0, 0, 0),
    (0.9, 0, 0.15, 0),
    (1.5, 0, -0.15, 0),
    (2.1, 0, 0.1, 0),
    (2.5, 0, 0, 0),
    (3.5, 0, 0, 0),
]


def options(**fields) -> HangScenario:
    """A cloth of the truth: finer than the meshes of fits."""
    told = {"size_m": (0.30, 0.24), "nodes": (13, 11), "material": MATERIAL, "path": PATH, "frames": 35, "yaw_deg": 20.0}
    return HangScenario.model_validate({**built_in("hang").model_dump(), "rate_hz": 10.0, **told, **fields})


def surface(nodes: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """[count, 3] random points of a mesh with 3 mm of noise."""
    corners = nodes[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(faces), count, p=areas / areas.sum())]
    return np.einsum("nij,ni->nj", chosen, rng.dirichlet(np.ones(3), count)) + rng.normal(0, 0.003, (count, 3))


def recorded(truth: HangScenario, seed: int = 0, points: int = 500) -> Episode:
    """Clouds of a moving cloth, and the track of its gripper 85 mm above the held part."""
    scenario, rng = hang_scenario(truth), np.random.default_rng(seed)
    system, _ = scenario.scene.build()
    with torch.no_grad():
        motion = rollout(system, scenario.steps)
    times = np.arange(scenario.frames + 1) / truth.rate_hz
    nodes = motion.at(torch.as_tensor(times))[0].numpy()
    track = tool(truth, times)
    clouds = [surface(one, system.mesh.faces, points, rng) for one in nodes]
    return Episode.from_frames(clouds, times, gripper=track[:, None])


def tool(truth: HangScenario, times: np.ndarray) -> np.ndarray:
    """[T, 3] a tool 85 mm above the held part, which it moves."""
    path = Motion(tuple(Keyframe(time, (x, y, z)) for time, x, y, z in truth.path))
    return path.at(times)[1] + truth.rim_m + [0, 0, 0.085]


def cloth_of(episode: Episode, size: tuple[float, float]) -> dict:
    return {name: found.value for name, found in found_cloth([episode], size, 0.2).items()}


class TestScenario:
    def test_it_begins_at_rest(self):
        for held in ("edge", "corners", "corner"):
            scenario = hang_scenario(options(held=held, path=[(0, 0, 0, 0), (1, 0, 0, 0)], frames=10))
            run_ = rollout(scenario.scene.build()[0], scenario.steps)
            assert float((run_.positions[0, -1] - run_.positions[0, 0]).norm(dim=-1).max()) < 5e-4

    def test_its_weight_stretches_it_as_a_rod(self):
        """A strip of density ρ stretches by ρ g h² / (2 k) under its own weight, where Poisson's ratio is zero."""
        material = {**MATERIAL, "stretching_n_m": 20.0, "poisson": 0.0}
        scenario = hang_scenario(options(material=material, nodes=(9, 31)))
        longer = np.ptp(scenario.scene.mesh.nodes[:, 2]) - 0.24
        assert longer == pytest.approx(0.2 * 9.81 * 0.24**2 / (2 * 20.0), rel=0.05)

    def test_a_held_edge_is_straight(self):
        with pytest.raises(SceneError, match="a held edge is straight"):
            hang_scenario(options(span=0.8))


class TestLayout:
    @pytest.mark.parametrize(
        ("fields", "held"),
        [
            ({}, "edge"),
            ({"side": "y"}, "edge"),
            ({"held": "corners"}, "edge"),  # two corners without slack look like their side
            ({"held": "corners", "span": 0.9}, "corners"),
            ({"held": "corners", "span": 0.8, "yaw_deg": 200.0}, "corners"),
            ({"held": "corner"}, "corner"),
        ],
    )
    def test_the_start_is_found(self, fields, held):
        truth = options(**fields)
        episode, sentence = prepared(recorded(truth))
        assert hangs(episode)
        assert sentence == ""  # the stamps are right
        layout = found_layout(episode, cloth_of(episode, (0.30, 0.24)))
        found = {name: one.value for name, one in layout.fields.items()}
        assert found["held"] in (held, truth.held)
        if held != "corner":
            assert found["side"] == truth.side
        assert np.linalg.norm(np.subtract(found["rim_m"], truth.rim_m)) < (0.04 if held == "corner" else 0.012)
        assert "it follows the gripper without turning" in layout.warnings[0]

    def test_the_size_is_seen(self):
        assert hanging_size(recorded(options())) == pytest.approx((0.30, 0.25), abs=0.02)

    def test_another_size_is_refused_with_all_distances(self):
        episode, _ = prepared(recorded(options()))
        with pytest.raises(
            EpisodeError, match=r"hangs at rest. RMS distances: .*mm; .*at most 25 mm are allowed. Check --size"
        ):
            found_layout(episode, cloth_of(episode, (0.6, 0.5)))

    def test_a_gripper_elsewhere_is_refused(self):
        episode = recorded(options())
        episode, _ = prepared(replace(episode, gripper=episode.gripper + np.array([0.0, 0.6, 0.0])))
        with pytest.raises(EpisodeError, match="from the gripper; at most"):
            found_layout(episode, cloth_of(episode, (0.30, 0.24)))

    @pytest.mark.parametrize("names", [("left", "right"), ("right", "left")])
    def test_two_grippers_hold_two_corners(self, names):
        truth = options(held="corners", span=0.9)
        episode = recorded(truth)
        yaw = np.radians(truth.yaw_deg)
        half = 0.5 * 0.9 * 0.30 * np.array([np.cos(yaw), np.sin(yaw), 0.0])
        track = np.stack([episode.gripper[:, 0] - half, episode.gripper[:, 0] + half], axis=1)
        episode, _ = prepared(replace(episode, gripper=track, grippers=names))
        cloth = cloth_of(episode, (0.30, 0.24))
        fields = cloth | {name: one.value for name, one in found_layout(episode, cloth).fields.items()}
        scenario = make_scenario(own_options(fields, "hang", "test", folder=Path()))
        assert scenario.scene.handles.grippers == tuple(fields["grippers"])
        for name, handle in zip(fields["grippers"], scenario.scene.handles.handles, strict=True):
            away = scenario.scene.mesh.nodes[handle.node] - episode.gripper[0, names.index(name)]
            assert np.linalg.norm(away[:2]) < 0.02

    def test_three_grippers_are_refused(self):
        episode = recorded(options())
        thrice = np.repeat(episode.gripper, 3, axis=1)
        with pytest.raises(EpisodeError, match="or by two at the corners of a side"):
            found_layout(replace(episode, gripper=thrice, grippers=("a", "b", "c")), cloth_of(episode, (0.30, 0.24)))

    def test_a_flat_cloth_does_not_hang(self):
        cloud = np.random.default_rng(0).uniform(-0.15, 0.15, (400, 3)) * [1, 1, 0.01]
        flat = Episode.from_frames([cloud, cloud], np.array([0.0, 0.1]), gripper=np.full((2, 1, 3), 0.1))
        assert not hangs(flat)
        with pytest.raises(EpisodeError, match="In some recordings the cloth hangs"):
            found_cloth([flat, recorded(options())])


class TestView:
    def test_the_proposed_cloth_hangs(self):
        scenario, odd = proposed_scene(recorded(options()), "towel")
        assert scenario is not None
        assert np.ptp(scenario.scene.mesh.nodes[:, 2]) == pytest.approx(0.25, abs=0.02)
        assert not [sentence for sentence in odd if "tilted" in sentence]


class TestStamps:
    def test_late_clouds_get_their_times_back(self):
        """A plate hangs from a bar. Clouds are published 0.2 s after they were taken and 0.7 of the time since the one
        before, with a jitter of 20 ms."""

        def bar(times):
            """[K, 3] still for 0.4 s, then two swings of 0.15 m, then still."""
            y = 0.15 * np.sin(np.pi * np.clip(times - 0.4, 0.0, 4.0))
            return np.stack([np.zeros_like(times), y, 0.4 + 0.2 * y**2], axis=1)

        rng = np.random.default_rng(1)
        published = 0.3 + np.cumsum(rng.uniform(0.06, 0.22, 32))
        since = np.diff(published, prepend=published[0] - 0.12)
        taken = published - (0.2 + 0.7 * since + rng.normal(0, 0.02, 32))
        x, z = (part.ravel() for part in np.meshgrid(np.linspace(-0.13, 0.13, 8), np.linspace(-0.02, -0.28, 8)))
        plate = np.stack([x, np.zeros(64), z], axis=1) + np.array([0.0, 0.03, -0.02])
        clouds = [plate + place + rng.normal(0, 0.004, (64, 3)) for place in bar(taken)]
        stamps = published - published[0]
        late = Episode.from_frames(clouds, stamps, gripper=bar(published)[:, None])
        lags = stamp_lags(late)
        assert lags is not None
        off = np.abs(lags.seconds - (published - taken))
        swings = (taken > 0.5) & (taken < 4.3)
        assert off[swings].mean() < 0.015
        assert off[~swings].mean() < 0.03  # the bar stands still: what publication says
        common = np.abs(np.median(published - taken) - (published - taken))
        assert common[swings].mean() > 2 * off[swings].mean()
        corrected, found = corrected_stamps(late)
        assert found is not None
        assert corrected.frame_count <= late.frame_count
        assert found.spread_m[1] < 0.3 * found.spread_m[0]

    def test_right_stamps_stay(self):
        episode = recorded(options())
        assert corrected_stamps(episode) == (episode, None)

    def test_a_recording_is_prepared_once(self):
        once, _ = prepared(recorded(options()))
        assert prepared(once) == (once, "")
        assert once.times[0] == 1.0


@pytest.mark.slow
def test_the_command_fits_a_folder_of_clouds_and_a_track_of_another_rate(tmp_path):
    truth = options()
    folder = tmp_path / "towel"
    folder.mkdir()
    episode = recorded(truth)
    for frame, time in enumerate(episode.times):
        cloud = episode.frame(frame).copy()
        cloud[::50] = np.nan
        np.save(folder / f"cloud_{100 + time:.4f}.npy", cloud)
    times = np.arange(0, 3.5, 0.017)
    moved = tool(truth, times)
    rows = [f"{100 + t:.5f},{x:.6f},{y:.6f},{z:.6f}" for t, (x, y, z) in zip(times, moved, strict=True)]
    (folder / "gripper.csv").write_text("\n".join(["t_s,x,y,z", *rows]) + "\n")
    out = tmp_path / "fit"
    invoke("fit", folder, "--size", "0.30x0.24", "--density", "0.2", "--out", out, "--budget", "none")
    told = json.loads((out / "fit.json").read_text())
    assert told["rms_mm"] < 6
    intervals = json.loads((out / "intervals.json").read_text())
    low, high = (intervals["parameters"]["stretching"][end] for end in ("low", "high"))
    assert low < 80.0 < high
