"""Raw episodes: what is written comes back, a crash keeps what was finished, a full disk ends cleanly."""

from __future__ import annotations

import errno
import json
import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from diffcloud.errors import DiffCloudError, EpisodeError
from diffcloud.io import images, raw_episodes
from diffcloud.io.calibrations import Calibration, CameraCalibration, read_calibration, write_calibration
from diffcloud.io.camera_models import IntrinsicsFile
from diffcloud.io.images import read_color, read_depth, write_color, write_depth
from diffcloud.io.raw_episodes import CameraInfo, RawEpisode, RawEpisodeWriter, ScenePlacement, read_raw_episode
from diffcloud.io.recordings import RecordedFrame, Recording, write_recording
from tests.sensing.table_scene import INTRINSICS, camera_infos, poses, robot_sample, table_depth, write_table_episode


def test_images_come_back_bit_by_bit(tmp_path, rng):
    depth = rng.integers(0, 65536, (48, 64)).astype(np.uint16)
    color = rng.integers(0, 256, (48, 64, 3)).astype(np.uint8)
    write_depth(tmp_path / "d.png", depth)
    write_color(tmp_path / "c.png", color)
    np.testing.assert_array_equal(read_depth(tmp_path / "d.png"), depth)
    np.testing.assert_array_equal(read_color(tmp_path / "c.png"), color)
    with pytest.raises(EpisodeError, match="has 3 channels of 8 bits; depth is a 16-bit grey PNG"):
        read_depth(tmp_path / "c.png")


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_png_is_refused_wherever_it_ends(tmp_path, rng, keep):
    path = tmp_path / "d.png"
    write_depth(path, rng.integers(0, 65536, (48, 64)).astype(np.uint16))
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(EpisodeError, match=r"truncated|not a PNG"):
        read_depth(path)


def test_a_flipped_byte_is_refused(tmp_path, rng):
    path = tmp_path / "d.png"
    write_depth(path, rng.integers(0, 65536, (48, 64)).astype(np.uint16))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(EpisodeError, match="damaged"):
        read_depth(path)


def test_an_episode_comes_back(tmp_path):
    episode = read_raw_episode(write_table_episode(tmp_path / "e"))
    assert episode.description["status"] == "complete"
    assert episode.description["frames"] == {"overhead": 6, "side": 6}
    camera = episode.cameras["side"]
    assert camera.info.intrinsics == INTRINSICS
    np.testing.assert_allclose(camera.info.T_world_camera, poses()["side"])
    np.testing.assert_allclose(camera.times, np.arange(6) / 10)
    np.testing.assert_array_equal(camera.depth(3), table_depth(poses()["side"]))
    assert camera.color(3).shape == (120, 160, 3)
    sample = robot_sample(0.05)
    np.testing.assert_allclose(episode.robot.joints_rad[2], sample.joints_rad, rtol=1e-8)
    np.testing.assert_allclose(episode.robot.tool_quaternion[2], sample.tool_quaternion)
    assert episode.robot.gripper[2] == 0.8


def test_what_a_source_does_not_know_is_nan(tmp_path):
    infos = camera_infos()
    with RawEpisodeWriter(tmp_path / "e", infos, rate_hz=10, source="test", robot={}, joint_count=6) as writer:
        writer.add_robot(raw_episodes.RobotSample(0.0, np.zeros(6)))
        for name in infos:
            writer.add_frame(name, 0.0, np.ones((120, 160), np.uint16))
    episode = read_raw_episode(tmp_path / "e")
    assert episode.robot.joints_rad.shape == (1, 6)
    assert np.isnan(episode.robot.wrench).all()
    assert np.isnan(episode.robot.gripper).all()
    assert episode.cameras["side"].color(0) is None


