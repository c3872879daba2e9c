"""Joints, singularities, links, tool frame and contact: refused before anything moves, and noticed while it does."""

from __future__ import annotations

import itertools
import re
import time
from dataclasses import replace
from importlib.resources import as_file, files

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from diffcloud.errors import LimitError
from diffcloud.hardware import ArmLimits, ArmReading, CaptureSettings, Limits, ToolTrajectory, capture, read_trajectory
from diffcloud.hardware.arm_limits import ArmChecker, JointPath
from diffcloud.hardware.contact import Contact
from diffcloud.hardware.motion import JointFollower, Motion
from diffcloud.sensing.robot import GEN3_HOME_RAD, Robot
from tests.hardware.gen3_body import Gen3Body, home_pose, quaternion, robot
from tests.hardware.kortex.opening import in_process
from tests.hardware.kortex.server import HOME_M, MOTIONS, FakeArm
from tests.hardware.simulated import PointArm, TestCard

HOME_ROTATION = home_pose()[:3, :3]
RETRACTED_RAD = np.deg2rad([0.0, -20.0, 180.0, -146.0, 0.0, -50.0, 90.0])
"""Kinova's parking pose: joint 4 is 1.8 degrees from its end, and the tool outside the box."""
DOWN = Rotation.from_euler("y", 90, degrees=True).as_matrix() @ HOME_ROTATION


def checker(limits=Limits(), **arm_limits):
    return ArmChecker(robot(), limits, ArmLimits(**arm_limits))


def reading(joints=GEN3_HOME_RAD, gripper=0.0):
    pose = robot().tool_pose(joints)
    return ArmReading(np.array(joints), pose[:3, 3], quaternion(pose[:3, :3]), gripper, np.zeros(6))


def at(position, rotation=HOME_ROTATION):
    """A reading with the tool there, reached from home in small steps."""
    body = Gen3Body()
    turn = Rotation.from_matrix(rotation @ HOME_ROTATION.T).as_rotvec()
    for s in np.linspace(0, 1, 41)[1:]:
        body.move_tool(HOME_M + s * (position - HOME_M), Rotation.from_rotvec(s * turn).as_matrix() @ HOME_ROTATION)
    return reading(body.joints)


def line(start, end, speed=0.1, gripper=None):
    start, end = np.array(start, dtype=float), np.array(end, dtype=float)
    seconds = np.linalg.norm(end - start) / speed
    states = None if gripper is None else np.full(2, gripper)
    return ToolTrajectory(np.array([0.0, seconds]), np.stack([start, end]), states)


class TestPrediction:
    def test_the_tool_goes_where_it_should_and_does_not_turn(self):
        path = HOME_M + np.linspace(0, 1, 80)[:, None] * [0.1, 0.25, -0.2]
        joints, unreached = checker().predict(reading(), path)
        assert unreached is None
        poses = robot().tool_pose(joints)
        np.testing.assert_allclose(poses[:, :3, 3], path, atol=2e-5)
        np.testing.assert_allclose(poses[:, :3, :3], np.broadcast_to(HOME_ROTATION, (80, 3, 3)), atol=2e-5)
        assert np.abs(np.diff(joints, axis=0)).max() < 0.02

    def test_each_step_is_the_shortest_in_joint_space(self):
        """Against the pseudo-inverse of the Jacobian, from which no shorter step differs."""
        path = HOME_M + np.linspace(0, 1, 401)[:, None] * [0.0, 0.2, 0.0]
        joints, _ = checker().predict(reading(), path)
        for step in (1, 200, 399):
            twist = np.concatenate([path[step + 1] - path[step], np.zeros(3)])
            shortest = np.linalg.pinv(robot().jacobian(joints[step])) @ twist
            np.testing.assert_allclose(joints[step + 1] - joints[step], shortest, atol=1e-5)

    def test_it_starts_from_the_measured_elbow_not_from_a_usual_one(self):
        swung = elbow_out(0.8)
        joints, _ = checker().predict(reading(swung), HOME_M + np.linspace(0, 1, 20)[:, None] * [0.0, 0.0, -0.05])
        assert np.abs(joints - swung).max() < 0.25
        assert np.abs(joints - GEN3_HOME_RAD).max() > 0.5


