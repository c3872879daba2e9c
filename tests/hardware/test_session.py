"""Whatever ends a capture, the arm is stopped and what was recorded is kept."""

from __future__ import annotations

import errno
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from diffcloud.errors import DiffCloudError, EpisodeError, HardwareError, LimitError, UnconfirmedStopError
from diffcloud.hardware import CaptureSettings, Limits, capture, motion, session
from diffcloud.hardware.trajectory import ToolTrajectory
from diffcloud.io.raw_episodes import RawEpisodeWriter, read_raw_episode
from diffcloud.sensing.validation.episode import validate_raw_episode
from tests.hardware.simulated import START, PointArm, TestCard, short_path

BESIDE = np.add(START, [0.02, 0, 0])
QUICK = CaptureSettings(rate_hz=50.0, hold_s=0.05, durable=False)


def run(folder, arm, *, cameras=None, path=None, limits=None, settings=QUICK):
    cameras = [TestCard()] if cameras is None else cameras
    return capture(folder, cameras, arm=arm, trajectory=path or short_path(), limits=limits, settings=settings)


def test_a_capture_to_its_end(tmp_path):
    arm, cameras = PointArm(), [TestCard("side"), TestCard("overhead")]
    report = run(tmp_path / "e", arm, cameras=cameras)
    assert arm.stopped
    assert "close" not in arm.events  # the arm was lent
    assert all(camera.events == ["open", "close"] for camera in cameras)
    assert report.largest_error_m < 0.02
    episode = read_raw_episode(tmp_path / "e")
    assert episode.description["status"] == "complete"
    for name, camera in episode.cameras.items():
        assert report.frames[name] == len(camera.frames) > 10
        numbers = [int(camera.depth(index)[0, 0]) for index in range(len(camera.frames))]
        assert np.diff(numbers).tolist() == [1] * (len(numbers) - 1)  # none lost
    log = episode.robot
    assert np.interp(0.4, log.times, log.tool_position_m[:, 2]) == pytest.approx(START[2] + 0.02, abs=0.01)
    within = max(0.002, report.largest_error_m)  # on a busy machine the arm lags; the report says by how much
    assert log.tool_position_m[-1, 2] == pytest.approx(START[2] + 0.02, abs=within)
    codes = {finding.code for finding in validate_raw_episode(tmp_path / "e")}
    assert not codes & {"short_robot_log", "clock_backwards", "missing_frames"}


def test_what_encodes_images_is_there_before_anything_opens(tmp_path, monkeypatch):
    order = []
    monkeypatch.setattr(session, "import_module", lambda name: order.append(name))
    camera = TestCard()
    opened = camera.open
    monkeypatch.setattr(camera, "open", lambda: order.append("open") or opened())
    capture(tmp_path / "e", [camera], seconds=0.1, settings=QUICK)
    assert order == ["cv2", "open"]


def test_frames_beyond_the_rate_are_not_written(tmp_path):
    camera = TestCard(fps=200)
    report = capture(tmp_path / "e", [camera], seconds=0.5, settings=replace(QUICK, frames_hz=20.0))
    assert 5 <= report.frames["side"] <= 11 < camera.delivered


def test_cameras_alone(tmp_path):
    report = capture(tmp_path / "e", [TestCard()], seconds=0.1, settings=QUICK)
    assert report.robot_rows == 0
    assert read_raw_episode(tmp_path / "e").robot is None


def test_the_start_is_approached_slowly_then_recorded(tmp_path):
    arm = PointArm()
    path = ToolTrajectory(np.array([0.0, 0.1]), np.array([BESIDE, np.add(BESIDE, [0, 0, 0.005])]))
    run(tmp_path / "e", arm, path=path)
    log = read_raw_episode(tmp_path / "e").robot
    np.testing.assert_allclose(log.tool_position_m[0], BESIDE, atol=2e-3)


def test_the_gripper_waits_for_the_end_of_the_way(tmp_path):
    arm = PointArm()
    base = short_path()
    path = ToolTrajectory(base.times, np.add(base.positions, [0.01, 0, 0]), np.array([0.0, 0, 1, 1, 1]))
    run(tmp_path / "e", arm, path=path, settings=replace(QUICK, go_home=True))
    events = [event for event, _ in itertools.groupby(arm.events)]
    home, approach, rest = ["prepare", "turn", "stop"], ["prepare", "twist", "stop"], ["gripper 0", "prepare"]
    assert events == [*home, *approach, *rest, "gripper 0", "twist", "gripper 1", "twist", "stop"]


