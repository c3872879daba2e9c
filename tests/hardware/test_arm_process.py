"""Whatever becomes of the capture, or of the process that holds the arm, the arm comes to rest: how far it still moves.

Distances are of the loopback arm at 0.1 m/s. The bounds are speed times the time until somebody notices: at once for a
signal, the watchdog's half second for a suspended process, the arm's own half second for a cut cable; then half a second
for a busy machine, and the arm's lag.
"""

from __future__ import annotations

import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing, suppress
from functools import partial

import numpy as np
import pytest

from diffcloud.errors import HardwareError, UnconfirmedStopError
from diffcloud.hardware import ArmProcess, CaptureSettings, capture
from diffcloud.hardware.arm_process import WATCHDOG_S
from diffcloud.io.raw_episodes import read_raw_episode
from tests.hardware.capturing import ROOT, SPEED_M_S, Capture, sideways
from tests.hardware.kortex.opening import in_process
from tests.hardware.kortex.server import LAG_S, FakeArm
from tests.hardware.simulated import TestCard
from tests.hardware.slow_arm import SlowArm, Unsendable, broken, crashing

BUSY_S = 0.5
UP = np.array([0.0, 0.0, SPEED_M_S])
ARM_TIMEOUT_S = 0.5


def farthest(noticed_s):
    """[m] for an arm at full speed."""
    return SPEED_M_S * (noticed_s + BUSY_S + LAG_S)


@pytest.fixture
def server():
    with FakeArm() as arm:
        yield arm


@pytest.fixture
def arm(server):
    opened = in_process(server)
    yield opened
    opened.close()


def moved(server, start):
    return float(np.linalg.norm(server.rest() - start))


NAMES = ["SIGINT", "SIGTSTP", "SIGQUIT", "SIGTERM", "SIGHUP", "SIGUSR1"]


@pytest.mark.parametrize("name", NAMES)
def test_a_signal_stops_the_arm_at_once(tmp_path, server, name):
    """Ctrl-C, Ctrl-Z, Ctrl-\\, kill, a closed terminal; the watchdog is so patient that it cannot have been the one."""
    with Capture(server, tmp_path / "e", watchdog_s=30) as capturing:
        before = capturing.signal(getattr(signal, name))
        assert moved(server, before) < farthest(0.0)
        status, _, errors = capturing.end()
    assert status != 0  # it ended, and was not only suspended
    assert "KeyboardInterrupt" in errors
    assert server.stopped_after_last_motion()
    assert read_raw_episode(tmp_path / "e").description["status"] == "stopped"


def test_a_suspended_capture_is_stopped_by_the_arms_process(tmp_path, server):
    with Capture(server, tmp_path / "e", WATCHDOG_S) as capturing:
        before = capturing.signal(signal.SIGSTOP)
        assert moved(server, before) < farthest(WATCHDOG_S)
        twists = len(server.twist_times)
        capturing.signal(signal.SIGCONT)
        status, _, errors = capturing.end()
    assert status != 0
    assert "nothing came from the capture for 0.5 s: it hangs, or was suspended" in errors
    assert len(server.twist_times) == twists  # woken up, it does not go on


def test_a_killed_capture_is_stopped_by_the_arms_process(tmp_path, server):
    """The end of its process is noticed, not only its silence."""
    with Capture(server, tmp_path / "e", watchdog_s=30) as capturing:
        before = capturing.signal(signal.SIGKILL)
        assert moved(server, before) < farthest(0.0)
    assert server.stopped_after_last_motion()
    end = time.monotonic() + 10
    while server.sessions_open and time.monotonic() < end:
        time.sleep(0.05)
    assert server.sessions_open == 0  # nobody is left behind