def elbow_out(angle_rad):
    """Joints with the tool at home and the elbow swung out by about this much: motion in the Jacobian's null space."""
    joints = GEN3_HOME_RAD.copy()
    for _ in range(int(angle_rad / 0.01)):
        null = np.linalg.svd(robot().jacobian(joints))[2][-1]
        joints = joints + 0.01 * null * np.sign(null[0])
        joints = robot().inverse_kinematics(HOME_M, rotations=HOME_ROTATION, start_rad=joints)
    return joints


class TestPlan:
    """All refused by name, with the moment."""

    def test_what_is_free_passes_and_tells_where_it_ends(self):
        path = line(HOME_M, np.add(HOME_M, [0.1, 0.1, -0.2]))
        end = checker().check_trajectory("trajectory", path, reading())
        np.testing.assert_allclose(end.tool_position_m, path.positions[-1])
        np.testing.assert_allclose(robot().tool_pose(end.joints_rad)[:3, 3], path.positions[-1], atol=1e-4)

    def test_a_joint_at_its_end(self):
        """Near the base with a level tool the elbow folds up: joint 4 ends at 147.8 degrees."""
        with pytest.raises(LimitError, match=r"trajectory would break a limit at t = 0\.\d\d s: joint 4 is at -142\.\d°"):
            checker().check_trajectory("trajectory", line(HOME_M, [0.5, 0.0, 0.3]), reading())

    def test_a_singularity(self):
        """Straight up in the arm's plane, joint 6 stretches, and with it the last axis is lost."""
        with pytest.raises(LimitError, match=r"too near to a singularity at t = 1.*least singular value is 0\.0[45]"):
            checker().check_trajectory("trajectory", line(HOME_M, np.add(HOME_M, [0.0, 0.0, 0.25])), reading())

    def test_the_edge_of_the_arms_reach(self):
        limits = Limits(box_high_m=(1.3, 0.36, 0.95))
        path = line(HOME_M, [1.25, 0.0, 0.4])
        with pytest.raises(
            LimitError, match=r"approach would leave the arm's reach at t = [45]\.|too near to a singularity"
        ):
            checker(limits, singular_value=1e-9, margin_m=1.0).check_trajectory("approach", path, reading())
        with pytest.raises(LimitError, match="too near to a singularity"):
            checker(limits, margin_m=1.0).check_trajectory("approach", path, reading())

    def test_a_link_in_the_table(self):
        """The level gripper reaches 4 cm below the tool's point: its base would meet a table at 5 cm."""
        path = line([0.6, 0.1, 0.2], [0.6, 0.1, 0.08])
        checker().check_trajectory("trajectory", path, at(path.positions[0]))
        with pytest.raises(
            LimitError, match=r"robotiq_arg2f_base_link reaches down to z = 0\.05\d m; the table is at 0\.050"
        ):
            checker(table_m=0.05).check_trajectory("trajectory", path, at(path.positions[0]))

    def test_fingers_that_point_down_reach_below_the_tools_point(self):
        path = line([0.55, 0.0, 0.2], [0.55, 0.0, 0.06])
        with pytest.raises(LimitError, match=r"(left|right)_inner_finger_pad reaches down to z = 0\.00\d m"):
            checker().check_trajectory("trajectory", path, at(path.positions[0], DOWN))

    def test_fingers_that_close_reach_farther(self):
        """Closed, the pads stand 1.4 cm farther out: the trajectory's own gripper state counts."""
        start = at([0.55, 0.0, 0.2], DOWN)
        checker().check_trajectory("trajectory", line([0.55, 0.0, 0.2], [0.55, 0.0, 0.078]), start)
        with pytest.raises(LimitError, match=r"finger_pad reaches down to z = 0\.00\d m"):
            checker().check_trajectory("trajectory", line([0.55, 0.0, 0.2], [0.55, 0.0, 0.078], gripper=1.0), start)

    def test_an_elbow_outside_the_arms_space(self):
        """The tool's point is in the middle of the box."""
        path = line(HOME_M, np.add(HOME_M, [0.0, 0.0, -0.05]))
        swung = reading(elbow_out(2.4))
        np.testing.assert_allclose(swung.tool_position_m, HOME_M, atol=1e-4)
        limits = Limits(box_low_m=(0.4, -0.2, 0.055), box_high_m=(0.95, 0.2, 0.95))
        with pytest.raises(LimitError, match=r"half_arm_2_link reaches y = -0\.3\d+ m; the arm's space ends at -0\.250"):
            checker(limits, margin_m=0.05).check_trajectory("trajectory", path, swung)
        checker(limits, margin_m=0.05).check_trajectory("trajectory", path, reading())  # with the elbow up it is free

    def test_joints_that_would_have_to_be_too_fast(self):
        path = line(HOME_M, np.add(HOME_M, [0.0, 0.2, 0.0]), speed=0.2)
        checker().check_trajectory("trajectory", path, reading())
        with pytest.raises(LimitError, match=r"joint \d would have to turn with .*Multiply time_scale"):
            checker(joint_speed_rad_s=0.8).check_trajectory("trajectory", path, reading())

    def test_published_trajectories_pass_from_home(self, release):
        folder = release.parent / "trajs"
        if not folder.is_dir():
            pytest.skip("the published trajectories (trajs/) are not beside DIFFCLOUD_RELEASE")
        for name in ("lift", "fold", "stretch"):
            path = read_trajectory(folder / f"{name}_traj.npy")
            held = checker()
            start = held.check_trajectory("approach", line(HOME_M, path.positions[0]), reading())
            held.check_trajectory("trajectory", path, start)


