"""Importing the published layout and folders of clouds."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.errors import EpisodeError
from diffcloud.io.imports import cloud_folder, release_episodes


def make_clouds(folder, count=4, suffix="npy"):
    folder.mkdir(parents=True)
    for index in range(count):
        np.save(folder / f"{index:03d}.{suffix}", np.full((5 + index, 3), index, np.float32))
    return folder


def make_release(root):
    make_clouds(root / "lift_real_pcls" / "lift_polka2")
    make_clouds(root / "band_sim_pcls" / "0")
    save = {"allow_pickle": True}
    np.save(root / "lift_real_pcls" / "preds_mlp.npy", np.array({"lift_polka2": np.float32([5, -1])}, dtype=object), **save)
    np.save(root / "band_sim_pcls" / "gt.npy", np.array({"0": np.array([0.5, 5.0])}, dtype=object), **save)
    return root


def test_release_layout(tmp_path):
    found = {(scenario, name): episode for scenario, name, episode in release_episodes(make_release(tmp_path))}
    lift, band = found["release_lift", "lift_polka2"], found["release_band", "0"]
    # real recordings: file j meets the state after j + 1 steps; simulated ones: after j steps
    np.testing.assert_allclose(lift.times, [0.04, 0.08, 0.12, 0.16])
    np.testing.assert_allclose(band.times, [0.0, 0.04, 0.08, 0.12])
    assert [len(lift.frame(index)) for index in range(4)] == [5, 6, 7, 8]
    assert lift.meta["fabric"] == "polka"
    assert lift.meta["repeat"] == 2
    assert lift.meta["category"] == "highly deformable"
    assert lift.meta["category_assumed"] is True
    assert lift.meta["predictions"] == {"mlp": {"stretch": 5.0, "mass": -1.0}}
    assert band.meta["truth"] == {"stretch": 0.5, "mass": 5.0}


def test_missing_frames_and_folders(tmp_path):
    with pytest.raises(EpisodeError, match="holds none of lift_real_pcls"):
        list(release_episodes(tmp_path))
    folder = make_clouds(tmp_path / "lift_real_pcls" / "lift_tan")
    (folder / "001.npy").unlink()
    with pytest.raises(EpisodeError, match=r"frames \[1\] are missing between 0 and 3"):
        list(release_episodes(tmp_path))


def test_own_clouds_with_a_gripper_track(tmp_path):
    folder = make_clouds(tmp_path / "clouds")
    (tmp_path / "g.csv").write_text("t_s,x,y,z\n10.0,0,0,0\n10.1,0,0,.1\n10.2,0,0,.2\n10.4,0,0,.3\n")
    episode = cloud_folder(folder, gripper=tmp_path / "g.csv", meta={"fabric": "towel"})
    np.testing.assert_allclose(episode.times, [0, 0.1, 0.2, 0.4])
    np.testing.assert_allclose(episode.gripper[:, 2], [0, 0.1, 0.2, 0.3])
    assert cloud_folder(folder, rate_hz=5).times.tolist() == pytest.approx([0, 0.2, 0.4, 0.6])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y\n0,0\n", r"columns \['z'\] are missing"),
        ("x,y,z\n0,0,0\n", "1 rows for 4 clouds"),
        ("x,y,z\na,b,c\n0,0,0\n0,0,0\n0,0,0\n", "not a CSV of numbers"),
        ("x,y,z\n0,0,0\n0,0,300\n0,0,500\n0,0,800\n", "millimetres"),
        ("x,y,z\n0,0,0\n0,0,0\n0,0,0\n0,0,0\n", "times are unknown"),
    ],
)
def test_bad_gripper_files(tmp_path, text, message):
    folder = make_clouds(tmp_path / "clouds")
    (tmp_path / "g.csv").write_text(text)
    with pytest.raises(EpisodeError, match=message):
        cloud_folder(folder, gripper=tmp_path / "g.csv")


def test_a_folder_without_clouds(tmp_path):
    (tmp_path / "readme.txt").write_text("")
    with pytest.raises(EpisodeError, match="no numbered clouds"):
        cloud_folder(tmp_path, rate_hz=10)
