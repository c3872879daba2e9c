"""`diffcloud import`: which kind of source it finds, and which options it takes of each."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from diffcloud.errors import ConfigError
from diffcloud.io.episodes import read_episode
from diffcloud.io.files import write_json
from diffcloud.io.raw_episodes import read_raw_episode
from diffcloud.io.ros.joints import GRIPPER_CLOSED_RAD, GRIPPER_JOINT
from diffcloud.jobs.imports import _KINDS, _OF, source_kind
from tests.cli.invoke import invoke
from tests.docs.site import reference
from tests.io.ros_bag import bag
from tests.io.ros_clouds import CloudBag
from tests.io.test_imports import make_clouds, make_release
from tests.sensing.table_scene import write_table_episode

VALUES = {
    "--gripper": "g.csv", "--camera": "side=1,0,0", "--rate-hz": 10, "--label": "fabric=tan", "--joint-log": "log.csv",
    "--clock-offset": 1, "--world-frame": "map", "--tool-frame": "tool", "--joints": "a,b", "--gripper-joint": "none",
    "--topic": "/tf", "--urdf": "arm.urdf", "--trajectories": "trajs", "--transform": "camera.txt", "--crop": "0,0,0:1,1,1",
}  # fmt: skip


def make(kind, folder):
    """A source of a kind."""
    match kind:
        case "clouds":
            return make_clouds(folder / "clouds", suffix="npy")
        case "release":
            return make_release(folder / "pysim")
        case "ros":
            return bag(folder, "rosbag2")
        case "ros_clouds":
            CloudBag(folder / "bag").write()
            return folder / "bag"
        case "realsense":
            (folder / "side.db3").write_bytes(b"SQLite format 3\x00" + b"/device_0/sensor_0/Depth_0")
            return folder / "side.db3"
        case "folder":
            episode = write_table_episode(folder / "made", frames=2)
            return shutil.copytree(episode / "cameras" / "side", folder / "side")


@pytest.mark.parametrize("kind", _KINDS)
def test_the_kind_is_found(tmp_path, kind):
    assert source_kind([make(kind, tmp_path)]) == kind


@pytest.mark.parametrize(("stated", "found"), [("clouds", "clouds"), ("release", "release"), ("recording", "folder")])
def test_the_kind_that_is_stated_counts(tmp_path, stated, found):
    """A folder that has signs of all three."""
    folder = make("clouds", tmp_path)
    (folder / "depth").mkdir()
    (folder / "lift_real_pcls").mkdir()
    with pytest.raises(ConfigError, match="looks like several kinds: release, recording, clouds"):
        source_kind([folder])
    assert source_kind([folder], stated) == found


@pytest.mark.parametrize("kind", _KINDS)
@pytest.mark.parametrize("option", _OF)
def test_options_of_other_kinds_are_refused(tmp_path, kind, option):
    if kind in _OF[option]:
        return
    said = invoke("data", "import", make(kind, tmp_path), option, VALUES[option], "--out", tmp_path / "out", code=1).errors
    assert f"{option} belongs to {_KINDS[_OF[option][0]]}" in said
    assert f"is {_KINDS[kind]}. Leave {option} out. If the kind is wrong, name the right one with --kind" in said
    assert not (tmp_path / "out").exists()


def test_every_option_has_its_kinds():
    options = {option for parameter in reference.commands()["data", "import"].params for option in parameter.opts}
    assert options - {"source", "--out", "--kind", "--json"} == set(_OF) == set(VALUES)
    assert len(options - {"source"}) == 18


def test_the_gripper_that_the_help_states_is_the_default():
    (option,) = (one for one in reference.commands()["data", "import"].params if one.name == "gripper_joint")
    assert f"Default: {GRIPPER_JOINT},0,{GRIPPER_CLOSED_RAD}." in option.help


@pytest.mark.parametrize("text", ["", "a,0", "a,0,1,2", "a,open,closed", "none,0,1", ",0,1"])
def test_a_gripper_joint_that_is_none(tmp_path, text):
    said = invoke("data", "import", make("ros", tmp_path), "--gripper-joint", text, "--out", tmp_path / "e", code=1).errors
    assert "--gripper-joint takes NAME, or NAME,OPEN,CLOSED" in said


@pytest.mark.parametrize("given", [("joint_1,joint_2,joint_3",), ("joint_1", "joint_2, joint_3")])
def test_joints_are_named_with_commas_or_one_by_one(tmp_path, given):
    options = [word for names in given for word in ("--joints", names)]
    source = make("ros", tmp_path)
    invoke("data", "import", source, *options, "--out", tmp_path / "e")
    assert read_raw_episode(tmp_path / "e").robot.joints_rad.shape[1] == 3
    said = invoke("data", "import", source, "--joints", "a,,b", "--out", tmp_path / "f", code=1).errors
    assert "--joints takes NAME,NAME,..., got 'a,,b'" in said


class TestRefused:
    def refused(self, *arguments):
        return invoke("data", "import", *arguments, "--out", "nowhere", code=1).errors

    def test_what_is_nothing_of_these(self, tmp_path):
        (tmp_path / "empty").mkdir()
        assert "No such recording" in self.refused(tmp_path / "absent")
        assert "holds nothing that can be imported. A folder holds clouds (.npy" in self.refused(tmp_path / "empty")
        assert "is a raw episode already" in self.refused(write_table_episode(tmp_path / "raw", frames=2))
        (tmp_path / "x.txt").write_text("")
        assert "unknown kind of recording" in self.refused(tmp_path / "x.txt")
        write_json(tmp_path / "set" / "meta" / "info.json", {})
        assert "is a LeRobot data set" in self.refused(tmp_path / "set")

    def test_a_single_cloud(self, tmp_path):
        folder = make("clouds", tmp_path)
        assert f"is a single cloud. Give the folder with one cloud per frame: {folder}" in self.refused(folder / "000.npy")

    def test_several_folders_of_clouds(self, tmp_path):
        folders = [make("clouds", tmp_path / name) for name in "ab"]
        named = [f"{name}={folder}" for name, folder in zip("ab", folders, strict=True)]
        assert "2 sources are given. Of a folder of clouds, an import takes one" in self.refused(*named)
        assert "only recordings of several cameras have names" in self.refused(named[0])

    def test_a_mixture(self, tmp_path):
        said = self.refused(make("clouds", tmp_path), make("folder", tmp_path))
        assert "The sources are of several kinds" in said

    def test_an_offset_without_a_log(self, tmp_path):
        said = self.refused(make("folder", tmp_path), "--clock-offset", 1)
        assert "--clock-offset shifts the times of a joint log, and none is given" in said

    def test_a_label_that_would_be_a_fact(self, tmp_path):
        said = self.refused(make("clouds", tmp_path), "--rate-hz", 10, "--label", "viewpoints=side")
        assert "episodes keep a fact under the name 'viewpoints'" in said


def test_labels_go_into_the_episode(tmp_path):
    labels = ("--label", "fabric=tan", "--label", "operator=Ada Lovelace")
    done = invoke("data", "import", make("clouds", tmp_path), "--rate-hz", 10, *labels, "--out", tmp_path / "e.npz")
    assert done.result["kind"] == "clouds"
    meta = read_episode(tmp_path / "e.npz").meta
    assert (meta["fabric"], meta["operator"]) == ("tan", "Ada Lovelace")
    np.testing.assert_allclose(read_episode(tmp_path / "e.npz").times, np.arange(4) / 10)
    done = invoke(
        "data", "import", make("folder", tmp_path), *labels, "--label", "scenario=lift", "--out", tmp_path / "raw"
    )
    assert done.result["kind"] == "folder"
    told = read_raw_episode(tmp_path / "raw").description
    assert (told["scenario"], told["fabric"], told["operator"]) == ("lift", "tan", "Ada Lovelace")
