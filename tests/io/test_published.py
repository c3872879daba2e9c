"""The published recordings as recordings: `import --trajectories`, and what the scenarios make of them."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch

from diffcloud.estimation.objective import Objective
from diffcloud.estimation.pose import default_priors
from diffcloud.io.episodes import Episode, read_episode
from diffcloud.io.imports import release_episodes
from diffcloud.io.published import RECORDED_START_M, RELEASE_UNIT_M, in_clouds_frame, read_trajectories, recorded_episode
from diffcloud.io.published_cameras import published_set_ups
from diffcloud.scene.scenarios import load_scenario
from tests.cli.invoke import invoke
from tests.io.test_imports import make_clouds

FRAMES = 25
NAMES = {"lift": "lift_navy2", "fold": "fold_tan"}


def track_of(kind):
    """[25, 3] of a robot that raises the cloth and carries it along its x, with a little of y."""
    s = np.linspace(0.0, 1.0, FRAMES)
    along = 0.2 if kind == "lift" else -0.28
    return np.stack([0.6 + along * s, 0.15 + 0.01 * s**2, 0.08 + 0.2 * s], axis=1)


@pytest.fixture
def published(tmp_path):
    """A recording of each kind, a simulated one, and the tracks beside them."""
    root = tmp_path / "pysim"
    for kind, name in NAMES.items():
        make_clouds(root / f"{kind}_real_pcls" / name, FRAMES)
    guesses = np.array({NAMES["lift"]: np.float32([5, 1])}, dtype=object)
    np.save(root / "lift_real_pcls" / "preds_mlp.npy", guesses, allow_pickle=True)
    make_clouds(root / "band_sim_pcls" / "0")
    (tmp_path / "trajs").mkdir()
    for kind in NAMES:
        np.save(tmp_path / "trajs" / f"{kind}_traj.npy", track_of(kind))
    return tmp_path


def import_release(folder, *, code=0):
    options = ("--trajectories", folder / "trajs", "--out", folder / "episodes")
    return invoke("data", "import", folder / "pysim", *options, code=code)


def written(folder):
    return sorted(path.relative_to(folder).as_posix() for path in (folder / "episodes").rglob("*") if path.is_file())


class TestImport:
    def test_recordings_come_beside_the_published_episodes(self, published):
        names = import_release(published).result["episodes"]
        assert names == {
            "release_lift": ["lift_navy2"],
            "recorded_lift": ["lift_navy2"],
            "release_fold": ["fold_tan"],
            "recorded_fold": ["fold_tan"],
            "release_band": ["0"],
        }
        assert written(published) == sorted(f"episodes/{kind}/{name}.npz" for kind, (name,) in names.items())

    def test_without_trajectories_all_is_as_it_was(self, published):
        import_release(published)
        plain = invoke("data", "import", published / "pysim", "--out", published / "plain").result["episodes"]
        assert set(plain) == {"release_lift", "release_fold", "release_band"}
        for kind, (name,) in plain.items():
            path = f"{kind}/{name}.npz"
            assert (published / "plain" / path).read_bytes() == (published / "episodes" / path).read_bytes()

    @pytest.mark.parametrize("kind", NAMES)
    def test_a_recording_is_the_published_one_in_metres_and_seconds(self, published, kind):
        import_release(published)
        units = read_episode(published / "episodes" / f"release_{kind}" / f"{NAMES[kind]}.npz")
        metres = read_episode(published / "episodes" / f"recorded_{kind}" / f"{NAMES[kind]}.npz")
        np.testing.assert_array_equal(metres.offsets, units.offsets)
        np.testing.assert_allclose(metres.points, RELEASE_UNIT_M * units.points, rtol=1e-6)
        np.testing.assert_allclose(metres.times, np.arange(FRAMES) / 10)
        assert metres.meta["scenario"] == f"recorded_{kind}"
        assert metres.meta["fabric"] == units.meta["fabric"]
        # the published pairs are multipliers of the published scene's material
        assert "predictions" in units.meta
        assert "predictions" not in metres.meta
        assert default_priors(metres)["scale"] == 0.02
        assert "scale" not in default_priors(units)
        assert metres.gripper.shape == (FRAMES, 1, 3)
        np.testing.assert_allclose(metres.gripper[0, 0, :2], RECORDED_START_M[kind][:2])

    def test_only_tracks_of_recordings_that_are_there_are_asked_for(self, published):
        (published / "trajs" / "fold_traj.npy").unlink()
        (published / "pysim" / "fold_real_pcls").rename(published / "elsewhere")
        assert set(import_release(published).result["episodes"]) == {"release_lift", "recorded_lift", "release_band"}


def grid_clouds(set_up, rng, count):
    """Clouds in the release's unit: whole pixels and millimetres of both cameras, and the camera of each point."""
    clouds, cameras = [], []
    for _ in range(count):
        parts = []
        for pinhole in set_up.pinholes.values():
            pixel = np.stack([rng.integers(290, 330, 60), rng.integers(220, 260, 60)], axis=1)
            z = 1e-3 * rng.integers(700, 720, 60)
            ray = np.column_stack([(pixel - pinhole.centre) / pinhole.focal, np.ones(60)]) * z[:, None]
            T = pinhole.T_camera_scene
            parts.append((ray - T[:, 3]) @ T[:, :3])
        clouds.append(np.concatenate(parts) / RELEASE_UNIT_M)
        cameras.append(np.repeat([0, 1], 60))
    return clouds, np.concatenate(cameras)