@pytest.mark.parametrize("name", ["SIGKILL", "SIGSTOP"])
def test_an_arm_without_its_process_stops_by_its_own_timeout(server, name):
    arm = in_process(server)
    try:
        arm.prepare()
        arm.send_velocity(UP)
        time.sleep(0.3)
        before = server.position
        os.kill(arm.pid, getattr(signal, name))
        assert moved(server, before) < farthest(ARM_TIMEOUT_S)
        assert "Stop" not in server.names()
        with pytest.raises(UnconfirmedStopError, match=r"THE ARM MAY STILL BE MOVING: PRESS THE EMERGENCY STOP\."):
            arm.stop()
    finally:
        if name == "SIGSTOP":
            os.kill(arm.pid, signal.SIGCONT)
        arm.close()


def test_an_arm_whose_cable_is_cut_stops_by_its_own_timeout(server, capfd):
    with closing(in_process(server)) as arm:  # not the fixture's: capfd does not hear what was started before the test
        arm.prepare()
        arm.send_velocity(UP)
        time.sleep(0.3)
        before = server.position
        server.pull_cable()
        with pytest.raises(UnconfirmedStopError, match="did not confirm Stop"):
            arm.stop()
        assert moved(server, before) < farthest(ARM_TIMEOUT_S)
        time.sleep(2.5)
    assert capfd.readouterr().err.count("PRESS THE EMERGENCY STOP") >= 2  # it goes on trying, and shouting


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT", "SIGTSTP", "SIGQUIT", "SIGHUP"])
def test_a_signal_to_the_arms_process_stops_the_arm_and_not_the_process(arm, server, name):
    arm.prepare()
    arm.send_velocity(UP)
    time.sleep(0.2)
    before = server.position
    os.kill(arm.pid, getattr(signal, name))
    assert moved(server, before) < farthest(0.0)
    with pytest.raises(HardwareError, match="a signal came to the process that holds it"):
        arm.send_velocity(UP)
    arm.prepare()
    arm.read()


def test_silence_stops_the_arm_and_no_velocity_follows_until_it_is_prepared(arm, server):
    arm.prepare()
    arm.send_velocity(UP)
    before = server.position
    assert moved(server, before) < farthest(WATCHDOG_S)
    assert server.names()[-1] == "Stop"
    for send, velocity in ((arm.send_velocity, UP), (arm.send_joint_velocity, np.full(7, 0.1))):
        with pytest.raises(HardwareError, match=r"takes no velocities until it is prepared again: nothing came from"):
            send(velocity)
    assert server.names()[-1] == "Stop"
    arm.prepare()
    arm.send_velocity(UP)
    assert server.names()[-1] == "SendTwistCommand"
    arm.stop()


def test_readings_are_a_sign_of_life(arm, server):
    arm.prepare()
    arm.send_velocity(0.1 * UP)
    end = time.monotonic() + 3 * WATCHDOG_S
    while time.monotonic() < end:
        arm.read()
        time.sleep(0.02)
    assert "Stop" not in server.names()
    arm.stop()


def test_velocities_are_refused_before_the_first_prepare_and_after_every_stop(arm, server):
    with pytest.raises(HardwareError, match="it has not been prepared yet"):
        arm.send_velocity(UP)
    arm.prepare()
    arm.stop()
    with pytest.raises(HardwareError, match="the capture sent Stop"):
        arm.send_velocity(UP)
    arm.prepare()
    arm.halt()
    with pytest.raises(HardwareError, match="the capture was interrupted"):
        arm.send_velocity(UP)
    assert "SendTwistCommand" not in server.names()


def test_a_velocity_that_was_refused_arms_no_watchdog(server):
    """An arm that nobody has moved gets no Stop, neither from the watchdog nor at the end; and a prepare is not undone."""
    with closing(in_process(server, watchdog_s=0.1)) as arm:
        with pytest.raises(HardwareError, match="it has not been prepared yet"):
            arm.send_velocity(UP)
        time.sleep(0.3)
        arm.prepare()
        with suppress(HardwareError):
            arm.send_joint_velocity(np.zeros(7))
        arm.stop()
        with pytest.raises(HardwareError, match="the capture sent Stop"):
            arm.send_velocity(UP)
        time.sleep(0.3)
    assert server.names().count("Stop") == 1