def test_a_joint_without_limits_is_refused(tmp_path):
    text = (files("diffcloud.sensing") / "gen3_robotiq_2f_85.urdf").read_text()
    name = re.search(r'<joint name="(joint_2)" type="revolute">.*?(<limit[^>]*/>)', text, re.DOTALL)
    (tmp_path / "arm.urdf").write_text(text.replace(name[2], "", 1))
    with pytest.raises(LimitError, match="states no limits of joint_2"):
        ArmChecker(Robot.from_urdf(tmp_path / "arm.urdf"), Limits(), ArmLimits())


def test_a_description_without_surfaces_is_refused():
    bare = replace(robot().description, meshes={})
    with pytest.raises(LimitError, match=r"has no surfaces of links that move.*urdf in rig"):
        ArmChecker(Robot(bare), Limits(), ArmLimits())


class TestToolFrame:
    def test_an_arm_without_its_gripper_configured(self):
        bare = replace(reading(), tool_position_m=HOME_M - 0.12 * HOME_ROTATION[:, 2])
        with pytest.raises(
            LimitError, match=r"120 mm and 0\.0° from where .* at \[-?0\.0, -?0\.0, 120\.0\] mm in the reported"
        ):
            checker().check_tool_frame(bare)

    def test_a_tool_frame_that_is_turned(self):
        turned = HOME_ROTATION @ Rotation.from_euler("z", 90, degrees=True).as_matrix()
        with pytest.raises(LimitError, match=r"0 mm and 90\.0°"):
            checker().check_tool_frame(replace(reading(), tool_quaternion=quaternion(turned)))

    def test_what_a_calibrated_arm_differs_by_is_accepted(self):
        checker().check_tool_frame(replace(reading(), tool_position_m=np.add(HOME_M, [0.004, -0.005, 0.003])))

    def test_no_numbers_and_another_arm(self):
        with pytest.raises(LimitError, match="no numbers"):
            checker().check_tool_frame(replace(reading(), tool_position_m=np.full(3, np.nan)))
        with pytest.raises(LimitError, match="6 joints, but the URDF gen3_robotiq_2f_85 has 7"):
            checker().check_tool_frame(replace(reading(), joints_rad=np.zeros(6)))


