"""Robot kinematics: link poses from joint angles, and joint angles from tool poses.

The world frame is the robot's base frame, i.e. that of the model's root link. The arm is the chain of moving joints
from the root to the tool link. All other moving joints (the gripper's fingers) follow the gripper's state.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffcloud.errors import RobotError
from diffcloud.io.urdf import Joint, RobotDescription, link_names, read_urdf

Floats = NDArray[np.float64]

TOOL_LINK = "tool_frame"
GEN3_HOME_RAD = np.deg2rad([0.0, 15.0, 180.0, -130.0, 0.0, 55.0, 90.0])
"""Kinova's home pose of the Gen3 arm."""
_DAMPING = 1e-3
_ROUNDING_M = 1e-6
_LONGEST_STEP_RAD = 0.3
"""Maximum step; the linearisation is inaccurate beyond."""


def gen3() -> Robot:
    """Return the package's own Kinova Gen3 (7 joints) with a Robotiq 2F-85: published joint constants, cylinders and
    boxes. The links cover the manufacturers' surfaces to within 5 mm (measured at the vertices of their meshes)."""
    with as_file(files("diffcloud.sensing") / "gen3_robotiq_2f_85.urdf") as path:
        return Robot.from_urdf(path)


@dataclass(frozen=True)
class Robot:
    """Kinematics of a robot."""

    description: RobotDescription
    tool: str = TOOL_LINK
    """Link whose pose is the tool pose."""

    def __post_init__(self) -> None:
        if self.tool not in self.links:
            raise RobotError(f"{self.description.name} has no link {self.tool!r}; its links are {', '.join(self.links)}.")

    @staticmethod
    def from_urdf(path: Path, *, tool: str = TOOL_LINK) -> Robot:
        """Read a robot from a URDF file.

        Raises:
            RobotError: see `read_urdf`; or the tool link is missing.
        """
        return Robot(read_urdf(path), tool)

    @cached_property
    def links(self) -> tuple[str, ...]:
        """Names of the L links, in the order of `forward_kinematics`."""
        return tuple(link_names(self.description))

    @cached_property
    def moving(self) -> tuple[Joint, ...]:
        """The A independent joints, in the order of a configuration."""
        return tuple(joint for joint in self.description.joints if joint.kind != "fixed" and joint.mimic is None)

    @cached_property
    def arm(self) -> NDArray[np.int64]:
        """[J] indices in a configuration of the joints that carry the tool, from the root outwards."""
        carrier = {joint.child: joint for joint in self.description.joints}
        chain, link = [], self.tool
        while link in carrier:
            chain.append(carrier[link].name)
            link = carrier[link].parent
        return np.array([index for index, joint in enumerate(self.moving) if joint.name in chain], dtype=np.int64)

    def configuration(self, joints_rad: Floats, gripper: Floats | float = 0.0) -> Floats:
        """Return the angles [..., A] of all moving joints.

        Args:
            joints_rad: [..., J] arm joints, from the base to the tool.
            gripper: [...] 0 open to 1 closed; the other joints are interpolated between their limits (`fingers`). NaN
                (unknown) is treated as open, because the fingers then reach farthest.

        Raises:
            RobotError: the number of joints differs from the arm's.
        """
        joints_rad = np.asarray(joints_rad, dtype=np.float64)
        if joints_rad.shape[-1:] != (len(self.arm),):
            raise RobotError(
                f"{self.description.name} has {len(self.arm)} joints between its base and {self.tool}, the joint log "
                f"{joints_rad.shape[-1]}: it is the log, or the description, of another arm."
            )
        opened, closed = self.fingers
        state = np.nan_to_num(np.broadcast_to(gripper, joints_rad.shape[:-1]))[..., None]
        angles = opened + (closed - opened) * np.clip(state, 0.0, 1.0)
        angles[..., self.arm] = joints_rad
        return angles

    @cached_property
    def fingers(self) -> tuple[Floats, Floats]:
        """[A] configurations with open and with closed gripper, at the limits of the finger joints; zero for joints
        without limits. The model does not state which limit is open. A Robotiq 2F-85 is open at the lower limit, a
        Franka Hand at the upper. So the limit at which the fingers' surfaces are farther apart is taken as open."""
        low, high = (np.array([getattr(joint, end) for joint in self.moving]) for end in ("lower", "upper"))
        bounded = np.isfinite(low) & np.isfinite(high)
        low, high = np.where(bounded, low, 0.0), np.where(bounded, high, 0.0)
        low[self.arm] = high[self.arm] = 0.0
        return (high, low) if self._spread(high) > self._spread(low) + _ROUNDING_M else (low, high)

    def _spread(self, configuration: Floats) -> float:
        """Return the RMS distance [m] of the corners of all finger links from their mean; 0 without such links."""
        poses = self.forward_kinematics(configuration)
        own = {self.moving[index].name for index in range(len(self.moving)) if index not in self.arm}
        moved = set[str]()
        for joint in self.description.joints:  # from the root outwards
            leader = joint.name if joint.mimic is None else joint.mimic.joint
            if leader in own or joint.parent in moved:
                moved.add(joint.child)
        corners = [
            mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
            for name in sorted(moved & self.description.meshes.keys())
            for mesh, pose in [(self.description.meshes[name], poses[self.links.index(name)])]
        ]
        if not corners:
            return 0.0
        points = np.concatenate(corners)
        return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))

    def forward_kinematics(self, configuration: Floats) -> Floats:
        """Return T_world_link [..., L, 4, 4] of all links for configurations [..., A] [rad or m]."""
        configuration = np.asarray(configuration, dtype=np.float64)
        if configuration.shape[-1:] != (len(self.moving),):
            raise RobotError(
                f"{self.description.name} has {len(self.moving)} moving joints, not {list(configuration.shape)}."
            )
        batch = configuration.shape[:-1]
        column = {joint.name: index for index, joint in enumerate(self.moving)}
        place = {name: index for index, name in enumerate(self.links)}
        poses = np.empty((*batch, len(self.links), 4, 4))
        poses[..., 0, :, :] = np.eye(4)
        for joint in self.description.joints:  # each link needs its parent's pose; a batch is one operation
            here = poses[..., place[joint.parent], :, :] @ joint.T_parent_joint
            if joint.kind != "fixed":
                leader = joint.name if joint.mimic is None else joint.mimic.joint
                angle = configuration[..., column[leader]]
                if joint.mimic is not None:
                    angle = joint.mimic.multiplier * angle + joint.mimic.offset
                here = here @ _motion(joint, angle)
            poses[..., place[joint.child], :, :] = here
        return poses

    def tool_pose(self, joints_rad: Floats) -> Floats:
        """Return T_world_tool [..., 4, 4] for arm joints [..., J]."""
        return self.forward_kinematics(self.configuration(joints_rad))[..., self.links.index(self.tool), :, :]

    def jacobian(self, joints_rad: Floats) -> Floats:
        """Return the tool's velocity [m] and angular velocity [rad] in the world per joint velocity, [..., 6, J]."""
        return self._tool_and_jacobian(joints_rad)[1]

    def inverse_kinematics(
        self,
        positions: Floats,
        *,
        rotations: Floats | None = None,
        start_rad: Floats = GEN3_HOME_RAD,
        tolerance_m: float = 1e-5,
        iterations: int = 200,
    ) -> Floats:
        """Return joint angles [..., J] that bring the tool to `positions`, by damped least squares for all poses at
        once.

        All poses start from the same configuration, so a smooth path of the tool gives a smooth path of the joints.

        Args:
            positions: [..., 3] tool positions in the world [m].
            rotations: [..., 3, 3] or [3, 3] rotation of T_world_tool; None leaves it free.
            start_rad: [J] or [..., J] initial joint angles.
            tolerance_m: maximum remaining distance; for rotations the same number in radians.

        Raises:
            RobotError: a pose is out of reach; names the pose and the remaining error.
        """
        positions = np.asarray(positions, dtype=np.float64)
        joints = np.broadcast_to(start_rad, (*positions.shape[:-1], len(self.arm))).copy()
        low, high = (np.array([getattr(self.moving[index], end) for index in self.arm]) for end in ("lower", "upper"))
        rows = 3 if rotations is None else 6
        for _ in range(iterations):
            pose, jacobian = self._tool_and_jacobian(joints)
            error = positions - pose[..., :3, 3]
            if rotations is not None:
                turn = rotations @ np.swapaxes(pose[..., :3, :3], -1, -2)
                angle = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec().reshape(error.shape)
                error = np.concatenate([error, angle], axis=-1)
            if not error.size or np.abs(error).max() < tolerance_m:
                return joints
            J = jacobian[..., :rows, :]
            Jt = np.swapaxes(J, -1, -2)
            # the damping decreases with the error, so that the last steps are Newton steps
            damping = _DAMPING * np.minimum(1.0, np.square(error).sum(axis=-1))[..., None, None] + 1e-9
            step = (Jt @ np.linalg.solve(J @ Jt + damping * np.eye(rows), error[..., None]))[..., 0]
            longest = np.abs(step).max(axis=-1, keepdims=True)
            joints = np.clip(joints + step * np.minimum(1.0, _LONGEST_STEP_RAD / np.maximum(longest, 1e-12)), low, high)
        worst = int(np.abs(error).reshape(-1, rows).max(axis=-1).argmax())
        missed = np.linalg.norm(error.reshape(-1, rows)[worst, :3])
        raise RobotError(
            f"{self.description.name} does not reach {positions.reshape(-1, 3)[worst].round(4).tolist()} m (pose {worst}): "
            f"{1000 * missed:.2f} mm are left. Keep within reach, or leave the rotation free."
        )

    def _tool_and_jacobian(self, joints_rad: Floats) -> tuple[Floats, Floats]:
        poses = self.forward_kinematics(self.configuration(joints_rad))
        tool = poses[..., self.links.index(self.tool), :, :]
        carried = [self.links.index(self.moving[index].child) for index in self.arm]
        # a joint does not move its own axis, so the child's frame gives the axis and a point on it
        frames = poses[..., carried, :, :]
        axis = (frames[..., :3, :3] @ np.array([self.moving[index].axis for index in self.arm])[..., None])[..., 0]
        lever = tool[..., None, :3, 3] - frames[..., :3, 3]
        turns = np.array([self.moving[index].kind != "prismatic" for index in self.arm])[:, None]
        linear = np.where(turns, np.cross(axis, lever), axis)
        angular = np.where(turns, axis, 0.0)
        return tool, np.swapaxes(np.concatenate([linear, angular], axis=-1), -1, -2)


def _motion(joint: Joint, value: Floats) -> Floats:
    """Return transforms [..., 4, 4] of a joint at angles or displacements [...]."""
    matrix = np.zeros((*value.shape, 4, 4))
    matrix[..., :, :] = np.eye(4)
    if joint.kind == "prismatic":
        matrix[..., :3, 3] = value[..., None] * joint.axis
    else:
        x, y, z = joint.axis
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        s, c = np.sin(value)[..., None, None], np.cos(value)[..., None, None]
        matrix[..., :3, :3] = np.eye(3) + s * cross + (1 - c) * (cross @ cross)  # Rodrigues' formula
    return matrix