class TestCameras:
    """Points name the camera in whose image they have whole pixels and whole millimetres."""

    @pytest.mark.parametrize("set_up", published_set_ups(), ids=lambda one: one.name)
    @pytest.mark.parametrize("kind", NAMES)
    def test_the_set_up_is_found_from_the_points_alone(self, set_up, kind):
        clouds, cameras = grid_clouds(set_up, np.random.default_rng(0), 25)
        published = Episode.from_frames(clouds, 0.04 * np.arange(25))
        episode = recorded_episode(kind, "any_name", published, track_of(kind))
        assert episode.meta["set_up"] == set_up.name
        np.testing.assert_array_equal(episode.camera, cameras)
        assert episode.meta["cameras"] == list(episode.viewpoints) == ["overhead", "side"]
        # each point lies on its pixel's ray in the episode's frame
        for number, pinhole in enumerate(episode.pinholes):
            mine = episode.camera == number
            x = episode.points[mine] @ pinhole.T_camera_scene[:, :3].T + pinhole.T_camera_scene[:, 3]
            seen = np.array(pinhole.focal) * x[:, :2] / x[:, 2:] + pinhole.centre
            assert np.abs(seen - episode.pixel[mine]).max() < 0.01
            assert np.abs(1e3 * x[:, 2] - np.rint(1e3 * x[:, 2])).max() < 0.01

    def test_points_off_the_grid_name_no_camera(self):
        clouds, _ = grid_clouds(published_set_ups()[0], np.random.default_rng(0), 25)
        published = Episode.from_frames([cloud + 0.001 for cloud in clouds], 0.04 * np.arange(25))
        episode = recorded_episode("lift", "any_name", published, track_of("lift"))
        assert episode.camera is None
        assert "set_up" not in episode.meta

    def test_where_the_robots_frame_is_known_the_pose_is_tight(self):
        for set_up in published_set_ups():
            clouds, _ = grid_clouds(set_up, np.random.default_rng(0), 25)
            episode = recorded_episode("lift", "one", Episode.from_frames(clouds, 0.04 * np.arange(25)), track_of("lift"))
            known, priors = set_up.robot_to_clouds_m is not None, default_priors(episode)
            assert (priors["x"], priors["yaw"]) == (
                pytest.approx(0.01 if known else 0.03),
                pytest.approx(np.radians(1 if known else 20)),
            )
            if known:  # the gripper and the clouds keep their places against each other
                x, y, z = set_up.robot_to_clouds_m
                r = track_of("lift")
                place = np.stack([r[:, 1] + x, y - r[:, 0], r[:, 2] + z], axis=1)
                np.testing.assert_allclose(episode.gripper[:, 0] - episode.meta["clouds_shift_m"], place, atol=1e-12)


