"""The arm's adapter over the wire: a loopback server that speaks Kortex, driven through kortex_api where it is installed,
and otherwise through the minimal client of the same call surface."""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import fields

import numpy as np
import pytest

from diffcloud.errors import HardwareError, LimitError
from diffcloud.hardware import CaptureSettings, Limits, ToolTrajectory, capture
from diffcloud.hardware.kinova import Kortex, load_kortex
from diffcloud.io.raw_episodes import read_raw_episode
from diffcloud.sensing.robot import GEN3_HOME_RAD
from tests.hardware.kortex import messages
from tests.hardware.kortex.client import MINIMAL
from tests.hardware.kortex.messages import Frame, parsed
from tests.hardware.kortex.opening import connect, in_process
from tests.hardware.kortex.server import EMERGENCY, HOME_DEG, HOME_M, LAG_S, FakeArm
from tests.hardware.simulated import TestCard

TEN_HZ = CaptureSettings(rate_hz=10.0, hold_s=0.3, durable=False)


@pytest.fixture
def server():
    with FakeArm() as arm:
        yield arm


@pytest.fixture
def arm(server):
    """The adapter itself, in this process."""
    opened = here(server)
    yield opened
    opened.close()


@pytest.fixture
def guarded(server):
    opened = in_process(server)
    yield opened
    opened.close()


def here(server, **options):
    return connect(server.tcp_port, server.udp_port, **options)


def lift(keyframes=25, height=0.15):
    """25 keyframes at 10 Hz, straight up with minimum jerk."""
    s = np.linspace(0, 1, keyframes)
    up = s**3 * (10 - 15 * s + 6 * s**2) * height
    return ToolTrajectory(np.arange(keyframes) / 10, HOME_M + up[:, None] * [0.0, 0.0, 1.0])


class TestWire:
    def test_a_frame_is_what_the_protocol_says(self):
        frame = Frame.build(1, 0x20079, 5, 7, b"abc")
        header = bytes.fromhex("0d00000011 1507000500 1d79000210 2503000000")
        assert frame.encode() == bytes([0x0A, len(header)]) + header + bytes([0x12, 3]) + b"abc"
        again = Frame.decode(frame.encode())
        assert (again.kind, again.uid, again.session, again.number, again.payload) == (1, 0x20079, 5, 7, b"abc")
        assert Frame.build(3, 0x10001, 1, 1, b"", 3, 22).error == (3, 22)

    def test_messages_are_protobuf(self):
        command = messages.TwistCommand(reference_frame=3)
        command.twist.linear_z = 0.5
        assert command.SerializeToString() == bytes.fromhex("0803 1205 1d0000003f")
        info = messages.CreateSessionInfo(username="admin", session_inactivity_timeout=10000)
        assert info.SerializeToString() == bytes.fromhex("0a0561646d696e 10904e")
        gripper = messages.GripperCommand(mode=3)
        finger = gripper.gripper.finger.add()
        finger.finger_identifier, finger.value = 1, 1.0
        assert parsed(messages.GripperCommand, gripper.SerializeToString()).gripper.finger[0].value == 1.0

    def test_the_minimal_client_has_all_that_the_adapter_uses(self):
        assert all(getattr(MINIMAL, field.name) is not None for field in fields(Kortex))


class TestAdapter:
    def test_sessions_open_and_close(self, server):
        arm = here(server)
        assert server.sessions_open == 2  # commands and measurements
        assert server.connection_timeouts_ms == [500, 500]  # the arm stops by itself when the link is silent
        arm.close()
        arm.close()
        assert server.sessions_open == 0

    def test_a_wrong_password_and_a_wrong_address(self, server):
        with pytest.raises(HardwareError, match=r"No arm answers at 127\.0\.0\.1:\d+ .*user name and password"):
            here(server, password="wrong")
        server.cut()
        with pytest.raises(HardwareError, match="Check power, cable"):
            here(server)

    def test_readings_are_radians_and_metres(self, arm, server):
        reading = arm.read()
        np.testing.assert_allclose(np.rad2deg(reading.joints_rad) % 360, HOME_DEG, atol=1e-4)
        np.testing.assert_allclose(reading.tool_position_m, HOME_M, atol=1e-6)
        # 90 degrees about x, then 90 about z, axes fixed: the tool's z looks along the base's x
        w, x, y, z = reading.tool_quaternion
        np.testing.assert_allclose(
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], [1, 0, 0], atol=1e-6
        )
        assert reading.gripper == 0.0

    def test_joints_do_not_jump_where_the_arm_wraps(self, arm, server):
        """The first joint turns from 0 to below 359 degrees as the arm reports it."""
        first = arm.read().joints_rad
        for y in (0.01, 0.02, 0.03):
            server.position = [HOME_M[0], y, HOME_M[2]]
            reading = arm.read()
        assert np.rad2deg(server.joints_rad[0]) < -1
        np.testing.assert_allclose(reading.joints_rad - first, server.joints_rad - GEN3_HOME_RAD, atol=1e-5)

    def test_a_twist_moves_until_stop(self, arm, server):
        arm.prepare()
        arm.send_velocity(np.array([0.0, 0.0, 0.1]))
        time.sleep(0.2)
        arm.stop()
        risen = arm.read().tool_position_m[2] - HOME_M[2]
        assert 0.01 < risen < 0.06
        time.sleep(0.15)
        assert arm.read().tool_position_m[2] - HOME_M[2] == pytest.approx(risen, abs=0.005)

    def test_joint_velocities_move_until_stop(self, arm, server):
        arm.prepare()
        before = server.joints_rad
        arm.send_joint_velocity(np.array([0.0, 0, 0, 0, 0, 0, 0.3]))
        time.sleep(0.2)
        arm.stop()
        server.rest()
        turned = server.joints_rad - before
        assert 0.03 < turned[6] < 0.18
        np.testing.assert_allclose(turned[:6], 0, atol=1e-9)
        np.testing.assert_allclose(arm.read().tool_position_m, HOME_M, atol=1e-3)  # the last joint turns about the tool

    def test_velocities_that_are_no_numbers_are_not_sent(self, arm, server):
        arm.prepare()
        with pytest.raises(HardwareError, match="not finite"):
            arm.send_velocity(np.array([0.0, np.nan, 0.0]))
        with pytest.raises(HardwareError, match="not finite"):
            arm.send_joint_velocity(np.full(7, np.inf))
        assert not {"SendTwistCommand", "SendJointSpeedsCommand"} & set(server.names())

    def test_home_is_known_without_going_there(self, arm, server):
        np.testing.assert_allclose(np.rad2deg(arm.home_joints()), HOME_DEG, atol=1e-4)
        assert server.names()[-1] == "ReadAllActions"

    def test_an_arm_that_somebody_else_drives_is_not_taken_over(self, arm, server):
        server.manual_until = np.inf
        with pytest.raises(HardwareError, match=r"under manual control: .* It is not taken from them"):
            arm.prepare()
        assert "SetServoingMode" not in server.names()

    def test_manual_control_of_a_moment_is_waited_for(self, arm, server):
        """The arm reports it after a session has closed."""
        server.manual_until = time.monotonic() + 0.3
        arm.prepare()
        assert server.names()[-1] == "SetServoingMode"

    def test_the_gripper(self, arm, server):
        arm.set_gripper(0.8)
        assert arm.read().gripper == pytest.approx(0.8)

    def test_an_arm_in_fault_is_refused_until_cleared(self, arm, server):
        server.fault(0x10)
        with pytest.raises(HardwareError, match=r"in fault \(joint fault\)\. Release the emergency stop"):
            arm.prepare()
        arm.clear_faults()
        arm.prepare()

    def test_emergency_stop(self, arm, server):
        arm.emergency_stop()
        assert server.fault_bank == EMERGENCY
        with pytest.raises(HardwareError, match="emergency stop pressed"):
            arm.read()