class TestWayHome:
    def plan(self, start, speed=0.1, **arm_limits):
        held = checker(**arm_limits)
        return held, held.plan_home(GEN3_HOME_RAD, start, speed_m_s=speed)

    def test_it_begins_and_ends_where_it_should_at_rest(self):
        _, path = self.plan(reading(RETRACTED_RAD))
        np.testing.assert_allclose(path.joints_rad[0], RETRACTED_RAD)
        np.testing.assert_allclose(path.joints_rad[-1], GEN3_HOME_RAD, atol=1e-12)
        rates = np.abs(np.gradient(path.joints_rad, path.times, axis=0)).max(axis=1)
        assert rates[[0, -1]].max() < 0.05 * rates.max()

    @pytest.mark.parametrize(
        "start", [RETRACTED_RAD, np.add(GEN3_HOME_RAD, [0.5, 0.3, 0, 0, 0, -0.4, 0]), GEN3_HOME_RAD + np.eye(7)[6]]
    )
    def test_no_point_of_the_arm_is_faster_than_it_may_be(self, start):
        """Corners of all links, by differences of their positions; nearly as fast somewhere, or the limit would be idle."""
        _, path = self.plan(reading(start))
        speeds = []
        for times in np.split(np.linspace(0, path.duration_s, 1000), 10):
            poses = robot().forward_kinematics(robot().configuration(np.array([path.at(t) for t in times])))
            for index, name in enumerate(robot().links):
                if name in robot().description.meshes:
                    vertices = robot().description.meshes[name].vertices
                    points = np.einsum("tij,vj->tvi", poses[:, index, :3, :3], vertices) + poses[:, index, None, :3, 3]
                    speeds.append((np.linalg.norm(np.diff(points, axis=0), axis=-1) / np.diff(times)[0]).max())
        assert 0.06 < max(speeds) < 0.101

    def test_endless_joints_take_the_short_way(self):
        start = np.add(GEN3_HOME_RAD, [0, 0, -1.5 * np.pi, 0, 0, 0, 0])
        _, path = self.plan(reading(start))
        assert np.abs(path.joints_rad[-1] - start).max() == pytest.approx(np.pi / 2)
        np.testing.assert_allclose(robot().tool_pose(path.joints_rad[-1])[:3, 3], HOME_M, atol=1e-9)

    @pytest.mark.parametrize(
        ("now", "target", "expected"), [(190, 200, 200), (190, -160, 200), (-170, 185, -175), (350, 20, 20)]
    )
    def test_joints_with_ends_take_the_nearest_turn_within_them(self, tmp_path, now, target, expected):
        """Of 360 degrees to either side, as those of many arms; a turn beyond the end is none."""
        with as_file(files("diffcloud.hardware.examples") / "ur5e.urdf") as path:
            arm = ArmChecker(Robot.from_urdf(path), Limits(), ArmLimits())
        joints, home = np.zeros(6), np.zeros(6)
        joints[5], home[5] = np.deg2rad([now, target])
        assert np.rad2deg(arm._nearest(home, joints)[5]) == pytest.approx(expected)

    @pytest.mark.parametrize("now", [-300, -181, 200, 300, 350])
    def test_a_home_is_no_turn_at_a_joints_end(self, now):
        with as_file(files("diffcloud.hardware.examples") / "ur5e.urdf") as path:
            arm = Robot.from_urdf(path)
        checker = ArmChecker(arm, Limits(box_low_m=(-1, -1, -1), box_high_m=(1, 1, 1)), ArmLimits(table_m=-1.0))
        home = np.deg2rad([0, -100, 100, -90, -90, 0])
        joints = home + np.deg2rad([0, 0, 0, 0, 0, now])
        pose = arm.tool_pose(joints)
        reading = ArmReading(joints, pose[:3, 3], quaternion(pose[:3, :3]), 0.0, np.zeros(6))
        path = checker.plan_home(home, reading, speed_m_s=0.1)
        np.testing.assert_allclose(path.joints_rad[-1], home, atol=1e-9)

    def test_a_way_through_the_table_is_refused(self):
        with pytest.raises(
            LimitError, match=r"way home would break a limit at 0%: .* reaches down to z = 0\.1\d\d m; the table is at"
        ):
            self.plan(reading(RETRACTED_RAD), table_m=0.2)  # it would come up from there, but it cannot be there

    def test_a_way_that_leaves_the_limits_is_refused_one_that_comes_back_is_not(self):
        beyond = reading(np.deg2rad([0.0, 15.0, 180.0, -146.0, 0.0, 55.0, 90.0]))
        self.plan(beyond)
        held = checker()
        with pytest.raises(LimitError, match="joint 4"):
            held.plan_home(np.deg2rad([0.0, 15.0, 180.0, -147.0, 0.0, 55.0, 90.0]), beyond, speed_m_s=0.1)


