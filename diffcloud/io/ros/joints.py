"""The joint log of a ROS recording, from joint_states or from the link frames in tf, with the tool pose from tf."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffcloud.errors import ConfigError, EpisodeError
from diffcloud.io.raw_episodes import RobotLog
from diffcloud.io.ros.publishers import JointMessage, of_one_driver
from diffcloud.io.ros.transforms import TransformTree
from diffcloud.io.urdf import Joint, RobotDescription

GRIPPER_JOINT, GRIPPER_CLOSED_RAD = "finger_joint", 0.8
"""Joint and closed position of a Robotiq 2F-85 gripper, from the manufacturer's description."""
_LATEST_S = 0.5
"""Largest delay. A message that is older than its predecessor by more has another clock."""
_OFF_M, _OFF_RAD = 0.005, np.deg2rad(1.0)
"""Largest deviation of a link in tf from its pose in the robot description."""


@dataclass(frozen=True)
class Grip:
    """The joint that measures how far a gripper is closed."""

    joint: str | None
    """Joint name, None if the arm has no gripper."""
    open: float
    """Position of the joint at which the gripper is open [rad or m]."""
    closed: float
    guessed: bool
    """Whether `closed` is a default that the user did not confirm."""

    @staticmethod
    def of(joint: str | None, open_: float, closed: float | None) -> Grip:
        """Build a grip from the user's options.

        Args:
            closed: None: that of a Robotiq 2F-85.

        Raises:
            ConfigError: the positions are equal or not finite.
        """
        at = GRIPPER_CLOSED_RAD if closed is None else closed
        if not (math.isfinite(open_) and math.isfinite(at) and open_ != at):
            raise ConfigError(
                f"A gripper that is open at {open_:g} and closed at {at:g} tells nothing: a gripper's joint has two "
                "different positions, --gripper-joint NAME,OPEN,CLOSED. A Franka Hand's finger is open at 0.04 and closed "
                "at 0."
            )
        return Grip(joint, open_, at, guessed=closed is None)

    @property
    def warnings(self) -> list[str]:
        """Warnings about assumed positions."""
        if self.joint == GRIPPER_JOINT or not self.guessed:
            return []
        return [
            f"The gripper is taken to be open where {self.joint} is {self.open:g} and closed where it is {self.closed:g}, "
            f"as a Robotiq 2F-85 is; say where it is with --gripper-joint {self.joint},OPEN,CLOSED."
        ]

    def state(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert joint positions to gripper states, from 0 (open) to 1 (closed)."""
        return (positions - self.open) / (self.closed - self.open)


def joint_log(
    where: str,
    sent: Sequence[JointMessage],
    tree: TransformTree,
    *,
    world_frame: str,
    tool_frame: str,
    joint_names: Sequence[str] | None,
    grip: Grip,
    named: Collection[str] = (),
) -> tuple[RobotLog, tuple[str, ...]]:
    """Build the joint log from joint_states messages. Return it with warnings about unknown quantities.

    Args:
        where: name of the recording, for messages.
        sent: messages in order of arrival, at least one.
        joint_names: joints of the arm in order. None: joint_1, joint_2, ...
        named: topics that the user selected, also as TOPIC#NUMBER (`publishers.of_one_driver`).

    Raises:
        EpisodeError: a joint is not in joint_states, the clock was set back, or several publishers send the same joints
            and none of them is selected.
    """
    seen = {name for held in sent for name in held.message.name}
    if joint_names is None:
        joint_names = sorted((name for name in seen if re.fullmatch(r"joint_\d+", name)), key=lambda name: int(name[6:]))
    missing = sorted(set(joint_names) - seen)
    if not joint_names or missing:
        raise EpisodeError(
            f"{where}: joint_states has {', '.join(sorted(seen))}; {missing or 'joint_1, ...'} not among them. Name the "
            "arm's joints in order with --joints."
        )
    needed = {*joint_names, *([] if grip.joint is None else [grip.joint])}
    kept, warnings = of_one_driver(where, sent, needed, named)
    messages = [(held.time_s, held.message) for held in kept]
    rows, angles = _series(where, messages, joint_names)
    if not len(rows):
        raise EpisodeError(f"{where}: no message of joint_states has the angles of all of {', '.join(joint_names)}.")
    gripper = np.full(len(rows), np.nan)
    others = sorted(seen - set(joint_names))
    gripper_joint = grip.joint
    if gripper_joint is not None and gripper_joint in seen:
        # The gripper's joint is often published by another driver, in separate messages.
        times, values = _series(where, messages, [gripper_joint])
        gripper = grip.state(np.interp(rows, times, values[:, 0])) if len(times) else gripper
        warnings += grip.warnings
    elif gripper_joint is not None and (others or gripper_joint != GRIPPER_JOINT):
        raise EpisodeError(
            f"{where}: joint_states has no {gripper_joint!r}, so how far the gripper is open is not known; besides the "
            f"arm's joints there are {', '.join(others) or 'none'}. Name the gripper's joint and its "
            "positions with --gripper-joint NAME,OPEN,CLOSED, or give --gripper-joint none."
        )
    elif gripper_joint is not None:
        warnings.append(
            "joint_states has only the arm's joints: how far the gripper is open stays unknown, and it is masked as open. "
            "If the arm has none, --gripper-joint none says so."
        )
    position, quaternion = np.full((len(rows), 3), np.nan), np.full((len(rows), 4), np.nan)
    try:
        position, quaternion = _placed(tree.lookup(world_frame, tool_frame, rows))
    except EpisodeError as error:
        warnings.append(f"The tool's pose stays unknown: {error}. Name its frames with --tool-frame and --world-frame.")
    return RobotLog(rows, angles, gripper, position, quaternion, np.full((len(rows), 6), np.nan)), tuple(warnings)


def log_from_links(
    tree: TransformTree,
    description: RobotDescription,
    *,
    world_frame: str,
    tool_frame: str,
    grip: Grip,
) -> tuple[RobotLog, tuple[str, ...]]:
    """Build the joint log from the link frames in tf, for a recording without joint_states.

    The angle of a joint is the rotation of its child link about the joint axis, relative to the robot description.

    Args:
        description: robot description with the same link names as tf.

    Raises:
        EpisodeError: the description lacks the tool, tf lacks a link of the arm, no link moves, or a link has a pose
            that its joint cannot reach.
    """
    carriers = {joint.child: joint for joint in description.joints}
    chain, link = list[Joint](), tool_frame
    while link in carriers:
        chain.insert(0, carriers[link])
        link = carriers[link].parent
    arm = [joint for joint in chain if joint.kind != "fixed"]
    if not arm:
        raise EpisodeError(f"the robot's description {description.name} has no joints that carry {tool_frame!r}")
    rows = np.unique(np.concatenate([tree.stamps(joint.child) for joint in arm]))
    angles = np.stack([_angle(tree, joint, rows) for joint in arm], axis=1)
    if not np.ptp(angles, axis=0).any():
        raise EpisodeError(f"no link of {', '.join(joint.child for joint in arm)} moves in tf")
    gripper, warnings = np.full(len(rows), np.nan), list[str]()
    finger = next((joint for joint in description.joints if joint.name == grip.joint), None)
    if grip.joint is not None:
        try:
            if finger is None:
                raise EpisodeError(f"the description has no joint {grip.joint!r}")
            gripper = grip.state(_angle(tree, finger, rows))
            warnings += grip.warnings
        except EpisodeError as error:
            warnings.append(f"How far the gripper is open stays unknown, and it is masked as open: {error}.")
    position, quaternion = _placed(tree.lookup(world_frame, tool_frame, rows))
    return RobotLog(rows, angles, gripper, position, quaternion, np.full((len(rows), 6), np.nan)), tuple(warnings)


def _angle(tree: TransformTree, joint: Joint, times: NDArray[np.float64]) -> NDArray[np.float64]:
    """[T] angles of a joint [rad], or displacements of a prismatic joint [m].

    Raises:
        EpisodeError: tf does not connect the links, or the child moves in a direction other than the joint axis.
    """
    moved = np.linalg.inv(joint.T_parent_joint) @ tree.lookup(joint.parent, joint.child, times)
    turn, shift = Rotation.from_matrix(moved[:, :3, :3]).as_rotvec(), moved[:, :3, 3]
    slides = joint.kind == "prismatic"
    along = np.asarray((shift if slides else turn) @ joint.axis)
    explained = along[:, None] * joint.axis
    off_turn = np.linalg.norm(turn if slides else turn - explained, axis=1).max()
    off_shift = np.linalg.norm(shift - explained if slides else shift, axis=1).max()
    if off_turn > _OFF_RAD or off_shift > _OFF_M:
        raise EpisodeError(
            f"in tf {joint.child!r} lies {1000 * off_shift:.0f} mm and {np.rad2deg(off_turn):.1f} degrees away from where "
            f"{joint.name} of the robot's description can put it relative to {joint.parent!r}"
        )
    return along


def _placed(poses: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Split poses [T, 4, 4] into positions [T, 3] and quaternions [T, 4] (w, x, y, z)."""
    return poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)


def _series(
    where: str, messages: Sequence[tuple[float, Any]], names: Sequence[str]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return sorted unique times [N] and positions [N, J], from the messages that have all of `names`."""
    held = [(t, dict(zip(message.name, message.position, strict=False))) for t, message in messages]
    rows = [(t, [at[name] for name in names]) for t, at in held if set(names) <= at.keys()]
    times = np.array([t for t, _ in rows])
    values = np.array([row for _, row in rows], dtype=np.float64).reshape(-1, len(names))
    behind = np.maximum.accumulate(times) - times
    if (behind > _LATEST_S).any():
        first = int(np.flatnonzero(behind > _LATEST_S)[0])
        raise EpisodeError(
            f"{where}: message {first + 1} of joint_states with {names[0]} is stamped {behind[first]:.2f} s before one "
            "that came earlier. The clock was set back while recording, or two drivers use different clocks: cut the "
            "recording there."
        )
    times, first_of_each = np.unique(times, return_index=True)
    return times, values[first_of_each]
