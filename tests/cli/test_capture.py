"""`diffcloud capture` and `diffcloud doctor` as a person runs them, with a loopback arm and test cards for cameras."""

from __future__ import annotations

import json
import os
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from diffcloud.cli import capturing as capture
from diffcloud.cli.app import _have_a_home
from diffcloud.hardware import installed
from diffcloud.io.calibrations import Calibration, CameraCalibration, write_calibration
from diffcloud.io.raw_episodes import read_raw_episode
from tests.cli.invoke import invoke
from tests.hardware.kortex.opening import in_process
from tests.hardware.kortex.server import HOME_M, FakeArm
from tests.hardware.rig_files import write_rig
from tests.hardware.simulated import SMALL, TestCard


class Card(TestCard):
    dropped = 0


@pytest.fixture
def server(monkeypatch):
    with FakeArm(start=HOME_M) as arm:
        monkeypatch.setattr(capture, "open_arm", lambda address, driver=None: in_process(arm, address=address))
        monkeypatch.setattr(capture, "make_camera", lambda name, serial, driver=None, **options: Card(name, fps=60))
        yield arm


@pytest.fixture
def path(tmp_path):
    rows = np.column_stack([np.arange(6) / 10, np.tile(HOME_M, (6, 1)) + np.arange(6)[:, None] * [0.0, 0.0, 0.004]])
    np.savetxt(tmp_path / "up.csv", rows, delimiter=",", header="t_s,x,y,z", comments="")
    return tmp_path / "up.csv"


ARM = "127.0.0.1"
BOTH = {"overhead": "1", "side": "2"}


@pytest.fixture
def rig(tmp_path):
    return write_rig(tmp_path, cameras=BOTH, arm=ARM)


def test_a_capture_is_written_and_valid(tmp_path, server, path):
    """The calibration lies beside rig.yaml, wherever the command runs."""
    cameras = {"serial-side": CameraCalibration("serial-side", SMALL, np.eye(4))}
    write_calibration(tmp_path / "c.json", Calibration(cameras, "charuco"))
    rig = write_rig(tmp_path, cameras=BOTH, arm=ARM, calibration="c.json", control_rate_hz=20, camera_rate_hz=60)
    done = invoke("data", "capture", "--rig", rig, "--out", tmp_path / "e", "--trajectory", path, "--yes",
        "--label", "scenario=lift", "--label", "operator=Ada",
    )  # fmt: skip
    assert server.stopped_after_last_motion()
    assert server.sessions_open == 0
    assert done.result["largest_error_m"] < 0.02
    episode = read_raw_episode(tmp_path / "e")
    assert {name: len(camera.frames) for name, camera in episode.cameras.items()} == done.result["frames"]
    assert episode.description["scenario"] == "lift"
    assert episode.description["operator"] == "Ada"
    assert episode.description["trajectory"] == "up.csv"
    np.testing.assert_array_equal(episode.cameras["side"].info.T_world_camera, np.eye(4))


def test_a_dry_run_prints_the_plan_and_opens_nothing(tmp_path, server, path, rig):
    done = invoke("data", "capture", "--rig", rig, "--out", tmp_path / "e", "--trajectory", path, "--dry-run")
    assert done.result["plan"]["keyframes"] == 6
    assert (done.result["plan"]["arm"], done.result["plan"]["cameras"]) == (ARM, BOTH)
    assert "Dry run: nothing was opened" in done.errors
    assert "0.04 of 0.1 m/s" in done.errors
    assert server.calls == []
    assert not (tmp_path / "e").exists()


def test_it_asks_before_the_arm_moves(tmp_path, server, path, rig):
    arguments = ("data", "capture", "--rig", rig, "--out", tmp_path / "e", "--trajectory", path)
    assert "The arm will move" in invoke(*arguments, answer="n\n", code=1).errors
    assert server.calls == []
    invoke(*arguments, answer="y\n")
    assert "SendTwistCommand" in server.names()