def record(folder, arm, *, limits=Limits(speed_m_s=0.2), **options):
    return capture(folder, [TestCard(fps=30)], arm=arm, trajectory=lift(), limits=limits, settings=TEN_HZ, **options)


def test_a_trajectory_of_25_steps_at_10_hz(tmp_path, guarded, arm, server):
    report = record(tmp_path / "e", guarded)
    log = read_raw_episode(tmp_path / "e").robot
    # one velocity for five readings; on a machine so busy that a reading takes longer than its 20 ms, all of it is slower
    slower = max(1.0, np.median(np.diff(log.times)) / 0.02)
    assert len(server.twist_times) >= 25 / slower
    assert np.median(np.diff(server.twist_times)) == pytest.approx(0.1 * slower, rel=0.2)
    assert server.stopped_after_last_motion()
    assert report.largest_error_m < 0.03 * slower
    np.testing.assert_allclose(arm.read().tool_position_m, lift().positions[-1], atol=3e-3 * slower)
    assert len(log.times) > 80 / slower  # measured more often than commanded
    assert np.abs(np.diff(log.joints_rad, axis=0)).max() < 0.2 * slower
    assert log.tool_position_m[-1, 2] == pytest.approx(HOME_M[2] + 0.15, abs=3e-3)


@pytest.mark.parametrize(
    ("event", "message"),
    [
        ("fault", "went into fault: joint fault"),
        ("press_emergency_stop", "went into fault: emergency stop pressed"),
        ("cut", "did not carry out"),
    ],
)
def test_trouble_in_the_middle_of_a_run(tmp_path, server, event, message):
    places = []

    def happen():
        places.append(server.position)
        getattr(server, event)()

    arm = in_process(server)
    server.at_twist[8] = happen
    try:
        with pytest.raises(HardwareError, match=message):
            record(tmp_path / "e", arm)
    finally:
        arm.close()
    fastest, timeout, busy = 0.12, 0.5, 0.5
    assert np.linalg.norm(server.rest() - places[0]) < fastest * (timeout + busy + LAG_S)
    if event != "cut":  # with no link there is nothing to send it over; the arm's own timeout stops it
        assert server.stopped_after_last_motion()
    episode = read_raw_episode(tmp_path / "e")
    assert episode.description["status"] == "stopped"
    assert len(episode.robot.times) > 20
    assert len(episode.cameras["side"].frames) > 10


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (Limits(box_high_m=(0.95, 0.36, 0.5)), "outside the workspace box"),
        (Limits(), "the limit is 0.1 m/s"),
    ],
)
def test_what_leaves_the_box_or_is_too_fast_is_refused_before_the_arm_moves(tmp_path, guarded, server, limits, message):
    before = server.names()
    with pytest.raises(LimitError, match=message):
        record(tmp_path / "e", guarded, limits=limits)
    assert server.names() == before
    np.testing.assert_array_equal(server.position, HOME_M)


def test_without_kortex_api_the_error_says_where_it_is(monkeypatch):
    monkeypatch.setitem(sys.modules, "kortex_api", None)
    monkeypatch.setitem(sys.modules, "kortex_api.RouterClient", None)
    with pytest.raises(HardwareError, match=r"not on PyPI: download .*github\.com/Kinovarobotics.*protobuf==3\.20\.3"):
        load_kortex()


def test_no_thread_is_left(server):
    before = threading.active_count()
    here(server).close()
    deadline = time.monotonic() + 3
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.05)
    assert threading.active_count() <= before + 1  # the server's thread for the link may linger
