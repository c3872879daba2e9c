"""Simulated sets on disk: exact round trips, the same bytes, and errors that say what is wrong."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from diffcloud.errors import DatasetError
from diffcloud.io.simulated import SimulatedSet, simulated_files, write_simulated
from diffcloud.mesh.topology import SurfaceMesh
from tests.conftest import flat_set


def write(folder, **changes):
    train = replace(flat_set(runs=4), **changes)
    test = replace(train, parameters=train.parameters[:2] * 0.5, nodes=train.nodes[:2])
    write_simulated(folder, {"train": train, "test": test}, about={"draws": "uniform"}, replaced="split,run\n")
    return train, test


@pytest.fixture
def folder(tmp_path):
    write(tmp_path / "set")
    return tmp_path / "set"


def assert_equal(read: SimulatedSet, written: SimulatedSet) -> None:
    for name in ("scenario", "names", "loss_frame", "first_frame", "length_unit_m"):
        assert getattr(read, name) == getattr(written, name)
    for name in ("bounds", "parameters", "nodes", "times", "faces"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name), strict=True)
    assert (read.loss_faces is None) == (written.loss_faces is None)
    assert (read.obstacle is None) == (written.obstacle is None)


def test_what_is_written_is_read(tmp_path):
    body = SurfaceMesh(np.eye(3), np.array([[0, 1, 2]]))
    for changes in ({}, {"loss_faces": np.array([1, 3]), "obstacle": body, "first_frame": 1, "length_unit_m": 0.35}):
        train, test = write(tmp_path / "set", **changes)
        assert_equal(SimulatedSet.read(tmp_path / "set", "train"), train)
        read = SimulatedSet.read(tmp_path / "set", "test")
        assert_equal(read, test)
    assert read.loss_faces.tolist() == [1, 3]
    np.testing.assert_array_equal(read.obstacle.nodes, body.nodes)
    np.testing.assert_array_equal(read.obstacle.faces, body.faces)


def test_numbers_in_quotes_are_numbers(folder):
    """As tools write them that know only text; what else a file says is kept."""
    good = SimulatedSet.read(folder, "train")
    for key, value in (("train", "4"), ("loss_frame", str(good.loss_frame)), ("length_unit_m", str(good.length_unit_m))):
        changed(key, value)(folder)
    changed("mine", {"a": ["3"]})(folder)
    assert_equal(SimulatedSet.read(folder, "train"), good)
    assert simulated_files(folder)


def test_the_same_set_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        write(tmp_path / name)
    for path in sorted((tmp_path / "a").iterdir()):
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def changed(key, value):
    def change(folder):
        about = json.loads((folder / "set.json").read_text())
        about[key] = value
        (folder / "set.json").write_text(json.dumps(about))

    return change


def saved(array):
    return lambda folder: np.save(folder / "train_nodes.npy", array, allow_pickle=True)


def cut(name, keep=100):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:keep])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "set.json").unlink(), "holds no simulated set"),
        (lambda folder: (folder / "set.json").write_text("{"), "set.json is not readable JSON"),
        (lambda folder: (folder / "set.json").write_text("[]"), "is no simulated set"),
        (changed("schema", 9), "schema 9; this version reads 1"),
        (changed("parameters", [{"name": "density"}]), "parameters.0.low: Field required"),
        (changed("loss_frame", 99), r"loss_frame must be one of the frames 0..1, got 99"),
        (changed("train", 0), "no train runs"),
        (lambda folder: (folder / "train_nodes.npy").unlink(), "No such file of node trajectories"),
        (cut("train_nodes.npy"), "train_nodes.npy is not a readable file of node trajectories"),
        (cut("surface.npz"), "surface.npz is not a readable surface"),
        (cut("train.csv"), "Parameters|parameters must have shape|not a table|train.csv has"),
        (lambda folder: (folder / "train.csv").write_text("run,stretching\n0,1\n"), "columns stretching, density"),
        (saved(np.zeros(3)), "expected float32, got float64"),
        (saved(np.zeros((4, 2, 2, 3), np.float32)), "faces must hold indices"),
        (saved(np.full((4, 2, 20, 3), np.nan, np.float32)), "nodes holds NaN"),
        (saved(np.array([{}])), "not a readable file of node trajectories"),
    ],
)  # fmt: skip
def test_damage_is_named(folder, damage, message):
    damage(folder)
    with pytest.raises(DatasetError, match=message):
        SimulatedSet.read(folder, "train")


def test_values_outside_their_bounds_are_refused():
    with pytest.raises(DatasetError, match="lie in their bounds"):
        replace(flat_set(), bounds=np.array([[5.0, 6.0], [5.0, 6.0]]))


def test_unknown_splits_are_refused(folder):
    with pytest.raises(DatasetError, match="Unknown split 'validation'"):
        SimulatedSet.read(folder, "validation")
