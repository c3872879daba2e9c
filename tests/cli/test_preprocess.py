"""`diffcloud preprocess` on raw episodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from diffcloud.io.episodes import Clock, Episode, read_episode, write_episode
from diffcloud.jobs.preprocess import PreprocessJob
from diffcloud.sensing.validation.episode import validate_raw_episode
from tests.cli.invoke import invoke
from tests.sensing.cloth_scene import SETTINGS, write_cloth_episode
from tests.sensing.test_agreement import CAMERAS, LAG_S, SHIFT_M, TURN, recording
from tests.sensing.test_validation import edit_json


@pytest.fixture
def params(tmp_path) -> Path:
    path = tmp_path / "params.yaml"
    raw = {"depth_jump_m": SETTINGS["depth_jump_m"], "workspace_m": [list(corner) for corner in SETTINGS["workspace_m"]]}
    settings = {"scenes": ["lift"], "preprocess": {"raw": raw, "points": 800, "downsampling": "voxel", "radius_m": 0.03}}
    path.write_text(yaml.safe_dump(settings), encoding="utf-8")
    return path


def test_raw_episode_to_episode(tmp_path, params):
    raw = write_cloth_episode(tmp_path / "raw" / "lift" / "blue1", frames=2).folder
    done = invoke("data", "preprocess", tmp_path / "raw", "--out", tmp_path / "episodes", "--params", params)
    assert done.result["points"].keys() == {"lift/blue1"}
    episode = read_episode(tmp_path / "episodes" / "lift" / "blue1.npz")
    assert episode.frame_count == 2
    assert (np.diff(episode.offsets) <= 800).all()
    assert episode.meta["quality"].keys() >= {
        "points_per_view",
        "masked_fraction",
        "overlap_m",
        "recorded",
        "inliers",
        "kept",
    }
    assert len(np.unique(episode.points[: episode.offsets[1]], axis=0)) == episode.offsets[1]
    single = invoke("data", "preprocess", raw, "--out", tmp_path / "single", "--params", params)  # by itself: the same
    assert single.result["points"] == done.result["points"]
    same = (tmp_path / "single" / "lift" / "blue1.npz").read_bytes()
    assert same == (tmp_path / "episodes" / "lift" / "blue1.npz").read_bytes()


def test_a_raw_episode_from_within_and_a_tool_that_turns(tmp_path, params, monkeypatch):
    raw = write_cloth_episode(tmp_path / "blue1", frames=2).folder
    edit_json(raw / "episode.json", scenario="lift")
    table = pd.read_csv(raw / "robot.csv")
    half = np.linspace(0, np.deg2rad(30), len(table))
    table["tool_qw"], table["tool_qx"], table["tool_qy"], table["tool_qz"] = np.cos(half), np.sin(half), 0.0, 0.0
    table["tool_x"], table["tool_y"], table["tool_z"] = 0.5, 0.0, 0.3
    table.to_csv(raw / "robot.csv", index=False)
    monkeypatch.chdir(raw)
    done = invoke("data", "preprocess", ".", "--out", tmp_path / "out", "--params", params)
    assert done.result["points"].keys() == {"lift/blue1"}
    assert read_episode(tmp_path / "out" / "lift" / "blue1.npz").frame_count == 2
    assert "The tool turns by 60 degrees" in done.errors
    assert done.result["warnings"][0].startswith("blue1: The tool turns")
    assert any(finding.code == "tool_turns" for finding in validate_raw_episode(raw))


@pytest.mark.slow
def test_workers_change_nothing_and_a_damaged_episode_stops_no_other(tmp_path, params):
    for name in ("blue1", "blue2", "blue3"):
        write_cloth_episode(tmp_path / "raw" / "lift" / name, frames=1)
    (tmp_path / "raw" / "lift" / "blue2" / "robot.csv").unlink()
    for workers in (1, 2):
        out = tmp_path / str(workers)
        done = invoke(
            "data", "preprocess", tmp_path / "raw", "--out", out, "--params", params, "--workers", workers, code=1
        )
        assert done.result["points"].keys() == {"lift/blue1", "lift/blue3"}
        assert "blue2: " in done.errors
        assert {path.name for path in (out / "lift").glob("*.npz")} == {"blue1.npz", "blue3.npz"}
    for path in (tmp_path / "1" / "lift").iterdir():
        assert path.read_bytes() == (tmp_path / "2" / "lift" / path.name).read_bytes()


def test_bad_robots_and_places(tmp_path, params):
    raw = write_cloth_episode(tmp_path / "raw" / "blue1", frames=1).folder
    common = (raw, "--out", tmp_path / "episodes", "--params", params)
    assert (
        "No such robot description"
        in invoke("data", "preprocess", *common, "--urdf", tmp_path / "gone.urdf", code=1).errors
    )
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(
        '<robot name="r"><link name="b"><visual><geometry><mesh filename="gone.stl"/></geometry></visual></link></robot>',
        encoding="utf-8",
    )
    assert "gone.stl' is missing" in invoke("data", "preprocess", *common, "--urdf", urdf, code=1).errors
    description = raw / "episode.json"
    description.write_text(description.read_text().replace('"lift"', '"../lift"'), encoding="utf-8")
    assert "must be a plain folder name" in invoke("data", "preprocess", *common, code=1).errors
    assert not (tmp_path / "episodes").exists()


@pytest.fixture
def several(tmp_path) -> Path:
    """params.yaml of both scenarios that have depth cameras."""
    path = tmp_path / "several.yaml"
    path.write_text(yaml.safe_dump({"scenes": ["lift", "fold"], "preprocess": {"points": 100}}), encoding="utf-8")
    return path


def clouds(path: Path, seed: int = 0) -> Path:
    """An episode of clouds."""
    frames = list(np.random.default_rng(seed).uniform(0, 0.3, (2, 200, 3)))
    write_episode(path, Episode.from_frames(frames, np.array([0.0, 0.1])))
    return path


def test_scenarios_without_recordings_are_passed_over(tmp_path, params, several):
    """A folder of lifts alone; of nothing at all, an error that says where recordings lie."""
    clouds(tmp_path / "raw/lift/blue.npz")
    done = invoke("data", "preprocess", tmp_path / "raw", "--out", tmp_path / "out", "--params", several)
    assert list(done.result["points"]) == ["lift/blue"]
    (tmp_path / "empty").mkdir()
    errors = invoke(
        "data", "preprocess", tmp_path / "empty", "--out", tmp_path / "out2", "--params", several, code=1
    ).errors
    assert "no recordings of lift, fold" in errors
    errors = invoke("data", "preprocess", tmp_path / "gone", "--out", tmp_path / "out2", "--params", several, code=1).errors
    assert "No such folder" in errors
    assert not (tmp_path / "out2").exists()


def test_recordings_are_found_where_raw_says(tmp_path, several, params):
    """raw/<name>/ by the scenario in its episode.json, raw/<scenario>/ and raw/episodes/<scenario>/; beside others'."""
    raw = tmp_path / "raw"
    edit_json(write_cloth_episode(raw / "tan1", frames=1).folder / "episode.json", scenario="lift")
    clouds(raw / "lift/tan2.npz")
    clouds(raw / "episodes/fold/tan3.npz")
    clouds(raw / "drape/tan4.npz")
    clouds(raw / "scenes/tan5.npz")
    clouds(tmp_path / "recorded/lift/hidden1.npz")
    board = write_cloth_episode(raw / "episodes/board", frames=1).folder
    edit_json(board / "episode.json", scenario=None)
    settings = {**yaml.safe_load(params.read_text()), "scenes": ["lift", "fold"]}
    params.write_text(yaml.safe_dump(settings))
    done = invoke("data", "preprocess", tmp_path / "recorded", raw, "--out", tmp_path / "out", "--params", params)
    assert set(done.result["points"]) == {"lift/hidden1", "lift/tan1", "lift/tan2", "fold/tan3"}
    assert "Left out: " in done.errors
    assert "raw/drape. Its name is none of the scenarios lift, fold" in done.errors
    assert "board/episode.json names no scenario" in done.errors
    clouds(tmp_path / "recorded/fold/tan3.npz")
    again = invoke("data", "preprocess", tmp_path / "recorded", raw, "--out", tmp_path / "out", "--params", params, code=1)
    assert "Two recordings are called fold/tan3" in again.errors