def test_numbers_in_quotes_are_numbers_and_labels_of_ones_own_are_kept(tmp_path):
    folder = write_table_episode(tmp_path / "e", frames=1)
    good = json.loads((folder / "episode.json").read_text())
    (folder / "episode.json").write_text(json.dumps({**good, "rate_hz": "10", "repeat": "3", "mine": {"a": ["3"]}}))
    told = read_raw_episode(folder).description
    assert told == {**good, "rate_hz": 10.0, "repeat": 3, "mine": {"a": ["3"]}}


def test_episodes_are_never_overwritten(tmp_path):
    write_table_episode(tmp_path / "e", frames=1)
    with pytest.raises(EpisodeError, match="never overwritten"):
        write_table_episode(tmp_path / "e")
    with pytest.raises(EpisodeError, match="at least one camera"):
        RawEpisodeWriter(tmp_path / "f", {}, rate_hz=10, source="test")
    with pytest.raises(EpisodeError, match="plain word"):
        RawEpisodeWriter(tmp_path / "f", {"../x": camera_infos()["side"]}, rate_hz=10, source="test")


# in a process of its own, and without the imports that take seconds
CHILD = """
import os, resource, signal, sys
import numpy as np
from diffcloud.errors import DiffCloudError
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.raw_episodes import CameraInfo, RawEpisodeWriter, RobotSample
intrinsics = Intrinsics(160, 120, 154.0, 154.0, 79.5, 59.5)
infos = {"side": CameraInfo("side", "1", intrinsics, 0.001)}
rng = np.random.default_rng(0)
"""
KILLED = """
writer = RawEpisodeWriter(sys.argv[1], infos, rate_hz=10, source="test", robot={})
for frame in range(4):
    writer.add_robot(RobotSample(frame / 10, np.zeros(7)))
    writer.add_frame("side", frame / 10, np.full((120, 160), 500 + frame, np.uint16))
os.kill(os.getpid(), signal.SIGKILL)
"""
REFUSED = """
try:
    with RawEpisodeWriter(sys.argv[1], infos, rate_hz=10, source="test") as writer:
        for frame in range(6):
            if frame == 4:
                resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
            writer.add_frame("side", frame / 10, rng.integers(0, 65536, (120, 160)).astype(np.uint16))
except DiffCloudError as error:
    print(error)
    sys.exit(7)
"""


def child(code, folder):
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    return subprocess.run([sys.executable, "-c", CHILD + code, folder], env=env, capture_output=True, text=True)


