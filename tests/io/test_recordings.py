"""Recordings of other tools become raw episodes: ROS bags of both kinds, MCAP, RealSense files, folders of PNG."""

from __future__ import annotations

import json
import shutil
import time

import numpy as np
import pytest

from diffcloud.errors import EpisodeError, HardwareError
from diffcloud.io.files import claimed, write_json
from diffcloud.io.images import write_color
from diffcloud.io.raw_episodes import CameraInfo, read_raw_episode
from diffcloud.io.recordings import RecordedFrame, Recording, read_joint_log, write_recording
from diffcloud.sensing.validation.episode import validate_raw_episode
from tests.cli.invoke import invoke
from tests.io.ros_bag import FRAMES, START, TOOL, bag
from tests.sensing.table_scene import HOME_RAD, INTRINSICS, poses, table_depth, write_table_episode


def test_a_log_of_the_time_of_day_is_shifted_to_a_recording_from_zero(tmp_path):
    folders, log = as_folders(tmp_path)
    rows = log.read_text().splitlines()
    late = [f"{START + float(row.split(',')[0])},{row.split(',', 1)[1]}" for row in rows[1:]]
    log.write_text("\n".join([rows[0], *late]) + "\n")
    options = ("--out", tmp_path / "e", "--rate-hz", 10, "--joint-log", log)
    (folders[0] / "timestamps.csv").unlink()
    assert "different clocks" in invoke("data", "import", folders[0], *options, code=1).errors
    invoke("data", "import", folders[0], *options, f"--clock-offset={-START}")
    times = read_raw_episode(tmp_path / "e").robot.times
    np.testing.assert_allclose(times, [float(row.split(",")[0]) for row in rows[1:]], atol=1e-6)


def test_a_log_of_a_clock_of_its_own_is_shifted_once(tmp_path):
    """Of a recording with the time of day: from its first frame, unless the offset takes it there already."""
    _, log = as_folders(tmp_path)
    own = read_joint_log(log).times
    np.testing.assert_allclose(read_joint_log(log, offset_s=0.5, recording_start_s=START).times, START + own + 0.5)
    np.testing.assert_allclose(read_joint_log(log, offset_s=START + 0.5, recording_start_s=START).times, START + own + 0.5)


def test_colour_of_another_size_is_left_out(tmp_path):
    folders, _ = as_folders(tmp_path)
    for path in (folders[0] / "color").iterdir():
        write_color(path, np.zeros((200, 300, 3), np.uint8))
    done = invoke("data", "import", folders[0], "--out", tmp_path / "e")
    assert "not aligned to depth: it has 300 x 200 pixels, depth 160 x 120" in done.errors
    assert read_raw_episode(tmp_path / "e").cameras["overhead"].color(0) is None


def test_images_that_cannot_be_read_are_no_fault_of_the_output(tmp_path):
    def frames():
        yield RecordedFrame("side", 0.0, np.ones((120, 160), np.uint16))
        raise OSError(5, "Input/output error")

    recording = Recording({"side": CameraInfo("side", "1", INTRINSICS, 0.001)}, frames(), "a stick")
    with pytest.raises(EpisodeError, match=r"a stick cannot be read: .*Input/output error"):
        write_recording(tmp_path / "e", recording)
    assert not any(tmp_path.iterdir())


def test_two_imports_to_one_place_do_not_mix(tmp_path):
    folders, _ = as_folders(tmp_path)
    with claimed(tmp_path / "e"):
        assert "is being written by process" in invoke("data", "import", folders[0], "--out", tmp_path / "e", code=1).errors


