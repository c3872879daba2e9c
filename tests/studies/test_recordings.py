"""Synthetic raw recordings through the commands: recorded, made into clouds, fitted, measured, reported."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from diffcloud.io.episodes import read_episode, write_episode
from diffcloud.io.images import png_size, write_depth
from diffcloud.sensing.recorder import read_truth
from tests.cli.invoke import invoke, stage, study
from tests.docs.form import check_form

SMALL = {
    "base": "lift",
    "nodes": [5, 5],
    "frames": 3,
    "steps_per_frame": 2,
    "points": 200,
    "path": [[0, 0, 0, 0], [0.3, 0, -0.05, 0.15]],
}
PARAMS = {
    "scenes": ["small"],
    "synthesize": {"per_scenario": 1},
    "preprocess": {"raw": {"depth_jump_m": 0.03}, "outlier_std": 5},
    "fit": {"solver": {"max_steps": 1}},
    "evaluate": {"draws": 1},
}


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("pipeline")
    (folder / "raw" / "scenes").mkdir(parents=True)
    (folder / "raw" / "scenes" / "small.yaml").write_text(yaml.safe_dump(SMALL), encoding="utf-8")
    (folder / "params.yaml").write_text(yaml.safe_dump(PARAMS), encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        stage("synthesize", "--params", "params.yaml", "--out", "recorded")
        invoke("data", "preprocess", "--params", "params.yaml", "--out", "episodes", "recorded")
    return folder


@pytest.fixture
def work(place, monkeypatch) -> Path:
    monkeypatch.chdir(place)
    return place


def test_recordings_are_raw_and_become_clouds_with_pictures(work):
    assert (work / "recorded" / "small" / "small_hidden1" / "robot.csv").is_file()
    episode = read_episode(work / "episodes" / "small" / "small_hidden1.npz")
    assert episode.frame_count == 4
    assert np.diff(episode.offsets).min() >= 1500
    assert episode.meta["truth"].keys() == {"stretching", "density"}
    assert np.abs(episode.points[:, :2]).max() < 0.25  # in the scene's frame, not the arm's
    truth = read_truth(work / "recorded" / "small" / "small_hidden1")
    lifted = truth.nodes[..., 2].max(axis=1)
    np.testing.assert_allclose(np.ptp(episode.gripper[:, 0, 2]), lifted[3] - lifted[0], atol=0.004)
    assert png_size(work / "episodes" / "small" / "small_hidden1.mask.png") == (2 * 424, 240)
    assert png_size(work / "episodes" / "small" / "small_hidden1.cloud.png") == (720, 240)


def test_measured_against_the_truth_and_reported(work):
    done = study(
        "recordings", "--recorded", "recorded", "--episodes", "episodes", "--out", "table.md", "--params", "params.yaml",
    )  # fmt: skip
    figures = done.result["clouds"]["small_hidden1"]
    assert figures["robot"] <= 0.002
    assert len(done.result["fits"]) == 3
    page = (work / "table.md").read_text(encoding="utf-8")
    assert page.count("| small_hidden1 |") == 2
    check_form(page)
    stage("fit", "--params", "params.yaml", "--out", "fits", "episodes")
    stage("evaluate", "--params", "params.yaml", "--fits", "fits", "--episodes", "episodes", "--out", "reports")
    stage(
        "report", "--params", "params.yaml", "--fits", "fits", "--episodes", "episodes", "--tables", "reports/tables",
        "--out", "reports/index.html",
    )  # fmt: skip
    page = (work / "reports" / "index.html").read_text(encoding="utf-8")
    assert page.count("<figure><figcaption>small_hidden1") == 2
    assert "overhead" in page


def test_a_look_at_the_raw_recording_its_clouds_and_a_fit(work):
    raw, episode = "recorded/small/small_hidden1", "episodes/small/small_hidden1.npz"
    done = invoke("view", raw, "--params", "params.yaml", "--out", "raw.html", "--scene", "small")
    assert done.result["episodes"] == 1
    page = (work / "raw.html").read_text(encoding="utf-8")
    assert page.count('"name":"recorded, overhead"') == page.count('"name":"cloth, nominal material"') == 1
    assert len(re.findall(r'"/9j/[A-Za-z0-9+/=]{1000,}"', page)) == 4  # a JPEG a frame
    invoke("fit", episode, "--scene", "small", "--params", "params.yaml", "--out", "seen")
    invoke("view", episode, "--fit", "seen/fit.json", "--out", "fitted")
    page = (work / "fitted.html").read_text(encoding="utf-8")
    for name in ("fitted", "start of the fit", "fitted, where the scene has it", "table", "cameras", "held nodes"):
        assert f'"name":"{name}"' in page
    invoke("view", "episodes/small", "--frames", 2, "--points", 7, "--out", "few.html")
    assert '"numbers":[0,3]' in (work / "few.html").read_text(encoding="utf-8")


def test_a_look_with_what_does_not_belong_to_it(work):
    raw, episode = work / "recorded" / "small" / "small_hidden1", work / "episodes" / "small" / "small_hidden1.npz"
    invoke("fit", episode, "--scene", "small", "--params", "params.yaml", "--out", "seen")
    shutil.copy(episode, work / "other.npz")
    told = invoke("view", "other.npz", "--fit", "seen/fit.json", "--out", "o.html", code=1).errors
    assert "Unknown recording of the fit 'other'" in told
    assert "small_hidden1" in told
    assert "No such episode" in invoke("view", "nothing.npz", "--out", "o.html", code=1).errors
    assert "holds no episodes" in invoke("view", raw.parent, "--out", "o.html", code=1).errors
    assert not (work / "o.html").exists()


@pytest.mark.parametrize(
    ("meta", "says"),
    [
        ({"viewpoints": {"side": [1, 2]}}, "viewpoints of an episode's meta"),
        ({"viewpoints": "side"}, "viewpoints of an episode's meta"),
        ({"scenario": ["lift"], "cameras": {"side": 1}}, None),
        ({"scenario": "../../small", "cameras": [3]}, None),
    ],
)
def test_a_look_at_an_episode_whose_meta_is_damaged(work, meta, says):
    """What only names something is left out; positions that are none are refused."""
    episode = read_episode(work / "episodes" / "small" / "small_hidden1.npz")
    write_episode(work / "damaged.npz", replace(episode, meta=meta, lost=None))
    done = invoke("view", "damaged.npz", "--out", "damaged.html", code=0 if says is None else 1)
    if says is None:
        page = (work / "damaged.html").read_text(encoding="utf-8")
        assert '"name":"recorded"' in page
        assert "nominal material" not in page
    else:
        assert says in done.errors


def test_again_replaces_only_what_is_synthetic(work):
    stage("synthesize", "--params", "params.yaml", "--out", "recorded")
    own = work / "own" / "small" / "small_hidden1"
    own.mkdir(parents=True)
    (own / "notes.txt").write_text("mine", encoding="utf-8")
    assert "no synthetic recording" in stage("synthesize", "--params", "params.yaml", "--out", "own", code=1).errors
    assert (own / "notes.txt").is_file()


def test_none_are_made_where_only_own_ones_are_wanted(work):
    (work / "own.yaml").write_text(yaml.safe_dump({**PARAMS, "synthesize": {"per_scenario": 0}}), encoding="utf-8")
    assert stage("synthesize", "--params", "own.yaml", "--out", "no_others").result["episodes"] == {}
    assert [path.name for path in (work / "no_others").iterdir()] == ["manifest.json"]


def test_a_truncated_image_and_one_without_depth_are_named(work):
    raw = work / "copied_for_damage" / "small" / "small_hidden1"
    shutil.copytree(work / "recorded" / "small" / "small_hidden1", raw)
    common = ("data", "preprocess", raw, "--params", "params.yaml", "--out", "damaged")
    image = raw / "cameras" / "side" / "depth" / "000002.png"
    whole = image.read_bytes()
    image.write_bytes(whole[: len(whole) // 2])
    assert "000002.png is truncated" in invoke(*common, code=1).errors
    image.write_bytes(whole)
    write_depth(raw / "cameras" / "overhead" / "depth" / "000001.png", np.zeros((240, 424), np.uint16))
    assert "overhead, frame 1: 0 valid depth" in invoke(*common, code=1).errors
    assert not (work / "damaged" / "small").exists()


def test_poses_found_are_held_against_the_true_ones(work, tmp_path):
    told = study("recordings", "--recorded", "recorded", "--episodes", "episodes", "--params", "params.yaml",
        "--out", tmp_path / "poses.md", "--nuisance", "none", "--nuisance", "x=1cm,yaw=2deg,lag=5ms",
    )  # fmt: skip
    (fits,) = told.result["recordings"]
    assert [(fit["start"][:6], fit["nuisance"]) for fit in fits[:2]] == [
        ("as the", "none"),
        ("as the", "x=1cm,yaw=2deg,lag=5ms"),
    ]
    assert fits[0]["shift_mm"] < 0.5  # stated exactly
    assert fits[2]["start"].endswith("its turn fitted")
    assert fits[4]["shift_mm"] < 5  # found from a noisy cloud
    assert fits[0]["lag_ms"] is None
    assert fits[1]["lag_ms"] is not None
    page = (tmp_path / "poses.md").read_text()
    assert "off by 0 mm and 0° together" in page
    check_form(page)
    assert page.count("| as the first frame shows it") == page.count("| as the scenario says, its turn fitted") == 2
    broken = study("recordings", "--recorded", "recorded", "--episodes", "episodes", "--params", "params.yaml",
                    "--out", tmp_path / "poses2.md", "--nuisance", "sideways=2", code=1)  # fmt: skip
    assert "sideways" in broken.errors
    assert not (tmp_path / "poses2.md").exists()


def test_the_pose_of_a_heavy_displaced_cloth_is_the_true_one(tmp_path, monkeypatch):
    """With the mass that fits are given: with the scenario's, the motion would lie elsewhere."""
    monkeypatch.chdir(tmp_path)
    heavy = {"per_scenario": 1, "true_range": [2.8, 3.0], "placement_error": [30, 0]}
    scene = {**SMALL, "frames": 10, "path": [[0, 0, 0, 0], [1.0, 0, -0.1, 0.3]]}
    settings = {
        "scenes": ["small"],
        "synthesize": heavy,
        "preprocess": PARAMS["preprocess"],
        "fit": {"solver": {"model_error": False}},
    }
    Path("raw/scenes").mkdir(parents=True)
    Path("raw/scenes/small.yaml").write_text(yaml.safe_dump(scene), encoding="utf-8")
    Path("params.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
    stage("synthesize", "--params", "params.yaml", "--out", "recorded")
    invoke("data", "preprocess", "--params", "params.yaml", "--out", "episodes", "recorded")
    told = study(
        "recordings", "--recorded", "recorded", "--episodes", "episodes", "--params", "params.yaml", "--out", "poses.md",
        "--nuisance", "x=10cm,y=10cm",
    )  # fmt: skip
    (fits,) = told.result["recordings"]
    assert max(fit["shift_mm"] for fit in fits) < 2
