"""`diffcloud capture` and `diffcloud doctor` as a person runs them, with a loopback arm and test cards for cameras."""

from __future__ import annotations

import json
import os
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from diffcloud.cli import capture
from diffcloud.cli.app import _have_a_home
from diffcloud.hardware import installed
from diffcloud.io.calibrations import Calibration, CameraCalibration, write_calibration
from diffcloud.io.raw_episodes import read_raw_episode
from tests.cli.invoke import invoke
from tests.hardware.kortex.opening import in_process
from tests.hardware.kortex.server import HOME_M, FakeArm
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


BOTH = ("--camera", "overhead=1", "--camera", "side=2")


def test_a_capture_is_written_and_valid(tmp_path, server, path):
    cameras = {"serial-side": CameraCalibration("serial-side", SMALL, np.eye(4))}
    write_calibration(tmp_path / "c.json", Calibration(cameras, "charuco"))
    done = invoke(
        "capture", "--out", tmp_path / "e", "--trajectory", path, "--arm", "127.0.0.1", *BOTH, "--yes",
        "--calibration", tmp_path / "c.json", "--scenario", "lift", "--rate", 20, "--fps", 60,
    )  # fmt: skip
    assert server.stopped_after_last_motion()
    assert server.sessions_open == 0
    assert done.result["largest_error_m"] < 0.02
    episode = read_raw_episode(tmp_path / "e")
    assert {name: len(camera.frames) for name, camera in episode.cameras.items()} == done.result["frames"]
    assert episode.description["scenario"] == "lift"
    assert episode.description["trajectory"] == "up.csv"
    np.testing.assert_array_equal(episode.cameras["side"].info.T_world_camera, np.eye(4))


def test_a_dry_run_prints_the_plan_and_opens_nothing(tmp_path, server, path):
    done = invoke("capture", "--out", tmp_path / "e", "--trajectory", path, "--arm", "a", *BOTH, "--dry-run")
    assert done.result["plan"]["keyframes"] == 6
    assert "Dry run: nothing was opened" in done.errors
    assert "0.04 of 0.1 m/s" in done.errors
    assert server.calls == []
    assert not (tmp_path / "e").exists()


def test_it_asks_before_the_arm_moves(tmp_path, server, path):
    arguments = ("capture", "--out", tmp_path / "e", "--trajectory", path, "--arm", "127.0.0.1", "--camera", "side=2")
    assert "The arm will move" in invoke(*arguments, answer="n\n", code=1).errors
    assert server.calls == []
    invoke(*arguments, answer="y\n")
    assert "SendTwistCommand" in server.names()


def test_a_folder_that_is_there_is_refused_before_anything_moves(tmp_path, server, path):
    (tmp_path / "e").mkdir()
    (tmp_path / "e" / "episode.json").write_text("{}")
    for more in (("--dry-run",), ("--yes",)):
        said = invoke("capture", "--out", tmp_path / "e", "--trajectory", path, "--arm", "a", *BOTH, *more, code=1).errors
        assert "exists" in said
        assert "recorded so far" not in said
    assert server.calls == []


def test_one_camera_without_an_arm(tmp_path, server):
    done = invoke("capture", "--out", tmp_path / "e", "--camera", "side=2", "--seconds", 0.2)
    assert done.result["robot_rows"] == 0
    assert done.result["frames"]["side"] >= 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--camera", "side"), "--camera takes NAME=SERIAL"),
        (("--camera", "side=1", "--camera", "side=2"), "each name and serial once"),
        (("--camera", "side=1", "--box", "1,2,3"), "--box takes x0,y0,z0,x1,y1,z1"),
        (("--camera", "side=1", "--size", "big"), "--size takes two whole numbers"),
        (("--camera", "side=1"), "say how long to record"),
        (("--camera", "side=1", "--seconds", 1, "--rate", 0), "--rate is in Hz, above 0"),
        (("--camera", "side=1", "--master", "top"), "Unknown --master 'top'"),
        (("--camera", "side=1", "--camera-driver", "a:B", "--laser", 100), "are for RealSense cameras"),
        (("--camera", "side=1", "--camera-driver", "a:B", "--keep-recording"), "are for RealSense cameras"),
        (("--camera", "side=1", "--arm", "127.0.0.1", "--yes"), "An arm needs a trajectory"),
        (("--camera", "side=1", "--trajectory", "up.csv", "--rate", 2, "--dry-run"), "the arm needs a --rate above 2 Hz"),
        (("--camera", "side=1", "--box", "0.4,-0.3,0.1,0.9,0.3,0.44", "--trajectory", "up.csv"), "outside the workspace"),
    ],
)
def test_bad_options(tmp_path, server, path, arguments, message, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in invoke("capture", "--out", "e", *arguments, code=1).errors
    assert not (tmp_path / "e").exists()
    assert "SendTwistCommand" not in server.names()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--table", 0.41), "the table is at 0.410"),
        (
            ("--box", "0.4,-0.3,0.1,0.6,0.3,0.9", "--arm-margin", 0.01),
            "finger_pad reaches x = 0.637 m; the arm's space ends",
        ),
        (("--preload", 5), "At rest the tool feels 6.0 N and 0.0 N·m; up to 5 N and 1.66667 N·m"),
        (("--urdf", "longer.urdf"), "The arm reports its tool 50 mm"),
    ],
)
def test_limits_of_the_whole_arm(tmp_path, server, path, arguments, message, monkeypatch):
    monkeypatch.chdir(tmp_path)
    server.wrench[2] = 6.0
    own = (files("diffcloud.sensing") / "gen3_robotiq_2f_85.urdf").read_text()
    Path("longer.urdf").write_text(
        own.replace('<origin xyz="0 0 0.12" rpy="0 0 0"/>', '<origin xyz="0 0 0.17" rpy="0 0 0"/>')
    )
    command = ("capture", "--out", "e", "--trajectory", path, "--arm", "127.0.0.1", *BOTH, "--yes")
    assert message in invoke(*command, *arguments, code=1).errors
    assert "SendTwistCommand" not in server.names()


def test_trouble_names_what_is_kept(tmp_path, server, path):
    server.at_twist[4] = server.fault
    done = invoke("capture", "--out", tmp_path / "e", "--trajectory", path, "--arm", "a.invalid", *BOTH, "--yes", code=1)
    assert "No arm answers" in done.errors
    done = invoke("capture", "--out", tmp_path / "e", "--trajectory", path, "--arm", "127.0.0.1", *BOTH, "--yes", code=1)
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