@pytest.mark.parametrize("kind", ["rosbag1", "rosbag2", "mcap"])
def test_ros_recordings(tmp_path, kind):
    done = invoke("data", "import", bag(tmp_path, kind), "--out", tmp_path / "e", "--label", "fabric=tan")
    assert done.result["frames"] == {"overhead": FRAMES, "side": FRAMES}
    episode = read_raw_episode(tmp_path / "e")
    assert episode.description["rate_hz"] == pytest.approx(10, abs=0.01)
    for name, pose in poses().items():
        camera = episode.cameras[name]
        np.testing.assert_allclose(camera.info.T_world_camera, pose, atol=1e-9)
        assert camera.info.intrinsics == INTRINSICS
        np.testing.assert_allclose(camera.times, np.arange(FRAMES) / 10, atol=1e-6)
        for index in range(FRAMES):
            expected = table_depth(pose)
            expected[0, 0] = 1000 + index
            np.testing.assert_array_equal(camera.depth(index), expected)
            assert (camera.color(index) == [30 + index, 20, 10]).all()
    log = episode.robot
    np.testing.assert_allclose(log.joints_rad, np.tile(HOME_RAD, (len(log.times), 1)), atol=1e-7)
    np.testing.assert_allclose(log.gripper, 0.5)
    expected = TOOL[2] + 0.1 * log.times
    np.testing.assert_allclose(log.tool_position_m[:, 2], expected, atol=1e-6)
    assert [finding for finding in validate_raw_episode(tmp_path / "e") if finding.severity == "fault"] == []


def test_depth_in_metres(tmp_path):
    invoke("data", "import", bag(tmp_path, "rosbag2", encoding="32FC1"), "--out", tmp_path / "e")
    camera = read_raw_episode(tmp_path / "e").cameras["side"]
    metres = camera.depth(2) * camera.info.depth_scale_m
    expected = table_depth(poses()["side"]) / 1000
    np.testing.assert_allclose(metres.ravel()[1:], expected.ravel()[1:], atol=1.3e-4)


def test_ros_recordings_that_lack_something(tmp_path):
    path = bag(tmp_path, "rosbag2")
    bad = invoke("data", "import", path, "--out", tmp_path / "e", "--joints", "elbow", code=1)
    assert "['elbow'] not among them. Name the arm's joints" in bad.errors
    done = invoke("data", "import", path, "--out", tmp_path / "f", "--tool-frame", "nowhere", "--world-frame", "map")
    assert done.result["robot_rows"] > 0
    episode = read_raw_episode(tmp_path / "f")
    assert np.isnan(episode.robot.tool_position_m).all()
    assert episode.cameras["side"].info.T_world_camera is None
    (tmp_path / "x.mcap").write_bytes(b"\x89MCAP0\r\nrest")
    assert (
        "not a readable ROS recording"
        in invoke("data", "import", tmp_path / "x.mcap", "--out", tmp_path / "g", code=1).errors
    )
    (tmp_path / "x.txt").write_text("")
    assert (
        "unknown kind of recording" in invoke("data", "import", tmp_path / "x.txt", "--out", tmp_path / "g", code=1).errors
    )


def as_folders(tmp_path):
    """The table scene as folders of PNG, one with this project's JSON and one with Open3D's."""
    episode = write_table_episode(tmp_path / "made", frames=4)
    for name in poses():
        shutil.copytree(episode / "cameras" / name, tmp_path / name)
    matrix = INTRINSICS.matrix.T.ravel().tolist()
    open3d = {"width": 160, "height": 120, "intrinsic_matrix": matrix, "depth_scale": 1000.0, "serial_number": "77"}
    (tmp_path / "side" / "camera.json").write_text(json.dumps(open3d))
    return [tmp_path / "overhead", tmp_path / "side"], episode / "robot.csv"


def test_folders_of_png(tmp_path):
    folders, log = as_folders(tmp_path)
    (folders[1] / "timestamps.csv").unlink()
    missing = invoke("data", "import", *folders, "--out", tmp_path / "e", code=1)
    assert "give the frame rate with --rate-hz" in missing.errors
    done = invoke("data", "import", *folders, "--out", tmp_path / "e", "--rate-hz", 10, "--joint-log", log)
    assert done.result["frames"] == {"overhead": 4, "side": 4}
    episode = read_raw_episode(tmp_path / "e")
    assert episode.cameras["side"].info.serial == "77"
    assert episode.cameras["side"].info.intrinsics == INTRINSICS
    np.testing.assert_array_equal(episode.cameras["side"].depth(3), table_depth(poses()["side"]))
    assert len(episode.robot.times) == 10


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth_scale": 0}, "depth_scale: Input should be greater than or equal to 50"),
        ({"intrinsic_matrix": [1.0] * 9}, "does not go with"),
        ({"intrinsic_matrix": [1.0]}, "intrinsic_matrix: List should have at least 9 items"),
        ({"width": "wide"}, "width: Input should be a valid integer"),
    ],
)
def test_cameras_of_folders_that_no_camera_is(tmp_path, changes, message):
    folder = as_folders(tmp_path)[0][1]
    told = json.loads((folder / "camera.json").read_text())
    (folder / "camera.json").write_text(json.dumps({**told, **changes}))
    assert message in invoke("data", "import", folder, "--out", tmp_path / "e", code=1).errors