def test_a_folder_that_is_there_is_refused_before_anything_moves(tmp_path, server, path, rig):
    (tmp_path / "e").mkdir()
    (tmp_path / "e" / "episode.json").write_text("{}")
    for more in (("--dry-run",), ("--yes",)):
        said = invoke("data", "capture", "--rig", rig, "--out", tmp_path / "e", "--trajectory", path, *more, code=1).errors
        assert "exists" in said
        assert "recorded so far" not in said
    assert server.calls == []


def test_one_camera_without_an_arm(tmp_path, server):
    """An arm that the file names is not opened for it."""
    rig = write_rig(tmp_path, cameras={"side": "2"}, arm=ARM)
    done = invoke("data", "capture", "--rig", rig, "--out", tmp_path / "e", "--seconds", 0.2)
    assert server.calls == []
    assert done.result["robot_rows"] == 0
    assert done.result["frames"]["side"] >= 1


UP = ("--trajectory", "up.csv")


@pytest.mark.parametrize(
    ("changes", "arguments", "message"),
    [
        ({"speed": 0.2}, (), "rig.yaml: speed: unknown or unsupported field (value 0.2)"),
        ({"cameras": ["side"]}, (), "rig.yaml: cameras: Input should be a valid dictionary"),
        ({"cameras": {"side": 1, "top": "1"}}, (), "cameras: Two cameras have the serial number 1"),
        ({"cameras": {"a/b": "1"}}, (), "rig.yaml: cameras.a/b"),
        ({"workspace_m": [[1, 2, 3]]}, (), "rig.yaml: workspace_m.1: Field required"),
        (
            {"workspace_m": [[400, -360, 55], [950, 360, 950]]},
            (),
            "workspace_m.0.0: Input should be less than or equal",
        ),
        ({"workspace_m": [[0.4, 0, 0.5], [0.9, 0.3, 0.1]]}, (), "The first corner must be lower than the second"),
        ({"image_size": "big"}, (), "rig.yaml: image_size: Input should be a valid tuple"),
        ({"control_rate_hz": 0}, (), "rig.yaml: control_rate_hz: Input should be greater than 0 (got 0)"),
        ({"table_height_m": ".nan"}, (), "rig.yaml: table_height_m: Input should be a number"),
        ({"master": "top"}, (), "rig.yaml: master: Unknown camera 'top'"),
        ({"camera_driver": "a:B", "laser_power_mw": 100}, (), "camera_driver: laser_power_mw are for RealSense cameras"),
        ({"camera_driver": "a:B"}, ("--keep-recording",), "is for RealSense cameras"),
        ({"board": {"marker_m": 0.04}}, (), "board.marker_m: A marker must be smaller than its square of 0.03 m"),
        ({"board": {"dictionary": "DICT_5"}}, (), "board.dictionary: Unknown dictionary 'DICT_5'"),
        ({}, (), "Give --trajectory to move the arm, or --seconds"),
        ({}, ("--seconds", 0), "or --seconds, above 0, to record cameras alone"),
        ({}, ("--seconds", 1, "--home"), "Without --trajectory the arm is not opened"),
        ({}, (*UP, "--seconds", 1), "Give --trajectory or --seconds, not both"),
        ({"arm": None}, (*UP, "--yes"), "A trajectory needs an arm, and rig.yaml names none"),
        ({"control_rate_hz": 2}, (*UP, "--dry-run"), "the arm needs control_rate_hz (rig.yaml) above 2 Hz"),
        ({"workspace_m": [[0.4, -0.3, 0.1], [0.9, 0.3, 0.44]]}, UP, "outside the workspace"),
        ({}, ("--label", "lift"), "--label takes KEY=VALUE, each key once, got 'lift'"),
        ({}, ("--label", "a=1", "--label", "a=2"), "each key once, got 'a=2'"),
        ({}, ("--label", "status=complete"), "episodes keep a fact under the name 'status'. Allowed are category, fabric"),
        ({}, ("--label", "scenario=a/b"), "--label: scenario: Value error, it must be a plain folder name"),
    ],
)
def test_bad_options(tmp_path, server, path, changes, arguments, message, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_rig(tmp_path, **{"cameras": {"side": "1"}, "arm": ARM, **changes})
    assert message in invoke("data", "capture", "--rig", "rig.yaml", "--out", "e", *arguments, code=1).errors
    assert not (tmp_path / "e").exists()
    assert "SendTwistCommand" not in server.names()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"table_height_m": 0.41}, "the table is at 0.410"),
        (
            {"workspace_m": [[0.4, -0.3, 0.1], [0.6, 0.3, 0.9]], "link_margin_m": 0.01},
            "finger_pad reaches x = 0.637 m; the arm's space ends",
        ),
        ({"static_force_n": 5}, "At rest the tool feels 6.0 N and 0.0 N·m; up to 5 N and 1.66667 N·m"),
        ({"urdf": "longer.urdf"}, "The arm reports its tool 50 mm"),
    ],
)
def test_limits_of_the_whole_arm(tmp_path, server, path, changes, message):
    server.wrench[2] = 6.0
    own = (files("diffcloud.sensing") / "gen3_robotiq_2f_85.urdf").read_text()
    (tmp_path / "longer.urdf").write_text(
        own.replace('<origin xyz="0 0 0.12" rpy="0 0 0"/>', '<origin xyz="0 0 0.17" rpy="0 0 0"/>')
    )
    rig = write_rig(tmp_path, cameras=BOTH, arm=ARM, **changes)
    command = ("data", "capture", "--rig", rig, "--out", tmp_path / "e", "--trajectory", path, "--yes")
    assert message in invoke(*command, code=1).errors
    assert "SendTwistCommand" not in server.names()