def test_every_point_of_the_published_recordings_names_its_camera(release):
    tracks = read_trajectories(release.parent / "trajs", ("lift", "fold"))
    found = [(scenario.removeprefix("release_"), name, episode) for scenario, name, episode in release_episodes(release)]
    names = {}
    for kind, name, published in found:
        if kind in tracks:
            episode = recorded_episode(kind, name, published, tracks[kind])
            assert len(episode.points) == len(published.points), name
            assert set(np.unique(episode.camera)) == {0, 1}
            names.setdefault(episode.meta["set_up"], set()).add(name)
    assert {key: len(value) for key, value in names.items()} == {"folds": 10, "lifts_a": 3, "lifts_b": 7}
    assert names["lifts_a"] == {"lift_redblack", "lift_redblack2", "lift_tan2"}


class TestFrame:
    @pytest.mark.parametrize("kind", NAMES)
    def test_the_clouds_frame_is_the_robots_turned_and_shifted(self, kind):
        """Distances and handedness stay, and the vertical."""
        track = np.random.default_rng(0).normal(size=(6, 3))
        moved = in_clouds_frame(kind, track)
        way, moved_way = track - track[0], moved - moved[0]
        np.testing.assert_allclose(moved_way @ moved_way.T, way @ way.T, atol=1e-12)
        assert np.linalg.det(moved_way[1:4]) == pytest.approx(np.linalg.det(way[1:4]))
        np.testing.assert_allclose(moved_way[:, 2], way[:, 2], atol=1e-12)

    def test_what_goes_along_the_robots_x_goes_against_the_clouds_y(self):
        moved = in_clouds_frame("lift", np.array([[0.5, 0.1, 0.1], [0.7, 0.1, 0.4]]))
        np.testing.assert_allclose(moved, [[0.0, 0.105, 0.1], [0.0, -0.095, 0.4]])


BAD = [
    (track_of("lift")[:24], r"lift_traj\.npy has 24 rows, but lift_navy2 has 25 clouds"),
    (track_of("lift")[:, :2], r"lift_traj\.npy has shape \[25, 2\]; a track has shape \[frames, 3\]"),
    (track_of("lift")[0], r"lift_traj\.npy has shape \[3\]"),
    (track_of("lift")[:1], r"lift_traj\.npy has shape \[1, 3\]; .* two frames or more"),
    (np.where(np.arange(FRAMES)[:, None] == 7, np.nan, track_of("lift")), r"lift_traj\.npy: row 7 is \[nan, .* finite"),
    (np.where(np.arange(FRAMES)[:, None] == 3, np.inf, track_of("lift")), r"lift_traj\.npy: row 3 is \[inf, "),
    (1000 * track_of("lift"), r"lift_traj\.npy holds a coordinate of 800; positions are metres, at most 5"),
    (track_of("lift").astype(str), r"lift_traj\.npy holds <U\d+ values; a track holds numbers"),
    (np.array({"track": [1.0]}, dtype=object), r"lift_traj\.npy holds a pickled dict; a track is a plain array"),
]


class TestBadTracks:
    """Every error names the file, what came and what is allowed, and leaves nothing behind."""

    @pytest.mark.parametrize(("value", "message"), BAD)
    def test_wrong_contents(self, published, value, message):
        np.save(published / "trajs" / "lift_traj.npy", value, allow_pickle=True)
        self.check(published, message)

    def test_a_program_in_a_pickle_is_not_run(self, published):
        class Writes:
            def __reduce__(self):
                return (open, (str(published / "ran"), "w"))

        np.save(published / "trajs" / "lift_traj.npy", np.array(Writes(), dtype=object), allow_pickle=True)
        self.check(published, r"lift_traj\.npy refers to .*open")
        assert not (published / "ran").exists()

    def test_missing(self, published):
        (published / "trajs" / "fold_traj.npy").unlink()
        self.check(published, r"No such track: .*fold_traj\.npy\. --trajectories takes the folder")

    def test_cut_off(self, published):
        path = published / "trajs" / "fold_traj.npy"
        path.write_bytes(path.read_bytes()[:-8])
        self.check(published, r"fold_traj\.npy is damaged")

    def test_no_recording_that_they_belong_to(self, published):
        for kind in NAMES:
            (published / "pysim" / f"{kind}_real_pcls").rename(published / kind)
        self.check(published, "has neither lift_real_pcls nor fold_real_pcls")

    def test_a_damaged_cloud_after_whole_ones(self, published):
        (published / "pysim" / "fold_real_pcls" / "fold_tan" / "013.npy").write_bytes(b"not a cloud")
        self.check(published, r"013\.npy is not a readable \.npy file")

    @staticmethod
    def check(folder, message):
        assert re.search(message, import_release(folder, code=1).errors)
        assert not (folder / "episodes").exists()