def test_data_sets_of_lerobot_are_refused_by_name(tmp_path):
    write_json(tmp_path / "set" / "meta" / "info.json", {"codebase_version": "v2.1"})
    done = invoke("data", "import", tmp_path / "set", "--out", tmp_path / "e", code=1)
    assert "is a LeRobot data set: its videos hold no depth in metres" in done.errors


def test_an_import_that_fails_leaves_nothing(tmp_path):
    folders, _ = as_folders(tmp_path)
    image = folders[0] / "depth" / "000002.png"
    image.write_bytes(image.read_bytes()[:-20])
    before = set(tmp_path.iterdir())
    assert "is truncated" in invoke("data", "import", folders[0], "--out", tmp_path / "e", code=1).errors
    assert set(tmp_path.iterdir()) == before


def test_folders_that_are_damaged(tmp_path):
    folders, log = as_folders(tmp_path)
    (folders[0] / "depth" / "000001.png").unlink()
    assert "frames [1] are missing" in invoke("data", "import", folders[0], "--out", tmp_path / "e", code=1).errors
    (folders[1] / "depth" / "000001.png").write_bytes(b"\xff\xd8\xff\xe0")
    assert "is a JPEG" in invoke("data", "import", folders[1], "--out", tmp_path / "f", code=1).errors
    (folders[1] / "camera.json").unlink()
    assert "intrinsics must be stated" in invoke("data", "import", folders[1], "--out", tmp_path / "g", code=1).errors
    shifted = log.read_text().splitlines()
    rows = [shifted[0], *(f"{START + index},{line.split(',', 1)[1]}" for index, line in enumerate(shifted[1:]))]
    (tmp_path / "epoch.csv").write_text("\n".join(rows) + "\n")
    (folders[0] / "depth" / "000001.png").write_bytes((folders[0] / "depth" / "000002.png").read_bytes())
    bad = invoke("data", "import", folders[0], "--out", tmp_path / "h", "--joint-log", tmp_path / "epoch.csv", code=1)
    assert "different clocks" in bad.errors


def test_times_of_a_folder_that_run_backwards_are_refused_with_the_frame(tmp_path):
    folders, _ = as_folders(tmp_path)
    (folders[0] / "timestamps.csv").write_text("frame,t_s\n0,0.0\n1,0.2\n2,0.1\n3,0.3\n")
    bad = invoke("data", "import", folders[0], "--out", tmp_path / "e", code=1)
    assert "frame 2 is of 0.100000 s, frame 1 of 0.200000 s" in bad.errors
    assert not (tmp_path / "e").exists()


def test_a_joint_log_that_runs_backwards_is_refused_with_the_row(tmp_path):
    folders, log = as_folders(tmp_path)
    rows = log.read_text().splitlines()
    log.write_text("\n".join([*rows[:4], rows[5], rows[4], *rows[6:]]) + "\n")
    bad = invoke("data", "import", folders[0], "--out", tmp_path / "e", "--joint-log", log, code=1)
    assert "row 5: the time runs backwards (0.100000 s after 0.150000 s)" in bad.errors
    assert not (tmp_path / "e").exists()


def test_colour_that_a_folder_lacks_is_counted(tmp_path):
    folders, log = as_folders(tmp_path)
    for number in (1, 3):
        (folders[0] / "color" / f"{number:06d}.png").unlink()
    done = invoke("data", "import", folders[0], "--out", tmp_path / "e", "--joint-log", log)
    (message,) = done.result["warnings"]
    assert "Camera overhead: 2 of 4 frames have no colour image of their number, such as frame 1" in message
    assert [camera_color(tmp_path, number) is not None for number in range(4)] == [True, False, True, False]
    for path in (folders[0] / "color").iterdir():
        path.unlink()
    assert invoke("data", "import", folders[0], "--out", tmp_path / "f", "--joint-log", log).result["warnings"] == []


def camera_color(tmp_path, number):
    return read_raw_episode(tmp_path / "e").cameras["overhead"].color(number)


