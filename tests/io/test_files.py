"""Writing never leaves half a file; pickles cannot run code; episodes and clouds say what is wrong."""

from __future__ import annotations

import errno
import json
import os
import pickle

import numpy as np
import pytest

from diffcloud.errors import DiffCloudError, EpisodeError
from diffcloud.io.clouds import import_open3d, read_cloud, write_ply
from diffcloud.io.episodes import Episode, read_episode, write_episode
from diffcloud.io.files import atomic, read_json, write_json, write_text
from diffcloud.io.pickles import load_npy


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def write_half(target, error):
    with atomic(target) as stream:
        stream.write(b"half of the n")
        raise error


class TestAtomicWrites:
    def test_an_interrupted_write_keeps_the_former_file(self, tmp_path):
        target = tmp_path / "a.txt"
        write_text(target, "old")
        with pytest.raises(KeyboardInterrupt):
            write_half(target, KeyboardInterrupt())
        assert target.read_text() == "old"
        assert names(tmp_path) == ["a.txt"]

    def test_a_full_disk_is_a_clear_error_and_leaves_nothing(self, tmp_path):
        target = tmp_path / "a.txt"
        with pytest.raises(DiffCloudError, match=r"Cannot write .*a\.txt: No space left"):
            write_half(target, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
        assert names(tmp_path) == []

    def test_episode_writing_on_a_full_disk(self, tmp_path, monkeypatch):
        def full(*args, **kwargs):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr(np, "savez_compressed", full)
        with pytest.raises(DiffCloudError, match="No space left"):
            write_episode(tmp_path / "e.npz", episode())
        assert names(tmp_path) == []

    def test_nan_is_not_written_to_json(self, tmp_path):
        with pytest.raises(ValueError, match="JSON"):
            write_json(tmp_path / "a.json", {"x": float("nan")})
        assert names(tmp_path) == []

    def test_damaged_json_is_named(self, tmp_path):
        (tmp_path / "a.json").write_text("{")
        with pytest.raises(DiffCloudError, match=r"a\.json is not readable JSON"):
            read_json(tmp_path / "a.json")


class _Evil:
    def __reduce__(self):
        return (os.system, ("touch /tmp/diffcloud-was-here",))


class TestPickles:
    def test_plain_containers_and_arrays_are_read(self, tmp_path):
        value = {"0": np.array([1.0, 2.0]), "list": [1, "a", (2.5, None)], "scalar": np.float32(3)}
        np.save(tmp_path / "a.npy", np.array(value, dtype=object), allow_pickle=True)
        found = load_npy(tmp_path / "a.npy")
        assert found["list"] == value["list"]
        assert found["scalar"] == 3
        np.testing.assert_array_equal(found["0"], value["0"])

    @pytest.mark.parametrize("payload", [_Evil(), {"a": [_Evil()]}, pytest, print, np.load])
    def test_code_is_refused_and_not_run(self, tmp_path, payload):
        marker = "/tmp/diffcloud-was-here"
        header = np.array(None, dtype=object)
        with (tmp_path / "evil.npy").open("wb") as stream:
            np.lib.format.write_array_header_1_0(stream, np.lib.format.header_data_from_array_1_0(header))
            try:
                stream.write(pickle.dumps(payload))
            except TypeError:
                stream.write(b"cos\nsystem\n(S'touch " + marker.encode() + b"'\ntR.")
        with pytest.raises(EpisodeError, match=r"evil\.npy.*only plain containers|damaged pickle"):
            load_npy(tmp_path / "evil.npy")
        assert not os.path.exists(marker)

    @pytest.mark.parametrize("data", [b"", b"not numpy", b"\x93NUMPY\x01\x00"])
    def test_damaged_files(self, tmp_path, data):
        (tmp_path / "d.npy").write_bytes(data)
        with pytest.raises(EpisodeError, match=r"d\.npy"):
            load_npy(tmp_path / "d.npy")

    def test_truncated_pickle(self, tmp_path):
        np.save(tmp_path / "t.npy", np.array({"a": np.zeros(50)}, dtype=object), allow_pickle=True)
        data = (tmp_path / "t.npy").read_bytes()
        (tmp_path / "t.npy").write_bytes(data[:-40])
        with pytest.raises(EpisodeError, match="damaged"):
            load_npy(tmp_path / "t.npy")


def episode(**changes):
    frames = [np.full((3, 3), index, dtype=np.float32) for index in range(4)]
    made = Episode.from_frames(frames, np.arange(4) * 0.1, gripper=np.zeros((4, 3)), meta={"fabric": "navy"})
    from dataclasses import replace

    return replace(made, **changes) if changes else made


class TestEpisodes:
    def test_round_trip_and_same_bytes(self, tmp_path):
        made = episode(camera=np.zeros(12, np.uint8), pixel=np.ones((12, 2), np.uint16), sigma=np.ones(12, np.float32))
        write_episode(tmp_path / "a.npz", made)
        write_episode(tmp_path / "b.npz", made)
        assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
        again = read_episode(tmp_path / "a.npz")
        for name in ("points", "offsets", "times", "gripper", "camera", "pixel", "sigma"):
            np.testing.assert_array_equal(getattr(again, name), getattr(made, name))
        assert again.meta == {"fabric": "navy"}
        np.testing.assert_array_equal(again.frame(-1), np.full((3, 3), 3))

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"points": np.zeros((12, 2), np.float32)}, r"shape \[points, 3\]"),
            ({"points": np.full((12, 3), np.nan, np.float32)}, "Frame 0 holds NaN"),
            ({"offsets": np.array([0, 3, 3, 6, 12])}, "Frame 1 is empty"),
            ({"offsets": np.array([0, 3, 12])}, "offsets"),
            ({"times": np.array([0.0, 0.2, 0.1, 0.3])}, "increase"),
            ({"gripper": np.zeros((3, 3))}, "gripper"),
            ({"sigma": np.zeros(5, np.float32)}, "sigma"),
        ],
    )
    def test_bad_content_is_named(self, changes, message):
        with pytest.raises(EpisodeError, match=message):
            episode(**changes)

    def test_missing_frame_says_how_many_there_are(self):
        with pytest.raises(EpisodeError, match="Frame 24 is missing: the episode has 4 frames"):
            episode().frame(24)

    def test_damaged_and_foreign_files(self, tmp_path):
        path = tmp_path / "x.npz"
        with pytest.raises(EpisodeError, match="No such episode"):
            read_episode(path)
        path.write_bytes(b"PK\x03\x04 nothing")
        with pytest.raises(EpisodeError, match=r"x\.npz is not a readable episode"):
            read_episode(path)
        np.savez(path, a=np.zeros(3))
        with pytest.raises(EpisodeError, match="has the fields"):
            read_episode(path)
        np.savez(path, points=np.zeros((1, 3)), offsets=[0, 1], times=[0.0], meta=np.array({"a": 1}, dtype=object))
        with pytest.raises(EpisodeError, match=r"x\.npz"):
            read_episode(path)
        np.savez(path, points=np.zeros((1, 3), "U3"), offsets=[0, 1], times=[0.0], meta=json.dumps({}))
        with pytest.raises(EpisodeError, match="wrong type"):
            read_episode(path)


