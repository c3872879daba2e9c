"""Drivers for other hardware: found by name, held to their protocol, recorded with."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from importlib.resources import as_file, files

import numpy as np
import pytest

from diffcloud.errors import ConfigError, HardwareError, LimitError, UnconfirmedStopError
from diffcloud.hardware import Limits, conformance, drivers
from diffcloud.hardware.arm_limits import ArmChecker, ArmLimits
from diffcloud.hardware.examples.folder_camera import FolderCamera
from diffcloud.hardware.examples.simulated_ur5e import Controller, ur5e
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.files import write_json
from diffcloud.io.raw_episodes import CameraInfo, read_raw_episode
from diffcloud.sensing.robot import gen3
from diffcloud.sensing.validation.episode import validate_raw_episode
from tests.cli.invoke import invoke
from tests.hardware.drivers import Dated, Metres, Silent, Undead, write_images
from tests.hardware.kortex.opening import in_process
from tests.hardware.kortex.server import FakeArm
from tests.hardware.rig_files import write_rig

EXAMPLE = "diffcloud.hardware.examples.simulated_ur5e:SimulatedUR5e"
FOLDER = "diffcloud.hardware.examples.folder_camera:FolderCamera"
SHAPE = (24, 32)


@pytest.fixture
def controller():
    made = Controller()
    server = made.serve()
    made.address = f"127.0.0.1:{server.server_address[1]}"
    yield made
    made.end()
    server.shutdown()
    server.server_close()


@pytest.fixture
def folder(tmp_path):
    """Of a camera, which another program writes to."""
    place, ending = tmp_path / "images", threading.Event()
    info = CameraInfo("side", "77", Intrinsics(SHAPE[1], SHAPE[0], 31.0, 31.0, 15.5, 11.5), 0.001)
    write_json(place / "camera.json", info.to_json())
    writing = threading.Thread(target=write_images, args=(place, ending), kwargs={"shape": SHAPE})
    writing.start()
    yield place
    ending.set()
    writing.join()


def wrong_arm(controller, driver=EXAMPLE, *, move=False, limits=None, robot=None):
    """Names of what is wrong."""
    checker = ArmChecker(robot or ur5e(), limits or Limits(), ArmLimits())
    found = list(conformance.check_arm(lambda: drivers.open_arm(driver, controller.address), checker, move=move))
    return {one.name for one in found if one.state != "ok"}


class TestNames:
    @pytest.mark.parametrize(
        ("name", "message"),
        [
            ("no_colon", "named as module:Class"),
            ("no_such_module:Class", "cannot be imported .ModuleNotFoundError"),
            ("diffcloud.errors:Nothing", "cannot be imported .AttributeError"),
            ("tests.hardware.drivers:NoArm", "lacks describe, clear_faults, prepare"),
        ],
    )
    def test_what_is_no_driver_is_refused_before_a_process_starts(self, name, message):
        with pytest.raises(ConfigError, match=message):
            drivers.open_arm(name, "127.0.0.1:1")

    def test_an_arm_that_does_not_answer(self):
        with pytest.raises(HardwareError, match=r"No controller answers at 127\.0\.0\.1:1 "):
            drivers.open_arm(EXAMPLE, "127.0.0.1:1")

    def test_a_file_in_the_working_folder_is_found(self, tmp_path, monkeypatch):
        (tmp_path / "my_camera.py").write_text(
            "from diffcloud.hardware.examples.folder_camera import FolderCamera\nclass Mine(FolderCamera): ...\n"
        )
        monkeypatch.chdir(tmp_path)
        assert drivers.make_camera("my_camera:Mine", "side", "folder", fps=30).name == "side"


class TestArm:
    @pytest.mark.slow
    @pytest.mark.realtime
    def test_the_example_does_all_that_a_capture_relies_on(self, controller):
        before = controller.tool_position
        assert wrong_arm(controller, move=True) == set()
        np.testing.assert_allclose(controller.tool_position, before, atol=3e-3)

    @pytest.mark.slow
    @pytest.mark.realtime
    def test_so_does_the_gen3s(self):
        with FakeArm() as server:
            checker = ArmChecker(gen3(), Limits(), ArmLimits())
            found = list(conformance.check_arm(lambda: in_process(server), checker, move=True))
        assert {one.name: one.detail for one in found if one.state != "ok"} == {}

    @pytest.mark.parametrize(
        ("driver", "wrong"),
        [
            ("InDegrees", {"joints", "tool frame"}),
            ("InMillimetres", {"tool frame"}),
            ("ScalarFirst", {"tool frame"}),
            ("Slow", {"reading"}),
        ],
    )
    def test_units_and_frames_show_in_the_readings(self, controller, driver, wrong):
        assert wrong_arm(controller, f"tests.hardware.drivers:{driver}") == wrong

    def test_a_torque_at_rest(self, controller):
        assert wrong_arm(controller, "tests.hardware.drivers:Twisted") == {"wrench"}

    def test_an_arm_that_is_only_read_gets_no_stop(self):
        """Somebody else may be driving it."""
        with FakeArm() as server:
            checker = ArmChecker(gen3(), Limits(), ArmLimits())
            list(conformance.check_arm(lambda: in_process(server), checker, move=False))
            assert "Stop" not in server.names()

    def test_a_description_of_another_arm(self, controller):
        assert {"joints", "tool frame"} <= wrong_arm(controller, robot=gen3())

    @pytest.mark.slow
    @pytest.mark.realtime
    @pytest.mark.parametrize(
        ("driver", "wrong"),
        [("InTheToolsFrame", "velocity"), ("HardlyStopping", "stands still after Stop")],
    )
    def test_what_only_motion_shows(self, controller, driver, wrong):
        assert wrong in wrong_arm(controller, f"tests.hardware.drivers:{driver}", move=True)

    @pytest.mark.slow
    @pytest.mark.realtime
    def test_an_arm_that_moves_on_without_its_link(self, controller, monkeypatch):
        monkeypatch.setattr("diffcloud.hardware.examples.simulated_ur5e._SILENCE_S", 60.0)
        assert wrong_arm(controller, move=True) == {"stops by itself when its process is lost"}

    def test_without_room_above_nothing_moves(self, controller):
        before = controller.tool_position
        with pytest.raises(LimitError, match="needs 8 cm above it"):
            wrong_arm(controller, move=True, limits=Limits(box_high_m=(0.95, 0.36, 0.4)))
        np.testing.assert_array_equal(controller.tool_position, before)

    @pytest.mark.slow
    @pytest.mark.realtime
    def test_a_cable_that_a_person_pulls(self):
        with FakeArm() as server:

            def ask(text):
                if "Plug" in text:
                    server._pulled = False
                else:
                    threading.Timer(1.0, server.pull_cable).start()

            checker = ArmChecker(gen3(), Limits(), ArmLimits())
            found = list(conformance.check_arm(lambda: in_process(server), checker, move=True, ask=ask))
        assert {one.name: one.detail for one in found if one.state != "ok"} == {}
        assert "stops by itself when its cable is pulled" in {one.name for one in found}


class Troubled:
    """An arm that moves up until something happens; `lost` means that it does not confirm Stop."""

    def __init__(self, error, lost):
        self.arm, self._error, self._lost, self.stops, self._moves = self, error, lost, 0, 0

    def up(self, seconds):
        self._moves += 1
        if self._moves > 2:
            raise self._error
        return np.zeros(1), np.full((1, 3), float(self._moves))

    def stop(self):
        self.stops += 1
        if self._lost:
            raise UnconfirmedStopError("MAY STILL BE MOVING")


class TestCable:
    def test_a_lost_link_is_one_on_which_no_stop_is_confirmed(self):
        arm, asked = Troubled(HardwareError("no answer"), lost=True), []
        np.testing.assert_array_equal(conformance._pulled(arm, asked.append), np.full(3, 2.0))
        assert arm.stops == 1
        assert "Plug the cable in again" in asked[1]

    @pytest.mark.parametrize(
        ("error", "lost"),
        [(LimitError("felt 40 N"), False), (LimitError("felt 40 N"), True), (HardwareError("went into fault"), False)],
    )
    def test_an_arm_in_trouble_is_stopped_and_told(self, error, lost):
        arm, asked = Troubled(error, lost), []
        with pytest.raises(type(error), match=str(error)):
            conformance._pulled(arm, asked.append)
        assert arm.stops == 1
        assert len(asked) == 1


class TestCamera:
    def wrong(self, camera):
        return {one.name for one in conformance.check_camera(camera, seconds=0.4, timeout_s=0.3) if one.state != "ok"}

    def test_the_example_does_all_that_a_capture_relies_on(self, folder):
        assert self.wrong(FolderCamera("side", str(folder))) == set()

    def test_what_was_there_before_is_no_frame(self, folder, tmp_path):
        camera = FolderCamera("side", str(folder))
        camera.open()
        first = camera.read(5.0)
        camera.close()
        camera.open()
        later = camera.read(5.0)
        assert later.time_s > first.time_s
        assert later.color[0, 0, 0] > first.color[0, 0, 0]  # which tells the image's number
        camera.close()
        with pytest.raises(HardwareError, match="is not open"):
            camera.read(0.1)
        with pytest.raises(HardwareError, match=r"No such file|camera\.json"):
            FolderCamera("side", str(tmp_path / "none")).open()

    @pytest.mark.parametrize(
        ("camera", "wrong"),
        [
            (Dated, {"times are time.monotonic()", "depth scale", "closed"}),
            (Metres, {"depth", "depth scale", "closed"}),
            (Undead, {"depth scale", "closed"}),
            (Silent, {"delivers"}),
        ],
    )
    def test_faults_are_named(self, camera, wrong):
        """A test card's depth is its frame's number, millimetres."""
        assert self.wrong(camera()) == wrong

    def test_one_that_falls_silent_does_not_also_deliver(self):
        found = list(conformance.check_camera(Silent(), seconds=0.4, timeout_s=0.3))
        assert [(one.name, one.state) for one in found] == [("delivers", "wrong")]


@contextmanager
def description():
    with as_file(files("diffcloud.hardware.examples") / "ur5e.urdf") as path:
        yield path


def trajectory(tmp_path):
    rows = np.column_stack([np.arange(6) / 10, np.full(6, 0.492), np.full(6, 0.133), 0.358 + 0.004 * np.arange(6)])
    np.savetxt(tmp_path / "up.csv", rows, delimiter=",", header="t_s,x,y,z", comments="")
    return tmp_path / "up.csv"


class TestCommand:
    def rig(self, tmp_path, urdf, controller, folder=None):
        cameras = {} if folder is None else {"cameras": {"side": str(folder)}, "camera_driver": FOLDER}
        return write_rig(tmp_path, arm_driver=EXAMPLE, arm=controller.address, urdf=str(urdf), **cameras)

    def test_a_capture_with_both(self, tmp_path, controller, folder):
        with description() as urdf:
            rig = self.rig(tmp_path, urdf, controller, folder)
            done = invoke(
                "data", "capture", "--rig", rig, "--out", tmp_path / "e", "--trajectory", trajectory(tmp_path), "--yes"
            )
            faults = {one.code for one in validate_raw_episode(tmp_path / "e") if one.severity == "fault"}
            invoke("data", "check", tmp_path / "e", "--urdf", urdf, code=1 if faults else 0)
        assert done.result["frames"]["side"] > 3
        episode = read_raw_episode(tmp_path / "e")
        assert episode.description["robot"]["model"] == "simulated UR5e"
        assert episode.robot.joints_rad.shape[1] == 6
        assert episode.robot.tool_position_m[-1, 2] == pytest.approx(0.378, abs=0.003)

    def test_checks_of_both(self, tmp_path, controller, folder):
        with description() as urdf:
            rig = self.rig(tmp_path, urdf, controller, folder)
            done = invoke("data", "capture", "--rig", rig, "--check", "all", "--trajectory", trajectory(tmp_path), "--yes")
        names = {one["name"] for one in done.result["checks"]}
        assert {"arm: trajectory", "arm: velocity", "camera side: depth"} <= names
        assert done.result["wrong"] == []

    def test_a_check_of_cameras_does_not_open_the_arm(self, tmp_path, folder):
        cameras = {"cameras": {"side": str(folder)}, "camera_driver": FOLDER}
        rig = write_rig(tmp_path, arm_driver="no_such:Arm", arm="nowhere", **cameras)
        done = invoke("data", "capture", "--rig", rig, "--check", "cameras")
        assert {one["name"].split(":")[0] for one in done.result["checks"]} == {"camera side"}

    def test_a_dry_check_reads_the_arm_and_does_not_move_it(self, tmp_path, controller):
        before = controller.tool_position
        with description() as urdf:
            done = invoke("data", "capture", "--rig", self.rig(tmp_path, urdf, controller), "--check", "arm", "--dry-run")
        assert {"arm: joints", "arm: tool frame"} <= {one["name"] for one in done.result["checks"]}
        np.testing.assert_array_equal(controller.tool_position, before)

    def test_a_check_asks_before_the_arm_moves(self, tmp_path, controller):
        before = controller.tool_position
        with description() as urdf:
            rig = self.rig(tmp_path, urdf, controller)
            done = invoke("data", "capture", "--rig", rig, "--check", "arm", answer="n\n", code=1)
        assert "The arm will move" in done.errors
        np.testing.assert_array_equal(controller.tool_position, before)

    @pytest.mark.slow
    @pytest.mark.realtime
    def test_a_trajectory_beyond_the_arms_reach_is_wrong(self, tmp_path, controller):
        rows = "t_s,x,y,z\n0,0.49,0.13,0.36\n9,0.94,0.35,0.9\n"
        (tmp_path / "far.csv").write_text(rows)
        with description() as urdf:
            rig = self.rig(tmp_path, urdf, controller)
            done = invoke(
                "data", "capture", "--rig", rig, "--check", "arm", "--trajectory", tmp_path / "far.csv", "--yes", code=1
            )
        assert done.result["wrong"] == ["arm: trajectory"]

    @pytest.mark.parametrize(
        ("settings", "arguments", "message"),
        [
            ({}, ("--check", "arm"), "--check arm needs the arm's address"),
            ({}, ("--check", "cameras"), "--check cameras needs cameras"),
            ({"arm": "a"}, ("--check", "all"), "--check all needs cameras"),
            ({"cameras": {"a": "1"}}, (), "A capture needs --out"),
            ({}, ("--out", "e"), "a file whose `cameras` names at least one camera"),
        ],
    )
    def test_what_is_missing_is_said(self, tmp_path, settings, arguments, message):
        assert message in invoke("data", "capture", "--rig", write_rig(tmp_path, **settings), *arguments, code=1).errors
        if not settings:
            assert message in invoke("data", "capture", *arguments, code=1).errors
