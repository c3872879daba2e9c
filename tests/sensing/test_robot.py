"""Kinematics against known poses and finite differences; robot descriptions of others, good and bad."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from diffcloud.errors import RobotError
from diffcloud.io.urdf import read_urdf
from diffcloud.sensing.robot import GEN3_HOME_RAD, Robot, gen3

HOME_TOOL_M = (0.5767, 0.0013, 0.4337)
"""Measured by the arm itself at its home pose."""
BOX = '<visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual>'


def write(folder: Path, body: str, name: str = "robot.urdf") -> Path:
    path = folder / name
    path.write_text(f'<robot name="test">{body}</robot>', encoding="utf-8")
    return path


def planar_arm(folder: Path, visual: str = BOX) -> Path:
    """Two links of 1 m and 0.5 m that turn about z, and a slider that mimics the second joint along x."""
    return write(
        folder,
        f"""<link name="base">{visual}</link><link name="upper"/><link name="lower"/><link name="tool_frame"/>
        <link name="slider"/>
        <joint name="b" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="1 0 0"/>
          <axis xyz="0 0 2"/><limit lower="-3" upper="3"/></joint>
        <joint name="a" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/></joint>
        <joint name="t" type="fixed"><parent link="lower"/><child link="tool_frame"/><origin xyz="0.5 0 0"/></joint>
        <joint name="s" type="prismatic"><parent link="base"/><child link="slider"/><axis xyz="1 0 0"/>
          <limit lower="0" upper="1"/><mimic joint="b" multiplier="2" offset="0.1"/></joint>""",
    )


def test_planar_arm_by_hand(tmp_path, rng):
    robot = Robot.from_urdf(planar_arm(tmp_path))
    q = rng.uniform(-2, 2, (4, 3, 2))
    a, b = q[..., 0], q[..., 1]
    expected = np.stack([np.cos(a) + 0.5 * np.cos(a + b), np.sin(a) + 0.5 * np.sin(a + b), np.zeros_like(a)], axis=-1)
    np.testing.assert_allclose(robot.tool_pose(q)[..., :3, 3], expected, atol=1e-12)
    slider = robot.forward_kinematics(robot.configuration(q))[..., robot.links.index("slider"), 0, 3]
    np.testing.assert_allclose(slider, 2 * b + 0.1, atol=1e-12)


def test_home_pose_of_the_own_arm():
    np.testing.assert_allclose(gen3().tool_pose(GEN3_HOME_RAD)[:3, 3], HOME_TOOL_M, atol=1e-4)


def test_poses_are_rigid_and_a_batch_is_its_members(rng):
    robot = gen3()
    q = robot.configuration(rng.uniform(-2, 2, (5, 7)), rng.random(5))
    poses = robot.forward_kinematics(q)
    np.testing.assert_allclose(
        poses[..., :3, :3] @ np.swapaxes(poses[..., :3, :3], -1, -2),
        np.broadcast_to(np.eye(3), (5, len(robot.links), 3, 3)),
        atol=1e-12,
    )
    np.testing.assert_allclose(poses[3], robot.forward_kinematics(q[3]), atol=1e-12)


def test_jacobian_is_the_central_difference(rng):
    robot, step = gen3(), 1e-6
    q = rng.uniform(-2, 2, 7)
    moved = robot.tool_pose(q + step * np.eye(7)), robot.tool_pose(q - step * np.eye(7))
    jacobian = robot.jacobian(q)
    np.testing.assert_allclose(jacobian[:3], ((moved[0] - moved[1])[:, :3, 3] / (2 * step)).T, atol=1e-8)
    turn = Rotation.from_matrix(moved[0][:, :3, :3] @ np.swapaxes(moved[1][:, :3, :3], -1, -2)).as_rotvec()
    np.testing.assert_allclose(jacobian[3:], (turn / (2 * step)).T, atol=1e-8)


def test_inverse_kinematics_returns_along_a_smooth_path():
    robot = gen3()
    home = robot.tool_pose(GEN3_HOME_RAD)
    path = home[:3, 3] + np.linspace(0, 1, 25)[:, None] * [0.1, 0.1, -0.25]
    joints = robot.inverse_kinematics(path, rotations=home[:3, :3])
    reached = robot.tool_pose(joints)
    np.testing.assert_allclose(reached[:, :3, 3], path, atol=2e-5)
    np.testing.assert_allclose(reached[:, :3, :3], np.broadcast_to(home[:3, :3], (25, 3, 3)), atol=5e-5)
    assert np.abs(np.diff(joints, axis=0)).max() < 0.1  # no jump to another branch


def test_fingers_close():
    robot = gen3()
    pads = [robot.links.index(f"{side}_inner_finger_pad") for side in ("left", "right")]
    gaps = [
        np.linalg.norm(np.diff(robot.forward_kinematics(robot.configuration(GEN3_HOME_RAD, state))[pads, :3, 3], axis=0))
        for state in (0.0, 0.5, 1.0)
    ]
    assert gaps[0] > gaps[1] > gaps[2]


@pytest.mark.parametrize("limits", ["0.0 0.04", "-0.04 0.0"])
def test_open_is_where_fingers_are_farther_apart(tmp_path, limits):
    """Of a hand whose joint is at its upper end when it is open, and of one at its lower end."""
    lower, upper = map(float, limits.split())
    outwards = 1 if upper else -1
    finger = """<joint name="{name}" type="prismatic"><parent link="tool_frame"/><child link="{name}_link"/>
        <axis xyz="0 {way} 0"/><limit lower="{lower}" upper="{upper}"/>{mimic}</joint>"""
    path = write(
        tmp_path,
        f"""<link name="base"/><link name="tool_frame">{BOX}</link>
        <joint name="a" type="continuous"><parent link="base"/><child link="tool_frame"/><axis xyz="0 0 1"/></joint>"""
        + "".join(
            f'<link name="{name}_link"><visual><geometry><box size="0.01 0.01 0.03"/></geometry></visual></link>'
            for name in ("l", "r")
        )
        + finger.format(name="l", way=outwards, lower=lower, upper=upper, mimic="")
        + finger.format(name="r", way=-outwards, lower=lower, upper=upper, mimic='<mimic joint="l"/>'),
    )
    robot = Robot.from_urdf(path)
    for gripper, expected in ((0.0, 0.04), (1.0, 0.0), (0.5, 0.02), (np.nan, 0.04)):
        poses = robot.forward_kinematics(robot.configuration(np.zeros(1), gripper))
        assert poses[robot.links.index("l_link"), 1, 3] == pytest.approx(expected)
        assert poses[robot.links.index("r_link"), 1, 3] == pytest.approx(-expected)


def test_prefixes_that_nothing_declares_are_read_over(tmp_path):
    """Drake's and Gazebo's, as ROS reads them; a declared name space changes no name either."""
    plain = planar_arm(tmp_path)
    text = plain.read_text()
    foreign = "<drake:proximity_properties><drake:rigid_hydroelastic/></drake:proximity_properties>"
    text = text.replace('<limit lower="-3"', '<limit drake:acceleration="2.5" lower="-3"').replace(
        "</robot>", f"{foreign}</robot>"
    )
    (tmp_path / "drake.urdf").write_text(text)
    (tmp_path / "declared.urdf").write_text(text.replace("<robot ", '<robot xmlns="http://a.b" xmlns:drake="http://c.d" '))
    expected = Robot.from_urdf(plain).tool_pose(np.array([0.3, -0.7]))
    for name in ("drake.urdf", "declared.urdf"):
        np.testing.assert_array_equal(Robot.from_urdf(tmp_path / name).tool_pose(np.array([0.3, -0.7])), expected)
    (tmp_path / "grows.urdf").write_text('<!DOCTYPE a [<!ENTITY b "c">]>' + text)
    with pytest.raises(RobotError, match="declares a document type or entities"):
        read_urdf(tmp_path / "grows.urdf")
    for damaged in (text[:-20], text + "<robot/>", text.replace("drake:acceleration=", "lower="), ""):
        (tmp_path / "damaged.urdf").write_text(damaged)
        with pytest.raises(RobotError, match="is not readable XML"):
            read_urdf(tmp_path / "damaged.urdf")


def test_bad_poses(tmp_path):
    robot = gen3()
    with pytest.raises(RobotError, match="does not reach"):
        robot.inverse_kinematics(np.array([[0.5, 0.0, 0.4], [3.0, 0.0, 0.5]]))
    with pytest.raises(RobotError, match="another arm"):
        robot.configuration(np.zeros(6))
    with pytest.raises(RobotError, match="no link 'hand'"):
        Robot.from_urdf(planar_arm(tmp_path), tool="hand")


def mesh(filename: str) -> str:
    return f'<visual><geometry><mesh filename="{filename}"/></geometry></visual>'


def write_stl(path: Path, size: float = 0.1) -> Path:
    import trimesh

    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(extents=[size] * 3).export(path)
    return path


@pytest.mark.parametrize("name", ["meshes/a.stl", "package://arm/meshes/a.stl", "package://meshes/a.stl"])
def test_meshes_are_found_in_the_folder(tmp_path, name):
    write_stl(tmp_path / "meshes" / "a.stl")
    found = read_urdf(planar_arm(tmp_path, mesh(name))).meshes["base"]
    np.testing.assert_allclose(np.abs(found.vertices), 0.05, atol=1e-7)


def test_collada_is_read_with_its_unit_and_without_its_axis(tmp_path):
    (tmp_path / "a.dae").write_text(
        """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
        <asset><created>2020-01-01T00:00:00</created><modified>2020-01-01T00:00:00</modified>
        <unit name="millimeter" meter="0.001"/><up_axis>Y_UP</up_axis></asset>
        <library_geometries><geometry id="g"><mesh><source id="p"><float_array id="pa" count="9">0 0 0 20 0 0 0 30 40
        </float_array><technique_common><accessor source="#pa" count="3" stride="3"><param name="X" type="float"/>
        <param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
        <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
        <triangles count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles></mesh></geometry>
        </library_geometries><library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node>
        </visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>""",
        encoding="utf-8",
    )
    found = read_urdf(planar_arm(tmp_path, mesh("a.dae"))).meshes["base"]
    np.testing.assert_allclose(found.vertices, [[0, 0, 0], [0.02, 0, 0], [0, 0.03, 0.04]], atol=1e-9)


@pytest.mark.parametrize("name", ["../secret.stl", "package://arm/../../secret.stl", "/secret.stl", "file:///etc/passwd"])
def test_meshes_outside_the_folder_are_refused(tmp_path, name):
    write_stl(tmp_path / "secret.stl")
    (tmp_path / "robot").mkdir()
    with pytest.raises(RobotError, match="outside"):
        read_urdf(planar_arm(tmp_path / "robot", mesh(name)))


def test_a_link_to_the_outside_is_refused(tmp_path):
    write_stl(tmp_path / "secret.stl")
    (tmp_path / "robot").mkdir()
    os.symlink(tmp_path / "secret.stl", tmp_path / "robot" / "a.stl")
    with pytest.raises(RobotError, match="outside"):
        read_urdf(planar_arm(tmp_path / "robot", mesh("a.stl")))


def test_missing_damaged_and_oversized_meshes(tmp_path):
    with pytest.raises(RobotError, match=r"gone\.stl' is missing"):
        read_urdf(planar_arm(tmp_path, mesh("gone.stl")))
    (tmp_path / "bad.dae").write_text("<COLLADA", encoding="utf-8")
    with pytest.raises(RobotError, match=r"bad\.dae is not a readable mesh"):
        read_urdf(planar_arm(tmp_path, mesh("bad.dae")))
    write_stl(tmp_path / "large.stl", 100.0)
    with pytest.raises(RobotError, match="millimetres"):
        read_urdf(planar_arm(tmp_path, mesh("large.stl")))
    (tmp_path / "a.exe").touch()
    with pytest.raises(RobotError, match="mesh format"):
        read_urdf(planar_arm(tmp_path, mesh("a.exe")))


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("", "no link"),
        ('<link name="a"/><link name="a"/>', "once"),
        ('<link name="a"/><link name="b"/>', "one tree"),
        ('<link name="a"/><joint name="j" type="fixed"><parent link="a"/><child link="x"/></joint>', "no link 'x'"),
        ('<link name="a"/><joint name="j" type="floating"><parent link="a"/><child link="a"/></joint>', "Unknown type"),
        ('<link name="a"/><joint name="j" type="fixed"><parent link="a"/><child link="a"/></joint>', "tree"),
        ('<link name="a"><visual><geometry><box size="1 2"/></geometry></visual></link>', "3 numbers of at most 1000"),
        (
            '<link name="a"><visual><geometry><box size="1 2 0"/></geometry></visual></link>',
            "positive, got '1 2 0'",
        ),
        ('<link name="a"><visual><geometry><sphere radius="1e300"/></geometry></visual></link>', "at most 1000"),
        ('<link name="a"><visual><geometry/><geometry/></visual></link>', "<visual>  has <geometry> twice"),
        ('<link name="a"><visual><geometry><cone/></geometry></visual></link>', "Unknown shape"),
    ],
)
def test_bad_descriptions(tmp_path, body, message):
    with pytest.raises(RobotError, match=message):
        read_urdf(write(tmp_path, body))


def test_entities_and_other_files_are_refused(tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_text('<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="&x;"/>', encoding="utf-8")
    with pytest.raises(RobotError, match="entities"):
        read_urdf(path)
    path.write_text("<robot", encoding="utf-8")
    with pytest.raises(RobotError, match="not readable XML"):
        read_urdf(path)
    with pytest.raises(RobotError, match="No such robot description"):
        read_urdf(tmp_path / "gone.urdf")


def test_the_makers_description():
    """The real arm's URDF, where there is one."""
    path = os.environ.get("DIFFCLOUD_ROBOT")
    if not path:
        pytest.skip("DIFFCLOUD_ROBOT is not set (a URDF of the Kinova Gen3 with its meshes)")
    robot = Robot.from_urdf(Path(path))
    np.testing.assert_allclose(robot.tool_pose(GEN3_HOME_RAD)[:3, 3], HOME_TOOL_M, atol=1e-4)
    assert len(robot.description.meshes) == 19