def test_a_killed_capture_keeps_every_finished_frame(tmp_path):
    """And a power cut in the middle of a frame: an image without a row, a torn line, a temporary file."""
    done = child(KILLED, tmp_path / "e")
    assert done.returncode == -9, done.stderr
    side = tmp_path / "e" / "cameras" / "side"
    (side / "depth" / "000004.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (side / "depth" / ".000005.abc.png").write_bytes(b"")
    with (side / "timestamps.csv").open("a") as stream:
        stream.write("4,0.4")
    with (tmp_path / "e" / "robot.csv").open("a") as stream:
        stream.write("0.4,0.1,0.")
    episode = read_raw_episode(tmp_path / "e")
    assert episode.description["status"] == "recording"
    assert episode.cameras["side"].frames.tolist() == [0, 1, 2, 3]
    assert [int(episode.cameras["side"].depth(index)[0, 0]) for index in range(4)] == [500, 501, 502, 503]
    assert len(episode.robot.times) == 4


def test_what_every_frame_needs_is_on_the_disk_before_the_first(tmp_path, monkeypatch):
    """And the folder with the images' folders after it."""
    fsync, waited = os.fsync, set()
    monkeypatch.setattr(os, "fsync", lambda handle: (waited.add(os.fstat(handle).st_ino), fsync(handle)))
    folder, infos = tmp_path / "e", {"side": camera_infos()["side"]}
    writer = RawEpisodeWriter(folder, infos, rate_hz=10, source="test")
    for name in ("..", "", "episode.json", "cameras", "cameras/side", "cameras/side/camera.json"):
        assert (folder / name).stat().st_ino in waited, name
    waited.clear()
    writer.add_frame("side", 0.0, np.full((120, 160), 700, np.uint16))
    assert (folder / "cameras" / "side").stat().st_ino in waited
    writer.close()


def test_a_full_disk_ends_cleanly(tmp_path, monkeypatch):
    """The system refuses in the middle of a frame: the error counts what is kept, and no half file is left."""
    fsync, calls = os.fsync, []

    def full(handle):
        calls.append(handle)
        if len(calls) > 20:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", full)
    infos = {"side": camera_infos()["side"]}
    depth = np.full((120, 160), 700, np.uint16)

    def record():
        with RawEpisodeWriter(tmp_path / "e", infos, rate_hz=10, source="test") as writer:
            for frame in range(50):
                writer.add_frame("side", frame / 10, depth)

    with pytest.raises(
        DiffCloudError, match=r"Frame \d+ of camera side.*No space left on device.*\d+ frames before it are kept"
    ):
        record()
    episode = read_raw_episode(tmp_path / "e")
    count = len(episode.cameras["side"].frames)
    assert 3 <= count < 50
    assert episode.description["status"] == "stopped"
    assert "No space left" in episode.description["stop_reason"]
    for index in range(count):
        np.testing.assert_array_equal(episode.cameras["side"].depth(index), depth)
    assert not list((tmp_path / "e").rglob(".*"))


def test_of_an_import_nothing_is_said_to_be_kept(tmp_path, monkeypatch):
    """Its folder is temporary, and goes."""
    written = raw_episodes.write_depth

    def full(path, depth, **options):
        if path.name == "000002.png":
            raise OSError(errno.ENOSPC, "No space left on device")
        written(path, depth, **options)

    monkeypatch.setattr(raw_episodes, "write_depth", full)
    frames = [RecordedFrame("side", float(index), np.ones((120, 160), np.uint16)) for index in range(4)]
    recording = Recording({"side": camera_infos()["side"]}, frames, "test")
    with pytest.raises(DiffCloudError, match="Frame 2 of camera side could not be written") as caught:
        write_recording(tmp_path / "e", recording)
    assert "kept" not in str(caught.value)
    assert not any(tmp_path.iterdir())


def test_a_write_the_kernel_refuses_keeps_what_is_there(tmp_path):
    """The same by a true limit of the operating system (on the size of a file), where a full disk cannot be had."""
    done = child(REFUSED, tmp_path / "e")
    assert done.returncode == 7, done.stderr
    assert "The 4 frames before it are kept" in done.stdout
    assert len(read_raw_episode(tmp_path / "e").cameras["side"].frames) == 4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fx": 0.6}, "does not go with"),
        ({"cx": 700.0}, "principal point"),
        ({"distortion": "fisheye"}, "Input should be 'none', 'brown_conrady'"),
        ({"coefficients": [0.1], "distortion": "brown_conrady"}, "5, 8, 12, 14 coefficients"),
        ({"f": 1}, "f\n  Extra inputs"),
    ],
)
def test_bad_intrinsics(changes, message):
    with pytest.raises(ValidationError, match=message):
        IntrinsicsFile.model_validate({**INTRINSICS.to_json(), **changes})


def test_cameras_that_no_camera_is(tmp_path):
    folder = write_table_episode(tmp_path / "e", frames=1)
    path = folder / "cameras" / "side" / "camera.json"
    good = json.loads(path.read_text())
    for changes, message in (
        ({"depth_scale_m": 1.0}, "metres per unit"),
        ({"T_world_camera": np.eye(3).tolist()}, "4 x 4 numbers"),
        ({"T_world_camera": np.diag([1, 1, -1, 1]).tolist()}, "not a rigid transform"),
        ({"T_world_camera": (np.eye(4) + 700 * np.eye(4, k=3)).tolist()}, "give metres"),
    ):
        path.write_text(json.dumps({**good, **changes}))
        with pytest.raises(EpisodeError, match=message):
            read_raw_episode(folder)


