"""A loopback arm that speaks Kortex: TCP frames for commands, UDP datagrams for measurements.

Its tool moves with the commanded twist, a little late, and the joints of a Gen3 follow; or the joints move and the tool
follows. As Kinova documents it, motion that a session has begun ends when nothing was heard from that session for its
connection timeout, and a session that is silent for the session timeout is closed: so a killed process or a cut cable
shows here what it does to the arm. Faults, a pressed emergency stop and a cut cable can be ordered for the n-th twist.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from diffcloud.errors import RobotError
from diffcloud.sensing.robot import GEN3_HOME_RAD
from tests.hardware.gen3_body import Gen3Body, home_pose
from tests.hardware.kortex import messages
from tests.hardware.kortex.client import MAGIC
from tests.hardware.kortex.messages import CONSTANTS, NAMES, Empty, Frame, parsed

HOME_DEG = np.rad2deg(GEN3_HOME_RAD) % 360
HOME_M = home_pose()[:3, 3].copy()
LAG_S = 0.03
EMERGENCY = 0x800000
REFUSED = (3, 22)
MOTIONS = ("SendTwistCommand", "SendJointSpeedsCommand")


@dataclass
class Session:
    heard: float
    connection_timeout_s: float
    session_timeout_s: float


class FakeArm:
    """A context manager; `calls` lists (name, request) in order, without keep-alives and feedback."""

    def __init__(self, *, password: str = "admin", start: Any = HOME_M) -> None:
        self.calls: list[tuple[str, Any]] = []
        self.call_times: list[float] = []
        """time.monotonic() of each of `calls`."""
        self.twist_times: list[float] = []
        self.sessions: dict[int, Session] = {}
        self.connection_timeouts_ms: list[int] = []
        self.wrench = np.zeros(6)
        self.gripper = 0.0
        self.fault_bank = 0
        self.manual_until = 0.0
        """time.monotonic() up to which somebody else drives the arm."""
        self.tool_offset = np.zeros(3)
        """Of the configured tool frame, in the tool's own frame."""
        self.refused: dict[str, int] = {}
        """Call -> how often it is still answered by an error."""
        self.at_twist: dict[int, Callable[[], None]] = {}
        """Called when so many twists have come."""
        self._password, self._next_session = password, 0
        self._owner: Session | None = None
        self._body, self._rotation = Gen3Body(), home_pose()[:3, :3].copy()
        self._position = np.array(start, dtype=float)
        self._velocity, self._wanted = np.zeros(3), np.zeros(3)
        self._turning, self._wanted_turning = np.zeros(7), np.zeros(7)
        self._time = time.monotonic()
        self._lock, self._linking = threading.RLock(), threading.Lock()
        self._tcp = socket.create_server(("127.0.0.1", 0))
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.bind(("127.0.0.1", 0))
        self._udp.settimeout(0.1)
        self.tcp_port, self.udp_port = self._tcp.getsockname()[1], self._udp.getsockname()[1]
        self._links: list[socket.socket] = []
        self._open, self._pulled = True, False
        self._threads = [threading.Thread(target=target, daemon=True) for target in (self._accept, self._datagrams)]

    def __enter__(self) -> FakeArm:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self.cut()

    def cut(self) -> None:
        """End all links: the other side is told, and no answer comes from now on."""
        with self._linking:
            self._open = False
        for link in [*self._links, self._tcp]:
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()

    def pull_cable(self) -> None:
        """Nothing comes and nothing goes from now on; nobody is told."""
        self._pulled = True

    def fault(self, bank: int = 0x10) -> None:
        with self._lock:
            self._advance()
            self.fault_bank = bank
            self._hold()

    def press_emergency_stop(self) -> None:
        self.fault(EMERGENCY)

    @property
    def position(self) -> np.ndarray:
        """[3] of the tool, now [m]."""
        with self._lock:
            self._advance()
            return self._position.copy()

    @position.setter
    def position(self, value: Any) -> None:
        with self._lock:
            self._advance()
            self._position = np.array(value, dtype=float)

    @property
    def joints_rad(self) -> np.ndarray:
        """[7] now."""
        with self._lock:
            self._advance()
            return self._joints()

    @joints_rad.setter
    def joints_rad(self, value: Any) -> None:
        with self._lock:
            self._advance()
            self._set_joints(np.array(value, dtype=float))

    @property
    def sessions_open(self) -> int:
        return len(self.sessions)

    def turn_tool(self, angle_rad: float) -> None:
        """About the tool's own axis, as if something had turned it."""
        with self._lock:
            self._advance()
            self._rotation = self._rotation @ Rotation.from_rotvec([0, 0, angle_rad]).as_matrix()

    def rest(self, patience_s: float = 5.0) -> np.ndarray:
        """Wait until nothing moves; the position then."""
        end = time.monotonic() + patience_s
        while time.monotonic() < end:
            before = self.position
            time.sleep(0.1)
            if np.linalg.norm(self.position - before) < 1e-5:
                break
        return self.position

    def names(self) -> list[str]:
        return [name for name, _ in self.calls]

    def stopped_after_last_motion(self) -> bool:
        names = self.names()
        last = max((index for index, name in enumerate(names) if name in MOTIONS), default=-1)
        return "Stop" in names[last + 1 :]

    def _accept(self) -> None:
        while self._open:
            try:
                link, _ = self._tcp.accept()
            except OSError:
                return
            with self._linking:  # a link that comes while `cut` ends the others would be nobody's to close
                if not self._open:
                    link.close()
                    return
                self._links.append(link)
            threading.Thread(target=self._serve, args=(link,), daemon=True).start()

    def _serve(self, link: socket.socket) -> None:
        stream = link.makefile("rb")
        try:
            while (head := stream.read(12)) and len(head) == 12:
                assert head[:8] == MAGIC
                frame = Frame.decode(stream.read(struct.unpack(">I", head[8:])[0]))
                if self._pulled:
                    continue
                data = self._answer(frame).encode()
                link.sendall(MAGIC + struct.pack(">I", len(data)) + data)
        except (OSError, ValueError):
            pass  # the link was cut
        finally:
            stream.close()

    def _datagrams(self) -> None:
        while self._open:
            try:
                data, sender = self._udp.recvfrom(65536)
                if self._pulled:
                    continue
                answer = self._answer(Frame.decode(data))
                if self._open:
                    self._udp.sendto(answer.encode(), sender)
            except TimeoutError:
                continue
            except OSError:
                break
        self._udp.close()

    def _answer(self, frame: Frame) -> Frame:
        name = NAMES[frame.uid]
        with self._lock:
            self._advance()  # up to now, before this message counts as a sign of life
            error = (0, 0)
            reply: Any = Empty()
            session = frame.session
            self._forget_silent_sessions()
            if name == "CreateSession":
                info = parsed(messages.CreateSessionInfo, frame.payload)
                if info.password != self._password:
                    error = (3, 15)
                else:
                    self._next_session += 1
                    session = self._next_session
                    self.connection_timeouts_ms.append(info.connection_inactivity_timeout)
                    self.sessions[session] = Session(
                        time.monotonic(),
                        info.connection_inactivity_timeout / 1000,
                        info.session_inactivity_timeout / 1000,
                    )
            elif session not in self.sessions:
                error = (3, 16)
            else:
                self.sessions[session].heard = time.monotonic()
                if self.refused.get(name, 0) > 0:
                    self.refused[name] -= 1
                    error = REFUSED
                else:
                    reply, error = getattr(self, f"_{name}", self._nothing)(frame)
            if name not in ("KeepAlive", "RefreshFeedback", "GetMeasuredGripperMovement"):
                request = parsed(messages.TwistCommand, frame.payload) if name == "SendTwistCommand" else None
                self.calls.append((name, request))
                self.call_times.append(time.monotonic())
            return Frame.build(3, frame.uid, session, frame.number, reply.SerializeToString(), *error)

    def _forget_silent_sessions(self) -> None:
        now = time.monotonic()
        for number, session in list(self.sessions.items()):
            if now - session.heard > session.session_timeout_s:
                del self.sessions[number]

    def _nothing(self, _: Frame) -> Any:
        return Empty(), (0, 0)

    def _CloseSession(self, frame: Frame) -> Any:
        del self.sessions[frame.session]
        return self._nothing(frame)

    def _GetArmState(self, _: Frame) -> Any:
        return messages.ArmStateInformation(active_state=self._state()), (0, 0)

    def _ReadAllActions(self, _: Frame) -> Any:
        actions = messages.ActionList()
        retract = np.array([0.0, 340.0, 180.0, 214.0, 0.0, 310.0, 90.0])
        for number, (label, angles) in enumerate((("Retract", retract), ("Home", HOME_DEG)), 1):
            action = actions.action_list.add()
            action.name, action.handle = label, messages.ActionHandle(identifier=number, action_type=7)
            for index, value in enumerate(angles):
                angle = action.reach_joint_angles.joint_angles.joint_angles.add()
                angle.joint_identifier, angle.value = index, float(value)
        return actions, (0, 0)

    def _SendTwistCommand(self, frame: Frame) -> Any:
        if self.fault_bank:
            return Empty(), REFUSED
        command = parsed(messages.TwistCommand, frame.payload)
        assert command.reference_frame == CONSTANTS["CARTESIAN_REFERENCE_FRAME_BASE"]
        self._hold_joints()
        self._wanted = np.array([command.twist.linear_x, command.twist.linear_y, command.twist.linear_z])
        self._owner = self.sessions[frame.session]
        self.twist_times.append(time.monotonic())
        happening = self.at_twist.get(len(self.twist_times))
        if happening is not None:
            happening()
        return self._nothing(frame)

    def _SendJointSpeedsCommand(self, frame: Frame) -> Any:
        if self.fault_bank:
            return Empty(), REFUSED
        self._joints()  # where the tool has taken them
        self._wanted, self._velocity = np.zeros(3), np.zeros(3)
        for joint in parsed(messages.JointSpeeds, frame.payload).joint_speeds:
            self._wanted_turning[joint.joint_identifier] = np.deg2rad(joint.value)
        self._owner = self.sessions[frame.session]
        return self._nothing(frame)

    def _Stop(self, frame: Frame) -> Any:
        self._wanted, self._wanted_turning = np.zeros(3), np.zeros(7)
        return self._nothing(frame)

    def _ApplyEmergencyStop(self, frame: Frame) -> Any:
        self.press_emergency_stop()
        return self._nothing(frame)

    def _ClearFaults(self, frame: Frame) -> Any:
        self.fault_bank = 0
        return self._nothing(frame)

    def _SendGripperCommand(self, frame: Frame) -> Any:
        self.gripper = parsed(messages.GripperCommand, frame.payload).gripper.finger[0].value
        return self._nothing(frame)

    def _GetMeasuredGripperMovement(self, _: Frame) -> Any:
        reply = messages.Gripper()
        reply.finger.add().value = self.gripper
        return reply, (0, 0)

    def _RefreshFeedback(self, _: Frame) -> Any:
        reply = messages.Feedback()
        base = reply.base
        base.active_state = self._state()
        for value, name in zip(self._reported_pose(), ("x", "y", "z", "theta_x", "theta_y", "theta_z"), strict=True):
            setattr(base, f"tool_pose_{name}", value)
        for value, name in zip(
            self.wrench, ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z"), strict=True
        ):
            setattr(base, f"tool_external_wrench_{name}", float(value))
        base.fault_bank_a = self.fault_bank
        for angle in self._joints_deg():
            reply.actuators.add().position = float(angle)
        return reply, (0, 0)

    def _GetMeasuredCartesianPose(self, _: Frame) -> Any:
        x, y, z, theta_x, theta_y, theta_z = self._reported_pose()
        return messages.Pose(x=x, y=y, z=z, theta_x=theta_x, theta_y=theta_y, theta_z=theta_z), (0, 0)

    def _GetMeasuredJointAngles(self, _: Frame) -> Any:
        reply = messages.JointAngles()
        for number, angle in enumerate(self._joints_deg()):
            joint = reply.joint_angles.add()
            joint.joint_identifier, joint.value = number, float(angle)
        return reply, (0, 0)

    def _reported_pose(self) -> list[float]:
        """Metres, and degrees about the fixed axes x, y, z in this order."""
        place = self._position + self._rotation @ self.tool_offset
        return [*place.tolist(), *Rotation.from_matrix(self._rotation).as_euler("xyz", degrees=True).tolist()]

    def _joints_deg(self) -> np.ndarray:
        """In 0..360, as the arm reports them."""
        return np.rad2deg(self._joints()) % 360

    def _joints(self) -> np.ndarray:
        try:
            return self._body.move_tool(self._position, self._rotation)
        except RobotError:  # out of reach: the joints stay
            return self._body.joints.copy()

    def _set_joints(self, joints: np.ndarray) -> None:
        self._body.joints = joints
        self._position, self._rotation = self._body.pose[:3, 3], self._body.pose[:3, :3]

    def _state(self) -> int:
        if self.fault_bank:
            return CONSTANTS["ARMSTATE_IN_FAULT"]
        manual = time.monotonic() < self.manual_until
        return CONSTANTS["ARMSTATE_SERVOING_MANUALLY_CONTROLLED" if manual else "ARMSTATE_SERVOING_READY"]

    def _hold(self) -> None:
        self._wanted, self._velocity = np.zeros(3), np.zeros(3)
        self._hold_joints()

    def _hold_joints(self) -> None:
        self._wanted_turning, self._turning = np.zeros(7), np.zeros(7)

    def _advance(self) -> None:
        """Move up to now; from the owner's timeout on, the arm is coming to rest."""
        now = time.monotonic()
        if self._owner is not None:
            silent = max(self._owner.heard + self._owner.connection_timeout_s, self._time)
            if silent < now:
                self._move(silent)
                self._wanted, self._wanted_turning = np.zeros(3), np.zeros(7)
        self._move(now)

    def _move(self, until: float) -> None:
        elapsed, self._time = until - self._time, until
        if self._turning.any() or self._wanted_turning.any():
            angle, self._turning = _lagging(self._turning, self._wanted_turning, elapsed)
            self._set_joints(self._body.joints + angle)
        step, self._velocity = _lagging(self._velocity, self._wanted, elapsed)
        self._position = self._position + step


def _lagging(velocity: np.ndarray, wanted: np.ndarray, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
    """What is covered with a first-order lag, integrated exactly, and the velocity then."""
    fade = np.exp(-elapsed / LAG_S)
    return wanted * elapsed + (velocity - wanted) * LAG_S * (1 - fade), wanted + (velocity - wanted) * fade