class TestJointFollower:
    def test_a_correction_keeps_its_direction_and_hardly_outruns_the_path(self):
        arm = PointArm()
        sent = []
        arm.send_joint_velocity = sent.append
        motion = Motion(arm, checker(), Limits(), CaptureSettings(rate_hz=10.0), lambda: None)
        path = JointPath(np.linspace(0.0, 2.0, 21), GEN3_HOME_RAD + np.linspace(0, 0.1, 21)[:, None] * np.eye(7)[0])
        follower = JointFollower(motion, "way home", path, reading(), Contact(np.zeros(6), Limits()))
        off = np.array([0.05, -0.1, 0.02, 0.0, 0.0, 0.0, 0.1])
        follower.command(1.0, replace(reading(), joints_rad=path.at(1.0) - off))
        wanted = 0.05 * np.eye(7)[0] + 4.0 * off
        np.testing.assert_allclose(sent[0], wanted * 1.5 * 0.05 / np.abs(wanted).max(), rtol=1e-9, atol=1e-12)
        follower.command(1.0, replace(reading(), joints_rad=path.at(1.0)))
        np.testing.assert_allclose(sent[1], 0.05 * np.eye(7)[0], atol=1e-12)


class TestWatch:
    """What is measured while it moves."""

    def watch(self, start=None, *, returning=False, **arm_limits):
        return checker(**arm_limits).watch("trajectory", start or reading(), returning=returning)

    def test_home_is_well_inside(self):
        self.watch().check(0.0, reading())

    def test_a_tool_that_turns(self):
        turned = HOME_ROTATION @ Rotation.from_euler("z", 6, degrees=True).as_matrix()
        with pytest.raises(LimitError, match=r"At t = 0\.50 s of the trajectory the tool has turned by 6\.0°"):
            self.watch().check(0.5, replace(reading(), tool_quaternion=quaternion(turned)))

    def test_joints_and_links(self):
        ends = GEN3_HOME_RAD.copy()
        ends[3] = np.deg2rad(-146.0)
        with pytest.raises(LimitError, match=r"t = 1\.00 s of the trajectory joint 4 is at -146\.0°; its range is -147\.8"):
            self.watch().check(1.0, replace(reading(), joints_rad=ends))
        low = at([0.6, 0.1, 0.08])
        self.watch(low).check(1.0, low)
        with pytest.raises(LimitError, match=r"the table is at 0\.060"):
            self.watch(low, table_m=0.06).check(1.0, low)

    def test_a_singularity(self):
        start = reading()
        joints, _ = checker().predict(start, HOME_M + np.linspace(0, 0.25, 60)[:, None] * [0.0, 0.0, 1.0])
        with pytest.raises(LimitError, match="too near to a singularity"):
            self.watch(start).check(1.0, reading(joints[-1]))

    @pytest.mark.parametrize("returning", [False, True])
    def test_a_joint_that_is_too_fast(self, returning):
        """Planned are up to 1.2 rad/s. A joint that turns without end may begin anew."""

        def turned(angle):
            return replace(reading(), joints_rad=np.add(GEN3_HOME_RAD, [0, 0, 0, 0, 0, 0, angle]))

        watch = self.watch(returning=returning)
        watch.check(0.0, turned(0.0))
        watch.check(0.1, turned(0.2))  # over a shorter time a reading's moment is not known well enough
        watch.check(0.4, turned(0.5 + 2 * np.pi))
        with pytest.raises(LimitError, match=r"t = 0\.80 s of the trajectory joint 7 turns with 1\.50 rad/s; .* is 1\.32"):
            watch.check(0.8, turned(1.1))

    @pytest.mark.parametrize("field", ["joints_rad", "tool_position_m"])
    def test_what_is_no_number_trips(self, field):
        broken = replace(reading(), **{field: np.full(len(getattr(reading(), field)), np.nan)})
        with pytest.raises(LimitError):
            self.watch().check(1.0, broken)

    def test_a_motion_that_returns_may_only_come_nearer(self):
        watch = self.watch(reading(RETRACTED_RAD), returning=True)
        half = RETRACTED_RAD + 0.3 * (GEN3_HOME_RAD - RETRACTED_RAD)
        watch.check(0.0, reading(RETRACTED_RAD))
        watch.check(1.0, reading(half))
        with pytest.raises(LimitError, match="left the workspace box"):
            watch.check(2.0, reading(RETRACTED_RAD))