def test_calibrations_come_back_and_know_their_cameras(tmp_path):
    cameras = {
        serial: CameraCalibration(serial, INTRINSICS, pose, np.eye(6) * 1e-6, name, {"rms_px": 0.2})
        for serial, (name, pose) in zip(("1", "2"), poses().items(), strict=True)
    }
    write_calibration(tmp_path / "c.json", Calibration(cameras, "charuco", {"columns": 5}))
    again = read_calibration(tmp_path / "c.json")
    np.testing.assert_allclose(again.camera("2").T_world_camera, poses()["side"])
    np.testing.assert_allclose(again.camera("2").covariance, np.eye(6) * 1e-6)
    with pytest.raises(DiffCloudError, match=r"no camera side \(serial 3\); it holds 1 \(overhead\), 2 \(side\)"):
        again.camera("3", name="side")
    (tmp_path / "c.json").write_text("{}")
    with pytest.raises(DiffCloudError, match="schema_version: Field required"):
        read_calibration(tmp_path / "c.json")


def test_jpeg_is_never_depth():
    with pytest.raises(EpisodeError, match="JPEG changes depth by centimetres"):
        images.decode_depth(b"\xff\xd8\xff\xe0rest", "x.png")
    with pytest.raises(EpisodeError, match="uint16"):
        write_depth("x.png", np.zeros((3, 3)))
    assert isinstance(CameraInfo("a", "1", INTRINSICS, 0.001).to_json(), dict)


def test_the_size_of_a_jpeg_is_known_before_it_is_unpacked(rng):
    color = rng.integers(0, 256, (48, 64, 3)).astype(np.uint8)
    data = images.encode_jpeg(color, width=64)
    assert images.decode_color(data, "x.jpg").shape == (48, 64, 3)
    place = data.index(b"\xff\xc0") + 5
    huge = data[:place] + struct.pack(">HH", 65500, 65500) + data[place + 4 :]
    with pytest.raises(EpisodeError, match=r"x\.jpg claims 65500 x 65500 pixels"):
        images.decode_color(huge, "x.jpg")
    for sizeless in (b"\xff\xd8\xff\xe0rest", data[:2] + data[data.index(b"\xff\xda") :], data[: place + 3]):
        with pytest.raises(EpisodeError, match="states no size before its pixels"):
            images.decode_color(sizeless, "x.jpg")


def test_what_opencv_refuses_is_named(monkeypatch):
    import cv2

    def refuse(*_):
        raise cv2.error("too many pixels")

    monkeypatch.setattr(cv2, "imdecode", refuse)
    with pytest.raises(EpisodeError, match=r"x\.jpg is not a readable image: too many pixels"):
        images.decode_color(images.encode_jpeg(np.zeros((8, 8, 3), np.uint8), width=8), "x.jpg")


def test_where_the_scene_lies(tmp_path):
    def placed(stated: object) -> ScenePlacement:
        return RawEpisode(tmp_path, {} if stated is None else {"scene_in_world": stated}, {}, None).placement

    assert placed(None) == ScenePlacement()
    placement = placed({"origin_m": [0.5, 0.1, 0.0], "yaw_rad": 0.3, "length_unit_m": 0.35})
    points = np.arange(12.0).reshape(4, 3)
    np.testing.assert_allclose(placement.to_scene(placement.to_world(points)), points, atol=1e-12)
    np.testing.assert_allclose(placement.to_world(np.zeros(3)), [0.5, 0.1, 0.0])
    folder = write_table_episode(tmp_path / "e", frames=1)
    path = folder / "episode.json"
    good = json.loads(path.read_text())
    for damaged in ("here", {"origin_m": [0, 0]}, {"yaw_rad": "east"}, {"length_unit_m": 0}, {"unit": 1}):
        path.write_text(json.dumps({**good, "scene_in_world": damaged}))
        with pytest.raises(EpisodeError, match="scene_in_world"):
            read_raw_episode(folder)