def test_the_emergency_stop_locks_velocities_as_stop_does(server, capfd):
    with closing(in_process(server)) as arm:
        arm.prepare()
        arm.send_velocity(UP)
        before = server.position
        arm.emergency_stop()
        assert server.names()[-1] == "ApplyEmergencyStop"
        assert moved(server, before) < farthest(0.0)
        with pytest.raises(HardwareError, match="the capture sent the emergency stop"):
            arm.send_velocity(UP)
    assert "The arm's emergency stop was applied" in capfd.readouterr().err
    assert "Stop" not in server.names()


def test_a_disk_that_hangs_does_not_stop_the_arm(tmp_path, arm, server, monkeypatch):
    """Each fsync of the arm's log takes twice the watchdog's patience."""
    wait = os.fsync

    def slow(handle):
        if os.readlink(f"/proc/self/fd/{handle}").endswith("robot.csv"):
            time.sleep(2 * WATCHDOG_S)
        wait(handle)

    monkeypatch.setattr(os, "fsync", slow)
    report = capture(
        tmp_path / "e", [TestCard(fps=30)], arm=arm, trajectory=sideways(), settings=CaptureSettings(hold_s=0.1)
    )
    moves = [name for name in server.names() if name in ("SendTwistCommand", "Stop")]
    assert moves.index("Stop") == moves.count("SendTwistCommand") > 25  # not one before the last velocity
    assert report.robot_rows > 120


def test_a_stop_that_is_refused_once_is_sent_again(arm, server):
    server.refused["Stop"] = 1
    arm.prepare()
    arm.send_velocity(UP)
    arm.stop()
    assert server.names()[-2:] == ["Stop", "Stop"]


def test_an_arm_that_refuses_stop_gets_its_emergency_stop(server, capfd):
    server.refused["Stop"] = 1000
    with closing(in_process(server)) as arm:
        arm.prepare()
        arm.send_velocity(UP)
        time.sleep(0.2)
        before = server.position
        arm.stop()
        assert server.names()[-3:] == ["Stop", "Stop", "ApplyEmergencyStop"]
        assert moved(server, before) < farthest(0.0)
        with pytest.raises(HardwareError, match="emergency stop pressed"):
            arm.read()
    assert "its emergency stop was applied" in capfd.readouterr().err


def test_a_stop_that_is_not_confirmed_is_shouted_and_repeated(server, capfd):
    server.refused = {"Stop": 1000, "ApplyEmergencyStop": 4}
    with closing(in_process(server)) as arm:
        arm.prepare()
        arm.send_velocity(UP)
        with pytest.raises(UnconfirmedStopError, match=r"THE ARM MAY STILL BE MOVING: PRESS THE EMERGENCY STOP\."):
            arm.stop()
        end = time.monotonic() + 5
        while not server.fault_bank and time.monotonic() < end:  # what the process itself goes on trying
            with suppress(HardwareError):
                arm.read()  # the capture lives, and is not silent
            time.sleep(0.02)
        assert server.fault_bank
    assert "PRESS THE EMERGENCY STOP" in capfd.readouterr().err