class TestContact:
    def test_the_zero_is_no_single_reading(self, tmp_path):
        """One reading in four is off by 24 N: the first would have been a zero with room for 54 N."""
        arm = PointArm()
        read = arm.read

        def noisy():
            arm.wrench = np.array([0, 0, 24.0 if len(noisy.seen) % 4 == 0 else 0.0, 0, 0, 0])
            noisy.seen.append(arm.wrench)
            return read()

        noisy.seen = []
        arm.read = noisy
        settings = CaptureSettings(rate_hz=50.0, hold_s=0.05, durable=False)
        path = ToolTrajectory(np.array([0.0, 0.4]), np.stack([arm._position, np.add(arm._position, [0, 0, 0.02])]))
        capture(tmp_path / "e", [TestCard()], arm=arm, trajectory=path, limits=Limits(force_N=18.5), settings=settings)
        with pytest.raises(LimitError, match=r"felt 18\.0 N"):
            capture(tmp_path / "f", [TestCard()], arm=arm, trajectory=path, limits=Limits(force_N=17.5), settings=settings)

    @pytest.mark.parametrize(
        ("wrench", "message"),
        [
            ([0, 0, 80, 0, 0, 0], r"At rest the tool feels 80\.0 N and 0\.0 N·m; up to 15 N and 5 N·m"),
            ([0, 0, 80, 0, 0, 0], r"not within it: force\)"),
            ([0, 0, 0, 0, 6, 0], r"6\.0 N·m.*not within it: torque\).*static_force_n in rig.yaml, which scales both"),
            ([0, 0, 80, 0, 6, 0], r"not within it: force, torque\)"),
            ([0, 0, np.nan, 0, 0, 0], "nan N"),
        ],
    )
    def test_a_preload_is_refused(self, wrench, message):
        with pytest.raises(LimitError, match=message):
            Contact(np.array(wrench, dtype=float), Limits())

    @pytest.mark.parametrize("index", range(6))
    def test_what_is_no_number_trips(self, index):
        contact = Contact(np.zeros(6), Limits())
        contact.check("now", np.full(6, 1.0))
        wrench = np.zeros(6)
        wrench[index] = np.nan
        with pytest.raises(LimitError, match="nan"):
            contact.check("now", wrench)


QUICK = CaptureSettings(rate_hz=10.0, hold_s=0.2, durable=False)


@pytest.fixture
def server():
    with FakeArm() as arm:
        yield arm


@pytest.fixture
def arm(server):
    opened = in_process(server)
    yield opened
    opened.close()