class TestClouds:
    def test_every_format_gives_the_same_points(self, tmp_path, rng):
        points = rng.normal(size=(50, 3)).astype(np.float32)
        np.save(tmp_path / "a.npy", points)
        write_ply(tmp_path / "a.ply", points)
        np.savetxt(tmp_path / "a.xyz", np.column_stack([points, rng.random((50, 3))]))
        header = (
            "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 50\nHEIGHT 1\nPOINTS 50\nDATA ascii\n"
        )
        (tmp_path / "a.pcd").write_text(header + "\n".join(" ".join(map(str, p)) for p in points) + "\n")
        for suffix in ("npy", "ply", "xyz"):
            np.testing.assert_allclose(read_cloud(tmp_path / f"a.{suffix}"), points, atol=1e-6, err_msg=suffix)
        try:
            import_open3d()
        except EpisodeError as error:  # a bare machine lacks system libraries of open3d; CI installs them
            pytest.skip(f"PCD was not read: {error}")
        np.testing.assert_allclose(read_cloud(tmp_path / "a.pcd"), points, atol=1e-6)

    @pytest.mark.parametrize(
        ("array", "message"),
        [
            (np.zeros((0, 3)), "empty cloud"),
            (np.zeros((5, 2)), "shape"),
            (np.full((5, 3), np.inf), "5 NaN or infinite"),
            (np.array(["a"]), "numbers"),
        ],
    )
    def test_bad_clouds(self, tmp_path, array, message):
        np.save(tmp_path / "c.npy", array)
        with pytest.raises(EpisodeError, match=message):
            read_cloud(tmp_path / "c.npy")

    def test_bad_files(self, tmp_path):
        (tmp_path / "c.ply").write_text("ply\nnonsense\n")
        (tmp_path / "c.xyz").write_text("1 2 three\n")
        (tmp_path / "c.abc").write_text("")
        for name, message in (("c.ply", "not a readable PLY"), ("c.xyz", "not a readable XYZ"), ("c.abc", "unknown cloud")):
            with pytest.raises(EpisodeError, match=message):
                read_cloud(tmp_path / name)