class TestScenarios:
    @pytest.mark.parametrize(("kind", "frames"), [("lift", (16, 20, 24)), ("fold", (10, 13, 16))])
    def test_the_papers_cloth_in_si(self, kind, frames):
        scenario = load_scenario(f"recorded_{kind}")
        scene = scenario.scene
        nodes = scene.mesh.nodes
        assert scenario.loss_frames == frames
        assert scenario.loss_faces is None
        assert scenario.length_unit_m == 1
        assert (scene.frame_time, scene.frame_steps) == (pytest.approx(0.1), 8)
        assert (scene.integrator, scene.surrounding.gravity) == ("implicit", (0, 0, -9.81))
        assert scene.material.name == "soft-knit"
        # the diagonal of the diamond lies along y, and the gripper's corner near the start of the track
        assert np.ptp(nodes, axis=0) == pytest.approx([0.2625 * np.sqrt(2)] * 2 + [0.0])
        assert np.abs(nodes[scenario.grasped[0], :2] - RECORDED_START_M[kind][:2]).max() < 0.02

    def test_own_scenario_from_a_recorded_one(self, tmp_path):
        (tmp_path / "mine.yaml").write_text("base: recorded_fold\nmaterial: silk\n")
        mine, base = load_scenario(tmp_path / "mine.yaml"), load_scenario("recorded_fold")
        assert mine.scene.material.name == "silk"
        np.testing.assert_array_equal(mine.scene.mesh.nodes, base.scene.mesh.nodes)

    @pytest.mark.parametrize("kind", NAMES)
    def test_an_imported_recording_is_simulated_under_its_track(self, published, kind, monkeypatch):
        """The grasped corner goes where the track says, and the fit takes name and episode as they are."""
        monkeypatch.chdir(published)
        import_release(published)
        name, episode = f"recorded_{kind}", f"episodes/recorded_{kind}/{NAMES[kind]}.npz"
        invoke("simulate", name, "--track", episode, "--out", "run.npz")
        node = load_scenario(name).grasped[0]
        with np.load("run.npz") as run:
            corner = run["nodes"][:FRAMES, node]
        track = read_episode(published / episode).gripper[:, 0]
        np.testing.assert_allclose(corner - corner[0], track - track[0], atol=1e-6)


@pytest.mark.parametrize("kind", NAMES)
def test_a_rollout_under_the_track_stays_near_the_recorded_tops(release, kind):
    """The grasped corner is where the clouds are highest, in the median: some have scraps of the gripper on top."""
    (track,) = read_trajectories(release.parent / "trajs", (kind,)).values()
    scenario = load_scenario(f"recorded_{kind}")
    found = [(n, e) for s, n, e in release_episodes(release) if s == f"release_{kind}"]
    episodes = [recorded_episode(kind, name, episode, track) for name, episode in found]
    objective = Objective(scenario, episodes[0], frames=scenario.loss_frames)
    with torch.no_grad():
        run = objective.simulate({"stretching": torch.ones(1), "density": torch.ones(1)})
    corner = run.at(objective.times)[0, :, scenario.grasped[0]].numpy()
    gaps = []
    for episode in episodes:
        for place, frame in zip(corner, scenario.loss_frames, strict=True):
            points = episode.frame(frame)
            top = points[points[:, 2] >= np.quantile(points[:, 2], 0.995)].mean(axis=0)
            gaps.append(top - place)
    assert len(gaps) == 30
    assert np.abs(np.median(gaps, axis=0)).max() < 0.015
    assert np.median(np.linalg.norm(gaps, axis=1)) < 0.03
