"""`diffcloud preprocess` on raw episodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from diffcloud.io.episodes import read_episode
from diffcloud.sensing.validation.episode import validate_raw_episode
from tests.pipeline.invoke import invoke
from tests.sensing.cloth_scene import SETTINGS, write_cloth_episode
from tests.sensing.test_validation import edit_json


@pytest.fixture
def params(tmp_path) -> Path:
    path = tmp_path / "params.yaml"
    raw = {"flying_m": SETTINGS["flying_m"], "workspace_m": [list(corner) for corner in SETTINGS["workspace_m"]]}
    settings = {"scenarios": ["lift"], "preprocess": {"raw": raw, "points": 800, "thinning": "voxel", "radius_m": 0.03}}
    path.write_text(yaml.safe_dump(settings), encoding="utf-8")
    return path


def test_raw_episode_to_episode(tmp_path, params):
    raw = write_cloth_episode(tmp_path / "raw" / "lift" / "blue1", frames=2).folder
    done = invoke("preprocess", tmp_path / "raw", "--out", tmp_path / "episodes", "--params", params)
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
    single = invoke("preprocess", raw, "--out", tmp_path / "single", "--params", params)  # by itself: the same
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
    done = invoke("preprocess", ".", "--out", tmp_path / "out", "--params", params)
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
        done = invoke("preprocess", tmp_path / "raw", "--out", out, "--params", params, "--workers", workers, code=1)
        assert done.result["points"].keys() == {"lift/blue1", "lift/blue3"}
        assert "blue2: " in done.errors
        assert {path.name for path in (out / "lift").glob("*.npz")} == {"blue1.npz", "blue3.npz"}
    for path in (tmp_path / "1" / "lift").iterdir():
        assert path.read_bytes() == (tmp_path / "2" / "lift" / path.name).read_bytes()


def test_bad_robots_and_places(tmp_path, params):
    raw = write_cloth_episode(tmp_path / "raw" / "blue1", frames=1).folder
    common = (raw, "--out", tmp_path / "episodes", "--params", params)
    assert "No such robot description" in invoke("preprocess", *common, "--urdf", tmp_path / "gone.urdf", code=1).errors
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(
        '<robot name="r"><link name="b"><visual><geometry><mesh filename="gone.stl"/></geometry></visual></link></robot>',
        encoding="utf-8",
    )
    assert "gone.stl' is missing" in invoke("preprocess", *common, "--urdf", urdf, code=1).errors
    description = raw / "episode.json"
    description.write_text(description.read_text().replace('"lift"', '"../lift"'), encoding="utf-8")
    assert "must be a plain folder name" in invoke("preprocess", *common, code=1).errors
    assert not (tmp_path / "episodes").exists()
