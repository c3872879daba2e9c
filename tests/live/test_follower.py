"""Following a raw episode while it is written."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.errors import DiffCloudError, EpisodeError
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.raw_episodes import CameraInfo, RawEpisodeWriter, RobotSample
from diffcloud.live.follower import Follower

LENS = Intrinsics(width=8, height=6, fx=10.0, fy=12.0, cx=3.5, cy=2.5)
POSE = np.array([[0.0, -1.0, 0.0, 0.3], [1.0, 0.0, 0.0, -0.2], [0.0, 0.0, 1.0, 0.5], [0.0, 0.0, 0.0, 1.0]])


def camera(name: str, pose: np.ndarray | None = POSE) -> CameraInfo:
    return CameraInfo(name, f"serial {name}", LENS, 0.001, T_world_camera=pose)


def depth(value: int) -> np.ndarray:
    image = np.zeros((6, 8), dtype=np.uint16)
    image[1, 2], image[4, 7] = value, 2 * value
    return image


def test_what_is_new_comes_once_and_lies_in_the_base_frame(tmp_path):
    folder = tmp_path / "episode"
    follower = Follower(folder)
    assert follower.newest() is None  # nothing is there yet
    with RawEpisodeWriter(
        folder, {"top": camera("top"), "side": camera("side")}, rate_hz=30, source="test", robot={}, joint_count=1
    ) as writer:
        assert follower.newest().clouds == {}
        color = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
        writer.add_frame("top", 0.1, depth(500), color)
        writer.add_robot(RobotSample(0.1, np.zeros(1), 0.5, np.array([0.1, 0.2, 0.3]), np.array([1.0, 0, 0, 0]), None))
        seen = follower.newest()
        assert seen.status == "recording"
        assert list(seen.clouds) == ["top"]
        cloud = seen.clouds["top"]
        assert (cloud.frame, cloud.t_s) == (0, 0.1)
        expected = []
        for row, column, z in ((1, 2, 0.5), (4, 7, 1.0)):  # pinhole, then the camera's pose
            x, y = (column - 3.5) / 10 * z, (row - 2.5) / 12 * z
            expected.append([0.3 - y, -0.2 + x, 0.5 + z])
        np.testing.assert_allclose(cloud.points, expected, atol=1e-12)
        np.testing.assert_array_equal(cloud.colors, [color[1, 2], color[4, 7]])
        np.testing.assert_allclose(seen.tool, [0.1, 0.2, 0.3])
        assert follower.newest() is None
        writer.add_frame("side", 0.12, depth(600))
        seen = follower.newest()
        assert seen.clouds["side"].colors is None
        assert len(seen.clouds) == 2
    assert follower.newest().status == "complete"
    assert follower.newest() is None


def test_large_images_are_thinned(tmp_path):
    with RawEpisodeWriter(tmp_path / "episode", {"top": camera("top")}, rate_hz=30, source="test") as writer:
        writer.add_frame("top", 0.1, np.full((6, 8), 700, dtype=np.uint16))
    assert len(Follower(tmp_path / "episode", points=12).newest().clouds["top"].points) == 12


def test_a_camera_without_a_pose_is_named(tmp_path):
    with RawEpisodeWriter(tmp_path / "episode", {"top": camera("top", None)}, rate_hz=30, source="test") as writer:
        writer.add_frame("top", 0.1, depth(500))
    with pytest.raises(EpisodeError, match="Camera top is not calibrated"):
        Follower(tmp_path / "episode").newest()


@pytest.mark.parametrize("file", ["episode.json", "cameras/top/timestamps.csv", "cameras/top/depth/000000.png"])
def test_a_damaged_file_is_named(tmp_path, file):
    with RawEpisodeWriter(tmp_path / "episode", {"top": camera("top")}, rate_hz=30, source="test") as writer:
        writer.add_frame("top", 0.1, depth(500))
    (tmp_path / "episode" / file).write_bytes(b"\x00\xff not this")
    with pytest.raises(DiffCloudError, match=file.rsplit("/", 1)[-1]):
        Follower(tmp_path / "episode").newest()