def test_only_what_has_changed_is_done_again(tmp_path, several, monkeypatch):
    """A new recording, another setting, a recording that is gone: what is there is what a first run would leave."""
    for name in ("a", "b"):
        clouds(tmp_path / f"raw/lift/{name}.npz", seed=ord(name))
    command = ("data", "preprocess", tmp_path / "raw", "--params", several, "--out")
    first = invoke(*command, tmp_path / "out")
    done = list[str]()
    run = PreprocessJob.run
    monkeypatch.setattr(PreprocessJob, "run", lambda job, tell: done.append(job.name) or run(job, tell))
    assert invoke(*command, tmp_path / "out").result == first.result
    assert done == []
    clouds(tmp_path / "raw/lift/c.npz", seed=3)
    clouds(tmp_path / "raw/lift/b.npz", seed=4)
    assert list(invoke(*command, tmp_path / "out").result["points"]) == ["lift/a", "lift/b", "lift/c"]
    assert done == ["b", "c"]
    several.write_text(several.read_text().replace("points: 100", "points: 90"))
    (tmp_path / "raw/lift/a.npz").unlink()
    (tmp_path / "out/lift/mine.txt").write_text("mine")
    said = invoke(*command, tmp_path / "out").errors
    assert done == ["b", "c", "b", "c"]
    assert "Removed clouds whose recording is gone: lift/a.npz." in said
    invoke(*command, tmp_path / "anew")
    (tmp_path / "out/lift/mine.txt").unlink()
    outs = tmp_path / "out", tmp_path / "anew"
    kept, fresh = ({path.relative_to(out): path.read_bytes() for path in out.rglob("*") if path.is_file()} for out in outs)
    assert kept == fresh
    (tmp_path / "out/lift/b.npz").write_bytes(b"damaged")
    invoke(*command, tmp_path / "out")
    assert (tmp_path / "out/lift/b.npz").read_bytes() == fresh[Path("lift/b.npz")]


