"""The page of a recording before a fit: the proposed cloth, and what looks wrong."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from diffcloud.io.clouds import write_ply
from diffcloud.io.episodes import read_episode
from tests.cli.invoke import invoke
from tests.reporting.pages import overlays_of

TOWEL = Path(__file__).parents[2] / "examples" / "towel.npz"


def written(folder, change=lambda frames, track: None, gripper=True):
    """A folder of numbered clouds of the towel."""
    towel = read_episode(TOWEL)
    frames = [towel.frame(index).astype(float) for index in range(towel.frame_count)]
    track = np.column_stack([towel.times, towel.gripper[:, 0]])
    change(frames, track)
    for index, frame in enumerate(frames):
        write_ply(folder / "towel" / f"{index:03d}.ply", frame)
    if gripper:
        np.savetxt(folder / "towel" / "gripper.csv", track, delimiter=",", header="t_s,x,y,z", comments="")
    return folder / "towel"


def few_points(frames, track):
    frames[5] = frames[5][:100]


def millimetres(frames, track):
    frames[:] = [1000 * frame for frame in frames]


def missing_frame(frames, track):
    track[8:, 0] += 0.3


def jump(frames, track):
    track[7:, 1] += 0.5


def robot(frames, track):
    frames[9] = np.concatenate([frames[9], frames[9][:50] + np.array([0, 0, 1.5])])


def below(frames, track):
    frames[3] = np.concatenate([frames[3], frames[3][:50] - np.array([0, 0, 0.1])])


def test_a_folder_of_clouds_shows_the_cloth_that_a_fit_would_start_from(tmp_path):
    done = invoke("view", written(tmp_path), "--out", tmp_path / "look.html")
    assert done.result["problems"] == []
    page = (tmp_path / "look.html").read_text(encoding="utf-8")
    names = {layer["name"] for layer in overlays_of(page)[0]["layers"]}
    wanted = {
        "recorded",
        "gripper, as recorded",
        "proposed initial cloth",
        "held nodes",
        "table",
        "axes of the world, 10 cm",
    }
    assert names == {*wanted, "axes of the world, 10 cm"}
    sides = [float(side) for side in re.search(r"proposed cloth: sides ([\d.]+), ([\d.]+) m", page).groups()]
    assert sides == pytest.approx([0.395, 0.244], rel=0.02)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (few_points, "Frame 5 has few points (least 100, median 1500)"),
        (millimetres, "these look as if they were in millimetres"),
        (missing_frame, "0.40 s pass after frame 7, usually 0.10 s"),
        (jump, "The gripper moves at"),
        (robot, "Frame 9 (up to 3 %): points farther from the gripper than the cloth reaches"),
        (below, "Frame 3 (up to 3 %): points more than 2 cm below the table"),
    ],
)
def test_what_looks_wrong_is_said(tmp_path, change, said):
    done = invoke("view", written(tmp_path, change), "--out", tmp_path / "look.html")
    assert any(said in text for text in done.result["problems"]), done.result["problems"]
    assert f"towel: {done.result['problems'][0].partition(': ')[2]}" in done.errors


def test_clouds_without_a_gripper_are_shown(tmp_path):
    done = invoke("view", written(tmp_path, gripper=False), "--out", tmp_path / "look.html")
    assert any("no track of its gripper" in text for text in done.result["problems"])
    assert any("assumes 10 Hz" in text for text in done.result["problems"])