def test_a_gripper_that_says_nothing_is_given_its_time(tmp_path, monkeypatch):
    class Silent(PointArm):
        def set_gripper(self, position):
            super().set_gripper(position)
            self.gripper = None
            asked.append(time.monotonic())

        def send_velocity(self, linear_m_s):
            super().send_velocity(linear_m_s)
            if asked:
                moved.append(time.monotonic())

    asked, moved = [], []
    monkeypatch.setattr(motion, "_GRIPPER_WAIT_S", 0.8)
    base = short_path()
    path = ToolTrajectory(base.times, np.add(base.positions, [0.01, 0, 0]), np.zeros(len(base.times)))
    run(tmp_path / "e", Silent(), path=path)
    assert moved[0] - asked[0] > 0.8


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"path": short_path(distance=0.9)}, "outside the workspace box"),
        ({"path": short_path(distance=0.2)}, "moves at 0.500 m/s; the limit is 0.1"),
        (
            {"settings": replace(QUICK, rate_hz=2.0)},
            r"at 2 Hz overshoots for ever: the arm needs control_rate_hz \(rig\.yaml\) above 2 Hz",
        ),
    ],
)
def test_refused_before_anything_opens_or_moves(tmp_path, changes, message):
    arm, camera = PointArm(), TestCard()
    with pytest.raises(LimitError, match=message):
        run(tmp_path / "e", arm, cameras=[camera], **changes)
    assert arm.events == camera.events == []
    assert not (tmp_path / "e").exists()


def test_other_refusals(tmp_path):
    with pytest.raises(HardwareError, match="at least one camera"):
        capture(tmp_path / "e", [], seconds=1)
    with pytest.raises(HardwareError, match="--seconds"):
        capture(tmp_path / "e", [TestCard()])
    with pytest.raises(HardwareError, match="needs a trajectory"):
        capture(tmp_path / "e", [TestCard()], arm=PointArm())
    (tmp_path / "e").mkdir()
    arm = PointArm()
    with pytest.raises(EpisodeError, match="never overwritten"):
        run(tmp_path / "e", arm)
    assert arm.events == []


def test_a_tool_outside_the_box_is_not_moved(tmp_path):
    arm = PointArm()
    with pytest.raises(LimitError, match=r"The tool is at .* outside the workspace box"):
        run(tmp_path / "e", arm, limits=Limits(box_low_m=(0.4, -0.3, 0.315)), path=short_path_above())
    assert "twist" not in arm.events


def short_path_above():
    base = short_path()
    return ToolTrajectory(base.times, np.add(base.positions, [0, 0, 0.02]))


def push(arm):
    arm.wrench[2] = 50.0


def twist_hard(arm):
    arm.wrench[4] = 11.0


def hold(arm):
    arm.hold = True


def throw(arm):
    arm._position = np.add(arm._position, [0.0, 0.5, 0.0])


def fail(arm):
    raise HardwareError("the arm went into fault")


def interrupt(arm):
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.05)


def terminate(arm):
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(0.05)


def bug(arm):
    raise ZeroDivisionError("a bug")


@pytest.mark.parametrize(
    ("trouble", "kind", "message"),
    [
        (push, LimitError, "felt 50.0 N"),
        (twist_hard, LimitError, "11.0 N·m"),
        (throw, LimitError, "left the workspace box"),
        (fail, HardwareError, "went into fault"),
        (interrupt, KeyboardInterrupt, None),
        (terminate, KeyboardInterrupt, "SIGTERM"),
        (bug, ZeroDivisionError, "a bug"),
    ],
)
def test_every_exit_stops_the_arm_and_keeps_the_data(tmp_path, trouble, kind, message):
    arm = PointArm({9: trouble})
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(kind, match=message):
        run(tmp_path / "e", arm)
    assert arm.stopped
    assert "twist" in arm.events
    assert ("halt" in arm.events) == (kind is KeyboardInterrupt)  # the signal's handler itself sends Stop
    assert signal.getsignal(signal.SIGTERM) == before
    episode = read_raw_episode(tmp_path / "e")
    assert episode.description["status"] == "stopped"
    assert len(episode.robot.times) >= 7
    assert len(episode.cameras["side"].frames) >= 1
    assert not [thread for thread in threading.enumerate() if thread.name.startswith(("side", "robot_write"))]