class TestSlowArm:
    """What reaches the arm, and when, if its calls take their time."""

    @staticmethod
    def lines(log):
        return [line.split(maxsplit=1)[1] for line in log.read_text().splitlines()]

    @staticmethod
    def opened(log, **slow):
        return ArmProcess(partial(SlowArm, log, slow))

    def test_a_velocity_on_its_way_when_stop_is_sent_is_followed_by_another_stop(self, tmp_path):
        arm = self.opened(tmp_path / "log", twist=0.3)
        try:
            arm.prepare()
            sending = threading.Thread(target=arm.send_velocity, args=(UP,))
            sending.start()
            time.sleep(0.1)
            arm.halt()
            sending.join()
            time.sleep(0.3)
            assert self.lines(tmp_path / "log") == ["prepare", "stop", "twist", "stop"]
        finally:
            arm.close()

    def test_a_call_that_hangs_does_not_hold_up_the_watchdog(self, tmp_path):
        arm = self.opened(tmp_path / "log", read=1.5)
        try:
            arm.prepare()
            arm.send_velocity(UP)
            arm.read()
            assert self.lines(tmp_path / "log") == ["prepare", "twist", "stop", "read"]
            times = [float(line.split()[0]) for line in (tmp_path / "log").read_text().splitlines()]
            assert WATCHDOG_S <= times[2] - times[1] < WATCHDOG_S + BUSY_S
        finally:
            arm.close()

    def test_the_emergency_stop_does_not_wait_for_a_call_that_hangs(self, tmp_path):
        arm = self.opened(tmp_path / "log", read=0.6)
        try:
            arm._socket.send(pickle.dumps((-1, "read", ())))  # as a call that a signal interrupted
            arm.emergency_stop()
            assert self.lines(tmp_path / "log") == ["emergency stop"]
        finally:
            arm.close()

    def test_a_message_that_cannot_be_read_ends_the_process_and_stops_the_arm(self, tmp_path, capfd):
        arm = self.opened(tmp_path / "log")
        try:
            arm.prepare()
            arm.send_velocity(UP)
            arm._socket.send(b"garbage")
            assert arm._process.wait(10) == 0
            assert self.lines(tmp_path / "log") == ["prepare", "twist", "stop"]
        finally:
            arm.close()
        assert "the process that holds it failed (UnpicklingError" in capfd.readouterr().err

    def test_a_reading_that_cannot_be_sent_is_an_error_like_others(self, tmp_path):
        arm = ArmProcess(partial(Unsendable, tmp_path / "log", {}))
        try:
            with pytest.raises(HardwareError, match="pickle"):
                arm.read()
            arm.prepare()  # the thread that carries calls out is still there
        finally:
            arm.close()

    def test_a_prepare_that_is_overtaken_by_a_stop_releases_nothing(self, tmp_path):
        arm = self.opened(tmp_path / "log", prepare=0.3)
        try:
            preparing = threading.Thread(target=arm.prepare)
            preparing.start()
            time.sleep(0.1)
            arm.halt()
            preparing.join()
            with pytest.raises(HardwareError, match="the capture was interrupted"):
                arm.send_velocity(UP)
            assert self.lines(tmp_path / "log") == ["stop", "prepare"]
        finally:
            arm.close()


def test_a_system_without_such_sockets_is_told(monkeypatch):
    def refuse(*_):
        raise OSError(43, "Protocol not supported")

    monkeypatch.setattr(socket, "socketpair", refuse)
    with pytest.raises(HardwareError, match="macOS does not: drive the arm from Linux"):
        ArmProcess(broken)


def test_an_arm_that_does_not_open():
    with pytest.raises(HardwareError, match=r"^No arm answers\.$"):
        ArmProcess(broken)
    with pytest.raises(HardwareError, match="ZeroDivisionError: a bug"):
        ArmProcess(crashing)


def test_a_script_needs_no_guard(tmp_path):
    """With multiprocessing the child would run the script again."""
    script = tmp_path / "script.py"
    script.write_text(
        "from functools import partial\nfrom pathlib import Path\nfrom diffcloud.hardware import ArmProcess\n"
        "from tests.hardware.slow_arm import SlowArm\nprint('once', flush=True)\n"
        f"arm = ArmProcess(partial(SlowArm, Path({str(tmp_path / 'log')!r}), {{}}))\nprint(arm.describe())\narm.close()\n"
    )
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, script], env=env, capture_output=True, text=True, timeout=60)
    assert done.stdout == "once\n{'model': 'slow'}\n", done.stderr


def test_the_arms_process_starts_without_torch():
    """A second of its start, and hundreds of megabytes."""
    code = "import sys, diffcloud.hardware.arm_process, diffcloud.hardware.kinova; print('torch' in sys.modules)"
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "False", done.stderr
