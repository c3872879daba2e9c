"""Importing the published layout and folders of clouds."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.errors import EpisodeError
from diffcloud.io.clouds import read_cloud
from diffcloud.io.episodes import read_episode, write_episode
from diffcloud.io.grippers import named_files
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
    assert lift.meta["predictions"] == {"mlp": {"stretching": 5.0, "density": -1.0}}
    assert band.meta["truth"] == {"stretching": 0.5, "density": 5.0}


def test_missing_frames_and_folders(tmp_path):
    with pytest.raises(EpisodeError, match="holds none of lift_real_pcls"):
        list(release_episodes(tmp_path))
    folder = make_clouds(tmp_path / "lift_real_pcls" / "lift_tan")
    (folder / "001.npy").unlink()
    with pytest.raises(EpisodeError, match=r"frames \[1\] are missing between 0 and 3"):
        list(release_episodes(tmp_path))


@pytest.mark.parametrize("kept", [20, 99])
def test_a_text_ply_that_was_cut_off_is_refused(tmp_path, kept):
    head = "ply\nformat ascii 1.0\nelement vertex 100\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    rows = [f"{0.01 * index} 0.0 0.0\n" for index in range(100)]
    path = tmp_path / "000.ply"
    path.write_text(head + "".join(rows))
    assert len(read_cloud(path)) == 100
    path.write_text(head + "".join(rows[:kept]))
    with pytest.raises(EpisodeError, match=f"states 100 points and holds {kept}"):
        read_cloud(path)


def test_own_clouds_with_a_gripper_track(tmp_path):
    folder = make_clouds(tmp_path / "clouds")
    (tmp_path / "g.csv").write_text("t_s,x,y,z\n10.0,0,0,0\n10.1,0,0,.1\n10.2,0,0,.2\n10.4,0,0,.3\n")
    episode = cloud_folder(folder, grippers={"any": tmp_path / "g.csv"}, meta={"fabric": "towel"})
    np.testing.assert_allclose(episode.times, [0, 0.1, 0.2, 0.4])
    np.testing.assert_allclose(episode.gripper[:, 0, 2], [0, 0.1, 0.2, 0.3])
    assert cloud_folder(folder, rate_hz=5).times.tolist() == pytest.approx([0, 0.2, 0.4, 0.6])


class TestSeveralGrippers:
    """In one file, or one each."""

    ONE = "t_s,x,y,z\n0,0,0,0\n.1,0,0,.1\n.2,0,0,.2\n.3,0,0,.3\n"
    OTHER = "t_s,x,y,z\n0,1,0,0\n.1,1,.1,0\n.2,1,.2,0\n.3,1,.3,0\n"

    def test_one_file_with_a_column_is_as_one_file_each(self, tmp_path):
        folder = make_clouds(tmp_path / "clouds")
        rows = zip(self.ONE.split()[1:], self.OTHER.split()[1:], strict=True)
        both = "".join(f"left,{one}\nright,{other}\n" for one, other in rows)
        (tmp_path / "both.csv").write_text("gripper,t_s,x,y,z\n" + both)
        (tmp_path / "one.csv").write_text(self.ONE)
        (tmp_path / "other.csv").write_text(self.OTHER)
        together = cloud_folder(folder, grippers={"any": tmp_path / "both.csv"})
        apart = cloud_folder(folder, grippers={"left": tmp_path / "one.csv", "right": tmp_path / "other.csv"})
        assert together.grippers == apart.grippers == ("left", "right")
        np.testing.assert_allclose(together.gripper[:, 0, 2], [0, 0.1, 0.2, 0.3])
        np.testing.assert_allclose(together.gripper[:, 1], [[1, 0, 0], [1, 0.1, 0], [1, 0.2, 0], [1, 0.3, 0]])
        np.testing.assert_array_equal(together.gripper, apart.gripper)
        np.testing.assert_allclose(together.times, [0, 0.1, 0.2, 0.3])
        write_episode(tmp_path / "e.npz", apart)
        again = read_episode(tmp_path / "e.npz")
        assert again.grippers == ("left", "right")
        np.testing.assert_array_equal(again.gripper, apart.gripper)

    @pytest.mark.parametrize(
        ("other", "message"),
        [
            ("t_s,x,y,z\n0,1,0,0\n.1,1,0,0\n.2,1,0,0\n", "gripper 'right' has 3 rows for 4 clouds"),
            ("t_s,x,y,z\n0,1,0,0\n.1,1,0,0\n.2,1,0,0\n.4,1,0,0\n", "times differ"),
            ("gripper,x,y,z\na,1,0,0\na,1,0,0\na,1,0,0\na,1,0,0\n", "holds all grippers"),
        ],
    )
    def test_files_that_do_not_fit(self, tmp_path, other, message):
        folder = make_clouds(tmp_path / "clouds")
        (tmp_path / "one.csv").write_text(self.ONE)
        (tmp_path / "other.csv").write_text(other)
        with pytest.raises(EpisodeError, match=message):
            cloud_folder(folder, grippers={"left": tmp_path / "one.csv", "right": tmp_path / "other.csv"})

    def test_a_gripper_that_is_missing_in_a_frame(self, tmp_path):
        folder = make_clouds(tmp_path / "clouds")
        (tmp_path / "both.csv").write_text("gripper,x,y,z\n" + 4 * "left,0,0,0\n" + 3 * "right,0,0,0\n")
        with pytest.raises(EpisodeError, match="gripper 'right' has 3 rows for 4 clouds"):
            cloud_folder(folder, grippers={"any": tmp_path / "both.csv"}, rate_hz=10)

    @pytest.mark.parametrize("given", [["a.csv", "b.csv"], ["left=a.csv", "left=b.csv"], ["=a.csv"], ["left="]])
    def test_names(self, given):
        with pytest.raises(EpisodeError, match="NAME=PATH, each name once"):
            named_files(given)


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
        cloud_folder(folder, grippers={"any": tmp_path / "g.csv"})


def test_empty_clouds_are_counted(tmp_path):
    for index in range(9):
        np.save(tmp_path / f"{index}.npy", np.zeros((index // 7, 3)))
    with pytest.raises(EpisodeError, match=r"7 of 9 clouds are empty \(frames 0, 1, 2, 3, 4 and more\).*lower the height"):
        cloud_folder(tmp_path, rate_hz=10.0)


def test_a_folder_without_clouds(tmp_path):
    (tmp_path / "readme.txt").write_text("")
    with pytest.raises(EpisodeError, match="no numbered clouds"):
        cloud_folder(tmp_path, rate_hz=10)