class TestLoopback:
    """The same over the wire: nothing has moved, or the arm is stopped within the distance of a few readings."""

    def record(self, folder, arm, path=None, **options):
        path = path or line(HOME_M, np.add(HOME_M, [0.0, 0.15, 0.0]))
        return capture(
            folder, [TestCard(fps=30)], arm=arm, trajectory=path, settings=options.pop("settings", QUICK), **options
        )

    @pytest.mark.parametrize(
        ("prepare", "options", "message"),
        [
            (lambda server: server.wrench.__setitem__(2, 80.0), {}, "At rest the tool feels 80.0 N"),
            (lambda server: server.wrench.__setitem__(0, np.nan), {}, "At rest the tool feels nan N"),
            (lambda server: setattr(server, "tool_offset", np.array([0, 0, -0.12])), {}, "reports its tool 120 mm"),
            (lambda server: None, {"path": line(HOME_M, [0.5, 0.0, 0.3])}, "joint 4"),
            (lambda server: None, {"path": line(HOME_M, np.add(HOME_M, [0, 0, 0.25]))}, "singularity"),
            (lambda server: None, {"arm_limits": ArmLimits(table_m=0.41)}, "the table is at"),
            (lambda server: setattr(server, "joints_rad", elbow_out(2.4)), {"arm_limits": ArmLimits(margin_m=0.05),
             "limits": Limits(box_low_m=(0.4, -0.2, 0.055), box_high_m=(0.95, 0.2, 0.95))}, "the arm's space ends at"),
            (lambda server: setattr(server, "joints_rad", RETRACTED_RAD), {}, "outside the workspace box"),
            (lambda server: setattr(server, "manual_until", np.inf), {}, "under manual control"),
        ],
    )  # fmt: skip
    def test_refused_before_anything_moves(self, tmp_path, arm, server, prepare, options, message):
        prepare(server)
        before = server.joints_rad
        with pytest.raises(Exception, match=message):
            self.record(tmp_path / "e", arm, **options)
        assert not {*MOTIONS, "SendGripperCommand"} & set(server.names())
        np.testing.assert_array_equal(server.joints_rad, before)

    @pytest.mark.parametrize(
        ("happening", "message"),
        [
            (lambda server: server.wrench.__setitem__(2, 40.0), "felt 40.0 N"),
            (lambda server: server.wrench.__setitem__(2, np.nan), "felt nan N"),
            (lambda server: server.turn_tool(np.deg2rad(8)), "the tool has turned by 8.0°"),
        ],
    )
    def test_noticed_while_it_moves(self, tmp_path, arm, server, happening, message):
        seen = []

        def happen():
            seen.append(server.position)
            happening(server)

        server.at_twist[8] = happen
        with pytest.raises(LimitError, match=message):
            self.record(tmp_path / "e", arm)
        assert np.linalg.norm(server.rest() - seen[0]) < 0.1 * (0.5 + 0.03)  # half a second for a busy machine, and the lag
        assert server.stopped_after_last_motion()

    def test_the_way_home_keeps_the_limits_and_the_gripper_waits(self, tmp_path, arm, server):
        server.joints_rad = np.deg2rad([20.0, 25.0, 180.0, -120.0, 0.0, 45.0, 90.0])
        places, asked, told, read = [], [], [], arm.read

        def watched():
            asked.append(time.monotonic())
            places.append(server.position)
            told.append(time.monotonic())
            return read()

        arm.read = watched
        path = line(np.add(HOME_M, [0.02, 0, 0]), np.add(HOME_M, [0.02, 0.05, 0.0]), gripper=1.0)
        self.record(tmp_path / "e", arm, path, settings=replace(QUICK, go_home=True))
        names = [name for name in server.names() if name in (*MOTIONS, "Stop", "SendGripperCommand")]
        order = [name for name, _ in itertools.groupby(names)]
        home, approach = ["SendJointSpeedsCommand", "Stop"], ["SendTwistCommand", "Stop"]
        assert order == [*home, *approach, "SendGripperCommand", "SendTwistCommand", "Stop"]
        apart = 10  # readings, so that a busy machine's late clock does not show as speed
        distance = np.linalg.norm(np.array(places[apart:]) - places[:-apart], axis=1)
        speed = distance / np.subtract(told[apart:], asked[:-apart])  # the least that it was: a process may have to wait
        assert 0.05 < speed.max() < 0.12  # 0.1 m/s, and what the correction adds
        np.testing.assert_allclose(server.rest(), path.positions[-1], atol=3e-3)

    def test_the_way_home_is_stopped_by_what_is_in_the_way(self, tmp_path, arm, server):
        server.joints_rad = np.deg2rad([20.0, 25.0, 180.0, -120.0, 0.0, 45.0, 90.0])
        start, read = server.position, arm.read

        def hit():
            if np.linalg.norm(server.position - start) > 0.05:
                server.wrench[0] = 40.0
            return read()

        arm.read = hit
        with pytest.raises(LimitError, match=r"of the way home the tool felt 40\.0 N"):
            self.record(tmp_path / "e", arm, settings=replace(QUICK, go_home=True))
        assert np.linalg.norm(server.rest() - start) < 0.05 + 0.1 * (0.5 + 0.03)
        assert not (tmp_path / "e").exists()