def test_an_arm_that_is_held_is_noticed_by_its_distance(tmp_path):
    arm = PointArm({3: hold})
    with pytest.raises(LimitError, match="mm from the trajectory"):
        run(
            tmp_path / "e",
            arm,
            path=short_path(0.05, 0.2),
            limits=Limits(tracking_error_m=0.02, speed_m_s=0.3, acceleration_m_s2=9),
        )
    assert arm.stopped


def test_a_camera_that_dies(tmp_path):
    arm = PointArm()
    cameras = [TestCard("overhead"), TestCard("side", dies_after=6)]
    with pytest.raises(HardwareError, match="Camera side delivered no frame"):
        run(tmp_path / "e", arm, cameras=cameras)
    assert arm.stopped
    assert all("close" in camera.events for camera in cameras)
    kept = read_raw_episode(tmp_path / "e").cameras["side"]
    assert [int(kept.depth(index)[0, 0]) for index in range(len(kept.frames))] == [1, 2, 3, 4, 5, 6]


def test_a_full_disk_stops_the_arm(tmp_path, monkeypatch):
    replace, count = os.replace, []

    def full(source, target):
        if str(target).endswith(".png"):
            count.append(target)
            if len(count) > 8:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    arm = PointArm()
    with pytest.raises(DiffCloudError, match=r"Frame 4 of camera side could not be written.*No space left"):
        run(tmp_path / "e", arm)
    assert arm.stopped
    episode = read_raw_episode(tmp_path / "e")
    assert len(episode.cameras["side"].frames) == 4
    assert "No space left" in episode.description["stop_reason"]


def test_the_control_loop_writes_to_no_disk(tmp_path, monkeypatch):
    """While the arm moves, its thread neither appends a row nor waits for the disk."""
    arm, loop, seen = PointArm(), threading.current_thread(), []

    def spied(call):
        def spy(*arguments):
            if not arm.stopped:
                seen.append(threading.current_thread())
            return call(*arguments)

        return spy

    monkeypatch.setattr(RawEpisodeWriter, "add_robot", spied(RawEpisodeWriter.add_robot))
    monkeypatch.setattr(os, "fsync", spied(os.fsync))
    monkeypatch.setattr(os, "replace", spied(os.replace))
    report = run(tmp_path / "e", arm, settings=replace(QUICK, durable=True))
    assert seen  # others have written
    assert loop not in seen
    assert report.robot_rows == len(read_raw_episode(tmp_path / "e").robot.times) > 15


def test_a_disk_that_refuses_the_arms_log_stops_the_arm(tmp_path, monkeypatch):
    def refuse(self, *samples):
        raise DiffCloudError("Cannot write robot.csv: No space left on device.")

    monkeypatch.setattr(RawEpisodeWriter, "add_robot", refuse)
    arm = PointArm()
    with pytest.raises(DiffCloudError, match=r"robot\.csv: No space left"):
        run(tmp_path / "e", arm, path=short_path(0.02, 2.0))
    assert arm.stopped
    assert arm.events.count("twist") < 50  # not only at the end


@pytest.mark.parametrize("trouble", [{}, {9: fail}])
def test_a_stop_that_is_not_confirmed_is_told(tmp_path, trouble):
    class Deaf(PointArm):
        def stop(self):
            super().stop()
            raise UnconfirmedStopError("THE ARM MAY STILL BE MOVING")

    told = []
    with pytest.raises(HardwareError) as raised:
        capture(tmp_path / "e", [TestCard()], arm=Deaf(trouble), trajectory=short_path(), settings=QUICK, tell=told.append)
    assert "THE ARM MAY STILL BE MOVING" in told
    assert isinstance(raised.value, UnconfirmedStopError) == (not trouble)


def test_an_arm_that_nobody_watches_is_refused(tmp_path):
    class Bare:
        joint_count = 7

    with pytest.raises(HardwareError, match=r"ArmProcess.*got Bare"):
        capture(tmp_path / "e", [TestCard()], arm=Bare(), trajectory=short_path())