@pytest.fixture(scope="module")
def two_views(tmp_path_factory) -> Path:
    """Clouds of two cameras that disagree, and settings that align them."""
    work = tmp_path_factory.mktemp("two_views")
    write_episode(work / "raw" / "lift" / "one.npz", recording(noise_m=0.0005, frames=12))
    _align(work, CAMERAS)
    return work


def _align(work, cameras, **settings) -> Path:
    text = yaml.safe_dump({"scenes": ["lift"], "preprocess": {"align_cameras": list(cameras), **settings}})
    (work / "params.yaml").write_text(text, encoding="utf-8")
    return work / "params.yaml"


def test_two_cameras_are_aligned_and_the_meta_says_so(two_views):
    """The second camera's points end where they belong, and its clock offset of 50 ms is stated."""
    before = recording(noise_m=0.0005, frames=12)
    out = two_views / "out"
    invoke("data", "preprocess", two_views / "raw", "--params", two_views / "params.yaml", "--out", out)
    episode = read_episode(out / "lift" / "one.npz")
    assert episode.meta["agreement"]["side"]["from"] == ["one"]
    assert episode.clocks["side"].offset_s == pytest.approx(LAG_S, abs=0.005)
    assert episode.clocks["above"] == Clock(0.0, 0.1)
    found = episode.meta["agreement"]["side"]
    assert found["rms_after_m"] < 0.5 * found["rms_before_m"]
    place = TURN.inv().apply(before.viewpoints["side"] - SHIFT_M)
    assert np.linalg.norm(episode.viewpoints["side"] - place) < 0.005
    again = invoke("data", "preprocess", out, "--params", two_views / "params.yaml", "--out", two_views / "again", code=1)
    assert "has been corrected already" in again.errors
    assert not list((two_views / "again").rglob("*.npz"))


def test_without_the_setting_points_stay(two_views, tmp_path):
    (tmp_path / "params.yaml").write_text("scenes: [lift]\npreprocess: {points: null, outlier_neighbours: 0}\n")
    invoke("data", "preprocess", two_views / "raw", "--params", tmp_path / "params.yaml", "--out", tmp_path / "out")
    episode, before = read_episode(tmp_path / "out" / "lift" / "one.npz"), recording(noise_m=0.0005, frames=12)
    np.testing.assert_array_equal(episode.points, before.points)
    assert not {"agreement", "clocks"} & episode.meta.keys()


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        (
            ("above", "third"),
            "The cameras above and third cannot be compared: the recording's points name the cameras above, side.",
        ),
        (("side", "side"), "align_cameras takes two different cameras"),
        (("side",), "align_cameras"),
    ],
)
def test_cameras_that_cannot_be_aligned(two_views, tmp_path, cameras, message):
    found = invoke(
        "data", "preprocess", two_views / "raw", "--params", _align(tmp_path, cameras), "--out", tmp_path / "out", code=1
    )
    assert message in found.errors
    assert not list((tmp_path / "out").rglob("*.npz"))


def test_clouds_in_other_units_are_not_aligned(tmp_path, params):
    settings = yaml.safe_load(params.read_text())
    settings["preprocess"] |= {"align_cameras": ["overhead", "side"]}
    settings["preprocess"]["raw"] |= {"origin_m": [0.0, 0.0, 0.0], "length_unit_m": 0.35}
    params.write_text(yaml.safe_dump(settings))
    write_cloth_episode(tmp_path / "raw" / "lift" / "blue1", frames=1)
    found = invoke("data", "preprocess", tmp_path / "raw", "--params", params, "--out", tmp_path / "out", code=1)
    assert "The scene's length unit is 0.35 m. align_cameras takes clouds in metres." in found.errors
