"""Trajectories keep their limits or are refused; the controller follows a late arm without overshooting."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.errors import HardwareError, LimitError
from diffcloud.hardware import Limits, ToolTrajectory, VelocityController, check_trajectory, read_trajectory
from diffcloud.hardware.trajectory import approach

CORNER = np.array([0.5, 0.0, 0.3])
FAST = Limits(speed_m_s=0.5)


def line(distance=0.2, seconds=2.0, keyframes=21, start=CORNER):
    """Minimum jerk along x, as keyframes."""
    s = np.linspace(0, 1, keyframes)
    along = s**3 * (10 - 15 * s + 6 * s**2) * distance
    return ToolTrajectory(s * seconds, start + along[:, None] * [1.0, 0.0, 0.0])


def follow(trajectory, limits, *, clock_offset_s=0.05, rate_hz=10.0, gain=4.0, offset=0.0):
    """Positions and commanded velocities of an arm with first-order lag, at every tick."""
    controller = VelocityController(trajectory, limits, period_s=1 / rate_hz, gain=gain)
    position, velocity = trajectory.positions[0] + [0.0, offset, 0.0], np.zeros(3)
    positions, commands = [], []
    fine = 50
    for tick in range(int((trajectory.duration_s + 1.0) * rate_hz)):
        command = controller.velocity(tick / rate_hz, position)
        positions.append(position)
        commands.append(command)
        for _ in range(fine):
            velocity = velocity + (command - velocity) * (1 - np.exp(-1 / rate_hz / fine / clock_offset_s))
            position = position + velocity / rate_hz / fine
    return np.array(positions), np.array(commands)


def test_keyframes_are_passed_on_time_and_velocities_are_the_slopes():
    path = line()
    for index in (0, 7, 20):
        np.testing.assert_allclose(path.position(path.times[index]), path.positions[index], atol=1e-12)
    np.testing.assert_allclose(path.position(99.0), path.positions[-1])
    # the velocity is the derivative of the position
    t, h = 0.777, 1e-6
    np.testing.assert_allclose((path.position(t + h) - path.position(t - h)) / (2 * h), path.velocities[7], atol=1e-6)


def test_the_arm_follows_within_a_centimetre_and_ends_on_the_last_keyframe():
    path = line()
    positions, commands = follow(path, FAST)
    wanted = np.array([path.position(tick / 10) for tick in range(len(positions))])
    assert np.linalg.norm(positions - wanted, axis=1).max() < 0.012
    np.testing.assert_allclose(positions[-1], path.positions[-1], atol=1e-3)
    assert positions[:, 0].max() < path.positions[-1, 0] + 4e-3
    assert np.linalg.norm(commands[-1]) < 5e-3


def test_an_offset_fades_with_the_gain():
    path = ToolTrajectory(np.array([0.0, 2.0]), np.array([CORNER, CORNER]))
    positions, _ = follow(path, Limits(), clock_offset_s=1e-3, offset=0.02)
    error = positions[:, 1] - CORNER[1]
    np.testing.assert_allclose(error[3:6] / error[2:5], 0.6, atol=0.02)  # 1 - gain * period


def test_commands_never_exceed_speed_and_acceleration():
    path = line(distance=0.4, seconds=0.8, keyframes=9)
    limits = Limits(speed_m_s=0.3, acceleration_m_s2=1.0)
    _, commands = follow(path, limits, offset=0.05)
    assert np.linalg.norm(commands, axis=1).max() <= 0.3 + 1e-12
    steps = np.diff(np.concatenate([np.zeros((1, 3)), commands]), axis=0) * 10
    assert np.linalg.norm(steps, axis=1).max() <= 1.0 + 1e-9


def test_a_gain_that_overshoots_for_ever_is_refused():
    with pytest.raises(HardwareError, match="below 20"):
        VelocityController(line(), Limits(), period_s=0.1, gain=25.0)


@pytest.mark.parametrize(
    ("path", "limits", "message"),
    [
        (line(start=np.array([0.9, 0.0, 0.3])), {}, r"Keyframe \d+ .*outside the workspace box .*widen workspace_m"),
        (line(start=np.array([0.5, 0.0, 0.05])), {}, "Keyframe 0 .* 21 keyframes do"),
        (ToolTrajectory(line().times, 1000 * line().positions), {}, "millimetres"),
        (line(), {}, r"moves at 0\.18\d m/s; the limit is 0\.1 m/s\. .*Multiply time_scale in rig\.yaml by 1\.9"),
        (line(), {"speed_m_s": 0.5, "acceleration_m_s2": 0.2}, r"accelerates with 0\.2\d m/s²; the limit is 0\.2"),
    ],
)
def test_what_breaks_a_limit_is_refused_by_name(path, limits, message):
    with pytest.raises(LimitError, match=message):
        check_trajectory(path, Limits(**limits))


def test_what_a_refusal_suggests_is_enough():
    path = line()
    slower = ToolTrajectory(path.times * 1.97, path.positions)
    check_trajectory(slower, Limits())


def test_approach_is_straight_smooth_and_slow():
    goal = np.add(CORNER, [0.1, -0.2, 0.05])
    path = approach(CORNER, goal, speed_m_s=0.1)
    np.testing.assert_allclose(path.positions[[0, -1]], [CORNER, goal])
    assert np.linalg.norm(path.velocities, axis=1).max() == pytest.approx(0.1, rel=0.01)
    check_trajectory(path, Limits())
    assert approach(CORNER, CORNER, speed_m_s=0.1) is None


def test_trajectories_are_read_from_csv_and_npy(tmp_path):
    (tmp_path / "t.csv").write_text("t_s,x,y,z,gripper\n5,.5,0,.3,1\n5.2,.5,0,.31,1\n5.4,.5,0,.32,0\n")
    path = read_trajectory(tmp_path / "t.csv", stretch_time=2.0)
    np.testing.assert_allclose(path.times, [0, 0.4, 0.8])
    assert [path.gripper_at(t) for t in (0.0, 0.79, 0.8)] == [1.0, 1.0, 0.0]
    np.save(tmp_path / "t.npy", path.positions)
    np.testing.assert_allclose(read_trajectory(tmp_path / "t.npy", rate_hz=5).times, [0, 0.2, 0.4])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y\n0,0\n", r"columns \['z'\] are missing"),
        ("x,y,z\n0,0,0\n", "at least 2 keyframes"),
        ("t_s,x,y,z\n0,0,0,0\n0,0,0,0\n", "must start at 0 and increase"),
        ("x,y,z\n0,0,0\nnan,0,0\n", "NaN"),
        ("x,y,z,gripper\n0,0,0,0\n0,0,0,85\n", "from 0 .open. to 1"),
        ("x,y,z\na,b,c\n", "not a CSV of numbers"),
    ],
)
def test_bad_trajectories(tmp_path, text, message):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(HardwareError, match=message):
        read_trajectory(tmp_path / "t.csv")
    with pytest.raises(HardwareError, match="No such trajectory"):
        read_trajectory(tmp_path / "none.csv")


def test_limits_must_make_sense():
    with pytest.raises(LimitError, match="low < high"):
        Limits(box_low_m=(1, 0, 0), box_high_m=(0, 1, 1))
    with pytest.raises(LimitError, match="speed_m_s must be positive"):
        Limits(speed_m_s=0)


def test_published_trajectories_keep_the_limits_at_their_own_speed(release):
    folder = release.parent / "trajs"
    if not folder.is_dir():
        pytest.skip("the published trajectories (trajs/) are not beside DIFFCLOUD_RELEASE")
    for name in ("lift", "fold", "stretch"):
        path = read_trajectory(folder / f"{name}_traj.npy")
        check_trajectory(path, FAST)
        with pytest.raises(LimitError, match="time_scale"):
            check_trajectory(path, Limits())