@pytest.mark.parametrize("rate", [0, -5])
def test_a_rate_that_is_none_is_refused(tmp_path, rate):
    folders, _ = as_folders(tmp_path)
    for untimed in (False, True):
        if untimed:
            (folders[1] / "timestamps.csv").unlink()
        bad = invoke("data", "import", folders[1], "--out", tmp_path / "e", "--rate-hz", rate, code=1)
        assert f"A frame rate is in Hz, above 0 and at most 100000, got {rate}" in bad.errors
        assert not (tmp_path / "e").exists()


@pytest.mark.parametrize("times", [(1.0,), (1.0, 5001.0)])
def test_a_rate_that_cannot_be_measured_is_left_open(tmp_path, times):
    """Of one frame, and of frames so far apart that nothing is left after rounding."""
    info = CameraInfo("side", "1", INTRINSICS, 0.001)
    frames = [RecordedFrame("side", t, table_depth(poses()["side"])) for t in times]
    write_recording(tmp_path / "e", Recording({"side": info}, frames, "test"))
    assert read_raw_episode(tmp_path / "e").description["rate_hz"] is None


def test_files_of_others_need_no_end_of_line(tmp_path):
    folders, log = as_folders(tmp_path)
    for path in (log, folders[0] / "timestamps.csv"):
        path.write_text(path.read_text().rstrip("\n"))
    count = len(log.read_text().splitlines()) - 1
    assert len(read_joint_log(log).times) == count
    done = invoke("data", "import", folders[0], "--out", tmp_path / "e", "--joint-log", log)
    assert done.result["frames"] == {"overhead": 4}


@pytest.mark.parametrize("second_s", [1.0, 0.9])
def test_frames_of_any_source_come_one_after_the_other(tmp_path, second_s):
    info = CameraInfo("side", "1", INTRINSICS, 0.001)
    depth = table_depth(poses()["side"])
    frames = [RecordedFrame("side", t, depth) for t in (1.0, second_s)]
    with pytest.raises(EpisodeError, match="frame 1 of camera side is of"):
        write_recording(tmp_path / "e", Recording({"side": info}, frames, "test"))


def test_realsense_recordings_of_two_cameras_with_a_joint_log(tmp_path):
    from diffcloud.hardware.realsense import RealSenseCamera, import_realsense
    from tests.hardware.software_cameras import FPS, HEIGHT, WIDTH, Cameras, numbered_depth

    try:
        rs = import_realsense()  # a plain import would miss libusb where the system has none
    except HardwareError as error:
        pytest.skip(f"pyrealsense2 is not installed (pip install diffcloud[hardware]): {error}")
    cameras = Cameras(rs)
    opened = [
        RealSenseCamera(
            name, serial, context=cameras.context, width=WIDTH, height=HEIGHT, fps=FPS, record_to=tmp_path / f"{name}.db3"
        )
        for name, serial in zip(("overhead", "side"), cameras.SERIALS, strict=True)
    ]
    start = time.time()
    for camera in opened:
        camera.open()
    for number in range(1, 9):
        for camera in cameras.cameras:
            camera.push_numbered(number, 1000 * (start + number / FPS))
        for camera in opened:
            camera.read(2.0)
    for camera in opened:
        camera.close()
    rows = [f"{start + index / 50}," + ",".join(["0.1"] * 7) for index in range(20)]
    (tmp_path / "log.csv").write_text(
        "\n".join(["t_s," + ",".join(f"joint_{index}" for index in range(1, 8)), *rows]) + "\n"
    )
    done = invoke("data", "import", tmp_path / "overhead.db3", f"side={tmp_path / 'side.db3'}", "--out", tmp_path / "e",
        "--joint-log", tmp_path / "log.csv",
    )  # fmt: skip
    assert done.result["frames"] == {"overhead": 8, "side": 8}
    episode = read_raw_episode(tmp_path / "e")
    np.testing.assert_array_equal(episode.cameras["side"].depth(4), numbered_depth(5, 1))
    np.testing.assert_allclose(np.diff(episode.cameras["side"].times), 1 / FPS, atol=1e-3)
    assert episode.robot.times[0] == pytest.approx(-1 / FPS, abs=1e-3)
    faults = {finding.code for finding in validate_raw_episode(tmp_path / "e") if finding.severity == "fault"}
    assert not faults & {"short_robot_log", "clock_gap", "clock_backwards"}
