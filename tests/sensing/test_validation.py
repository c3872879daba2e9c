"""`diffcloud episode validate` explains each fault of a damaged episode, and finds nothing in a good one."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from diffcloud.io.calibrations import Calibration, CameraCalibration, write_calibration
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.images import write_depth
from diffcloud.sensing.cameras import rays
from diffcloud.sensing.validation.episode import validate_raw_episode
from tests.cli.invoke import invoke
from tests.sensing.table_scene import INTRINSICS, SERIALS, poses, write_table_episode


@pytest.fixture
def episode(tmp_path):
    return write_table_episode(tmp_path / "e")


def codes(folder, **options):
    return {finding.code for finding in validate_raw_episode(folder, **options) if finding.severity == "fault"}


def message(folder, code, **options):
    return next(finding.message for finding in validate_raw_episode(folder, **options) if finding.code == code)


def edit_json(path, **changes):
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def edit_column(path, column, function):
    lines = path.read_text().splitlines()
    index = lines[0].split(",").index(column)
    rows = [line.split(",") for line in lines[1:]]
    values = function(np.array([float(row[index]) for row in rows]))
    for row, value in zip(rows, values, strict=True):
        row[index] = repr(float(value))
    path.write_text("\n".join([lines[0], *(",".join(row) for row in rows)]) + "\n")


def test_a_good_episode_has_no_findings(episode):
    assert validate_raw_episode(episode) == []


def test_one_camera_is_enough(tmp_path):
    assert validate_raw_episode(write_table_episode(tmp_path / "one", names=("side",))) == []


def test_a_gap_in_the_clock(episode):
    edit_column(episode / "cameras/side/timestamps.csv", "t_s", lambda t: np.where(t > 0.25, t + 0.2, t))
    assert "clock_gap" in codes(episode)
    assert "0.300 s after frame 2" in message(episode, "clock_gap")


def test_a_clock_that_runs_backwards(episode):
    edit_column(episode / "cameras/side/timestamps.csv", "t_s", lambda t: np.where(t > 0.25, t - 0.2, t))
    assert codes(episode) == {"clock_backwards"}
    edit_column(episode / "robot.csv", "t_s", lambda t: t[::-1])
    assert "robot.csv" in [finding.place for finding in validate_raw_episode(episode) if finding.code == "clock_backwards"]


def test_missing_frames(episode):
    (episode / "cameras/side/depth/000002.png").unlink()
    assert codes(episode) == {"missing_frames"}
    path = episode / "cameras/overhead/timestamps.csv"
    path.write_text("".join(line for line in path.read_text().splitlines(keepends=True) if not line.startswith("3,")))
    assert "Frame 2 is followed by frame 4" in " ".join(finding.message for finding in validate_raw_episode(episode))


def test_jpeg_depth(episode):
    import cv2

    for name in ("000001.jpg", "000001.png"):  # by its name, and by its bytes under a good name
        folder = episode / "cameras/side/depth"
        (folder / name).write_bytes(cv2.imencode(".jpg", np.zeros((120, 160), np.uint8))[1].tobytes())
        assert codes(episode) == {"jpeg_depth"}
        (folder / name).unlink()


def test_depth_of_eight_bits(episode):
    import cv2

    cv2.imwrite(str(episode / "cameras/side/depth/000001.png"), np.full((120, 160), 90, np.uint8))
    assert "1 channels of 8 bits" in message(episode, "image")


def test_a_truncated_png(episode):
    path = episode / "cameras/overhead/depth/000004.png"
    path.write_bytes(path.read_bytes()[:-200])
    assert codes(episode) == {"truncated_image"}
    assert "overhead/depth/000004.png" in validate_raw_episode(episode)[0].place


def test_degrees_for_radians(episode):
    for joint in range(1, 8):
        edit_column(episode / "robot.csv", f"joint_{joint}", np.rad2deg)
    assert codes(episode) == {"angle_unit"}
    assert "If these are degrees" in message(episode, "angle_unit")


def test_a_joint_that_goes_on_turning(episode):
    edit_column(episode / "robot.csv", "joint_7", lambda angles: angles + 6.0 + np.linspace(0, 0.8, len(angles)))
    assert codes(episode) == set()
    edit_column(episode / "robot.csv", "joint_7", lambda angles: angles + 1.0)
    assert codes(episode) == {"angle_unit"}


def test_degrees_that_begin_at_zero(episode):
    for joint in range(1, 8):
        edit_column(episode / "robot.csv", f"joint_{joint}", lambda angles: np.linspace(0, 12, len(angles)))
    assert codes(episode) == {"angle_unit"}


def test_millimetres_for_metres(episode):
    edit_column(episode / "robot.csv", "tool_x", lambda x: 1000 * x)
    assert codes(episode) == {"length_unit"}


def test_a_tool_that_is_too_far_away_for_an_arm_and_not_by_millimetres(episode):
    edit_column(episode / "robot.csv", "tool_x", lambda x: x + 4)
    assert codes(episode) == {"length_unit"}
    assert "check their unit and their frame" in message(episode, "length_unit")


def test_a_quaternion_that_is_none(episode):
    for part in "wxyz":
        edit_column(episode / "robot.csv", f"tool_q{part}", lambda q: q / 2)
    assert codes(episode) == {"quaternion"}
    assert "has a length of 0.5 instead of 1" in message(episode, "quaternion")


def test_a_gripper_in_percent(episode):
    edit_column(episode / "robot.csv", "gripper", lambda x: 100 * x)
    assert codes(episode) == {"gripper_unit"}


def test_a_wrong_depth_scale(episode):
    for name in SERIALS:
        edit_json(episode / f"cameras/{name}/camera.json", depth_scale_m=1e-6)
    assert "depth_unit" in codes(episode)
    assert "millimetres for metres" in message(episode, "depth_unit")


def test_no_valid_depth(episode):
    write_depth(episode / "cameras/side/depth/000000.png", np.zeros((120, 160), np.uint16))
    assert codes(episode) == {"no_depth"}
    assert "Frame 0 has 0 valid depth" in message(episode, "no_depth")


def test_another_resolution(episode):
    write_depth(episode / "cameras/side/depth/000000.png", np.full((60, 80), 700, np.uint16))
    assert codes(episode) == {"image_size"}


def test_a_joint_log_shorter_than_the_video(episode):
    path = episode / "robot.csv"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:6]))
    assert codes(episode) == {"short_robot_log"}
    assert "frames have no joint angles" in message(episode, "short_robot_log")


def test_swapped_poses_are_seen_in_the_depth(episode):
    stated = poses()
    edit_json(episode / "cameras/side/camera.json", T_world_camera=stated["overhead"].tolist())
    edit_json(episode / "cameras/overhead/camera.json", T_world_camera=stated["side"].tolist())
    assert codes(episode) == {"swapped_cameras"}


def calibration(path, serials, intrinsics=INTRINSICS, objections=()):
    cameras = {serial: CameraCalibration(serial, intrinsics, poses()[name], name=name) for name, serial in serials.items()}
    write_calibration(path, Calibration(cameras, "charuco", objections=objections))
    return path


def test_the_right_calibration_is_silent(episode, tmp_path):
    assert codes(episode, calibration=calibration(tmp_path / "c.json", SERIALS)) == set()


def test_a_calibration_that_was_forced_is_a_warning_with_its_reason(episode, tmp_path):
    path = calibration(tmp_path / "lab.json", SERIALS, objections=("Camera side has 5 poses.",))
    findings = validate_raw_episode(episode, calibration=path)
    assert {(finding.severity, finding.code) for finding in findings} == {("warning", "forced_calibration")}
    assert "Camera side has 5 poses." in findings[0].message


def test_swapped_serials(episode, tmp_path):
    swapped = dict(zip(SERIALS, reversed(SERIALS.values()), strict=True))
    assert "swapped_cameras" in codes(episode, calibration=calibration(tmp_path / "c.json", swapped))


def test_the_calibration_of_another_camera(episode, tmp_path):
    other = calibration(tmp_path / "c.json", {"overhead": "7", "side": "8"})
    assert codes(episode, calibration=other) == {"other_calibration"}
    assert "no camera overhead (serial 036522070001); it holds 7 (overhead), 8 (side)" in message(
        episode, "other_calibration", calibration=other
    )
    smaller = Intrinsics(80, 60, 77.0, 77.0, 39.5, 29.5)
    assert codes(episode, calibration=calibration(tmp_path / "d.json", SERIALS, smaller)) == {"other_calibration"}


def test_a_recording_that_was_never_closed_is_only_a_warning(episode):
    edit_json(episode / "episode.json", status="recording")
    assert codes(episode) == set()
    assert "the frames that timestamps.csv lists are whole" in message(episode, "unfinished")


def test_units_that_are_not_si(episode):
    edit_json(episode / "episode.json", units={"length": "mm"})
    assert codes(episode) == {"description"}


@pytest.mark.parametrize(
    ("settings", "code"),
    [
        (({"depth.laser_power": 150}, {"depth.laser_power": 360}), "settings_differ"),
        (({"depth.enable_auto_exposure": 1}, {"depth.enable_auto_exposure": 0}), "auto_exposure"),
        (({"depth.inter_cam_sync_mode": 2}, {"depth.inter_cam_sync_mode": 2}), "pace"),
        (({"depth.inter_cam_sync_mode": 1}, {"depth.inter_cam_sync_mode": 0}), "pace"),
        (({"depth.inter_cam_sync_mode": 1}, {"depth.inter_cam_sync_mode": 2}), None),
        (({"depth.laser_power": 150}, {}), None),
    ],
)
def test_cameras_that_are_not_set_alike(episode, settings, code):
    for folder, told in zip(sorted((episode / "cameras").iterdir()), settings, strict=True):
        edit_json(folder / "camera.json", settings=told)
    assert [finding.code for finding in validate_raw_episode(episode)] == ([] if code is None else [code])


def test_the_command_explains_and_fails(episode, tmp_path):
    assert invoke("data", "check", episode).result == {"episode": str(episode), "valid": True, "findings": []}
    (episode / "cameras/side/depth/000002.png").write_bytes(b"")
    (episode / "robot.csv").write_text("t_s,joint_1\n0,0\n")
    done = invoke("data", "check", episode, code=1)
    assert {finding["code"] for finding in done.result["findings"]} == {"image", "joint_count", "short_robot_log"}
    assert "No such folder" in invoke("data", "check", tmp_path / "none", code=1).errors


def exchange(first, second):
    spare = first.with_name("spare")
    first.rename(spare)
    second.rename(first)
    spare.rename(second)


def test_swapped_camera_folders(episode):
    exchange(episode / "cameras" / "overhead", episode / "cameras" / "side")
    assert "swapped_cameras" in codes(episode)
    assert "Exchange their names" in message(episode, "swapped_cameras")


@pytest.mark.parametrize("flat", [False, True])
def test_swapped_images(episode, flat):
    """Also where there is a table alone, on which two views always have points that lie near each other."""
    if flat:
        for name, pose in poses().items():
            for path in (episode / "cameras" / name / "depth").iterdir():
                write_depth(path, plain_table(pose))
    for kind in ("depth", "color"):
        exchange(episode / "cameras" / "overhead" / kind, episode / "cameras" / "side" / kind)
    assert codes(episode) == {"swapped_cameras"}
    assert "level when each takes the other's pose" in message(episode, "swapped_cameras")


def plain_table(pose):
    column, row = np.meshgrid(np.arange(INTRINSICS.width), np.arange(INTRINSICS.height))
    down = (rays(np.stack([column, row], axis=-1).astype(float), INTRINSICS) @ pose[:3, :3].T)[..., 2]
    with np.errstate(divide="ignore"):
        depth = np.where(down < 0, -pose[2, 3] / down, np.inf)
    return np.where(depth < 4.0, np.rint(depth * 1000), 0).astype(np.uint16)


def faults(folder):
    return {one.code for one in validate_raw_episode(folder) if one.severity == "fault"}


def test_a_camera_without_a_place_is_a_fault(episode):
    edit_json(episode / "cameras" / "side" / "camera.json", T_world_camera=None)
    assert faults(episode) == {"uncalibrated"}
    assert "Run diffcloud data calibrate" in message(episode, "uncalibrated")


def test_a_gap_in_the_joint_log_is_a_fault(episode):
    path = episode / "robot.csv"
    head, *rows = path.read_text().splitlines()
    later = [",".join([str(float(row.split(",")[0]) + 2), *row.split(",")[1:]]) for row in rows[6:]]
    path.write_text("\n".join([head, *rows[:6], *later]) + "\n")
    assert faults(episode) == {"clock_gap"}
    assert "A gap of 2.05" in message(episode, "clock_gap")


@pytest.mark.parametrize(("count", "severity"), [(3, "fault"), (5, "fault"), (6, "warning")])
def test_joints_that_are_missing(episode, count, severity):
    table = pd.read_csv(episode / "robot.csv")
    table.drop(columns=[f"joint_{index}" for index in range(count + 1, 8)]).to_csv(episode / "robot.csv", index=False)
    (found,) = [one for one in validate_raw_episode(episode) if one.code == "joint_count"]
    assert found.severity == severity
    assert f"It has {count} joints, the Gen3 7" in found.message