def test_trouble_names_what_is_kept(tmp_path, server, path):
    server.at_twist[4] = server.fault
    command = ("data", "capture", "--rig", tmp_path / "rig.yaml", "--out", tmp_path / "e", "--trajectory", path, "--yes")
    write_rig(tmp_path, cameras=BOTH, arm="a.invalid")
    assert "No arm answers" in invoke(*command, code=1).errors
    write_rig(tmp_path, cameras=BOTH, arm=ARM)
    done = invoke(*command, code=1)
    assert "went into fault: joint fault" in done.errors
    assert "What was recorded so far is in" in done.errors
    assert json.loads((tmp_path / "e" / "episode.json").read_text())["status"] == "stopped"


def test_a_user_without_a_home_gets_a_folder_of_its_own(tmp_path, monkeypatch):
    """As in a container whose user is not in passwd. Otherwise the cameras' library fails and caches go to a folder ~."""
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    _have_a_home()
    home = Path(os.environ["HOME"])
    assert (home.parent, home.stat().st_mode & 0o777) == (tmp_path, 0o700)
    monkeypatch.delenv("HOME")
    home.chmod(0o777)  # somebody else may have made it
    _have_a_home()
    assert Path(os.environ["HOME"]) != home
    monkeypatch.setenv("HOME", "/here")
    _have_a_home()
    assert os.environ["HOME"] == "/here"


def test_doctor_ends_well_where_the_cameras_library_fails(monkeypatch):
    def fails():
        raise RuntimeError("failed to get special folder 5")

    monkeypatch.setattr("pyrealsense2.context", fails)
    checks = {check["name"]: check for check in invoke("doctor").result["checks"]}
    assert checks["pyrealsense2"]["state"] == "missing"
    assert "failed to get special folder 5" in checks["pyrealsense2"]["detail"]


def test_doctor_says_what_is_missing(server):
    done = invoke("doctor", "--arm", "127.0.0.1")
    states = {check["name"]: check["state"] for check in done.result["checks"]}
    assert states["opencv-contrib-python-headless"] == "ok"
    assert {"kortex_api", "disk", "arm"} <= set(states)
    checks = {check.name: check for check in installed.check_installation(arm="127.0.0.1", arm_port=server.tcp_port)}
    assert checks["arm"].state == "ok"
    server.cut()
    checks = {check.name: check for check in installed.check_installation(arm="127.0.0.1", arm_port=server.tcp_port)}
    assert "does not answer" in checks["arm"].detail