def test_a_camera_whose_clock_runs_backwards_ends_the_capture(tmp_path):
    """Not one with a part of the frames that calls itself complete."""

    class Jumping(TestCard):
        def read(self, timeout_s):
            frame = super().read(timeout_s)
            return replace(frame, time_s=frame.time_s - (5.0 if self.delivered > 10 else 0.0))

    with pytest.raises(HardwareError, match=r"Camera side: its clock ran backwards by 4\.9"):
        capture(tmp_path / "e", [Jumping()], seconds=5, settings=QUICK)
    episode = read_raw_episode(tmp_path / "e")
    assert (episode.description["status"], len(episode.cameras["side"].frames)) == ("stopped", 10)


def test_a_camera_whose_clock_is_behind_ends_the_capture(tmp_path):
    """All of its frames would be taken for left over from before the start."""

    class Behind(TestCard):
        def read(self, timeout_s):
            frame = super().read(timeout_s)
            return replace(frame, time_s=frame.time_s - 1e9)

    with pytest.raises(HardwareError, match=r"Camera side: its clock is behind by 1e\+09 s"):
        capture(tmp_path / "e", [Behind()], seconds=5, settings=replace(QUICK, camera_timeout_s=0.1))


def test_a_camera_whose_clock_is_ahead_ends_the_capture(tmp_path):
    """Such times would be written, and nothing could read the recording again."""

    class Ahead(TestCard):
        def read(self, timeout_s):
            frame = super().read(timeout_s)
            return replace(frame, time_s=frame.time_s + (1e9 if self.delivered > 10 else 0.0))

    with pytest.raises(HardwareError, match=r"Camera side: its clock is ahead by 1e\+09 s"):
        capture(tmp_path / "e", [Ahead()], seconds=5, settings=QUICK)
    assert len(read_raw_episode(tmp_path / "e").cameras["side"].frames) == 10


def test_a_driver_that_hangs_ends_the_capture(tmp_path):
    """It neither delivers nor raises; its thread is left behind, what the other camera delivered is kept."""
    freed = threading.Event()

    class Hanging(TestCard):
        def read(self, timeout_s):
            if self.delivered == 5:
                freed.wait(60)
            return super().read(timeout_s)

    arm, began = PointArm(), time.monotonic()
    settings = replace(QUICK, camera_timeout_s=0.2, hold_s=20.0)
    with pytest.raises(HardwareError, match=r"Camera side: its driver has not come back for 0\.7 s"):
        run(tmp_path / "e", arm, cameras=[TestCard("overhead"), Hanging()], settings=settings)
    assert time.monotonic() - began < 20
    assert arm.stopped
    assert len(read_raw_episode(tmp_path / "e").cameras["side"].frames) == 5
    freed.set()


@pytest.mark.parametrize(
    ("name", "call"), [("Camera side, writing a frame", "add_frame"), ("Writing robot.csv", "add_robot")]
)
def test_a_bug_in_a_thread_that_writes_stops_the_arm(tmp_path, monkeypatch, name, call):
    """Not only errors of this project: a thread that ended in silence would be waited for, for ever."""

    def bug(self, *arguments):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(RawEpisodeWriter, call, bug)
    arm = PointArm()
    with pytest.raises(HardwareError, match=f"{name}: ZeroDivisionError: a bug"):
        run(tmp_path / "e", arm, path=short_path(0.02, 2.0), settings=replace(QUICK, hold_s=20.0))
    assert arm.stopped


def test_setting_the_time_of_day_changes_nothing(tmp_path, monkeypatch):
    right, start = time.time, time.monotonic()
    monkeypatch.setattr(time, "time", lambda: right() - (3600.0 if time.monotonic() > start + 0.3 else 0.0))
    camera = TestCard(fps=100)
    report = capture(tmp_path / "e", [camera], seconds=1.0, settings=QUICK)
    assert report.frames["side"] >= camera.delivered - 2  # the first may be older than the start, the last come too late
    assert np.diff(read_raw_episode(tmp_path / "e").cameras["side"].times).min() > 0


def test_a_closed_terminal_stops_the_arm(tmp_path):
    """SIGHUP in a process of its own, whose default would be to die at once."""
    code = """
import os, signal, sys
from diffcloud.hardware import CaptureSettings, capture
from tests.hardware.simulated import PointArm, TestCard, short_path
arm = PointArm({9: lambda arm: os.kill(os.getpid(), signal.SIGHUP)})
try:
    capture(sys.argv[1], [TestCard()], arm=arm, trajectory=short_path(), settings=CaptureSettings(rate_hz=50.0))
except KeyboardInterrupt:
    print("stopped" if arm.stopped else "moving")
"""
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "e"], env=env, capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "stopped", done.stderr
