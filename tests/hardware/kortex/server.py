"""A loopback arm that speaks Kortex: TCP frames for commands, UDP datagrams for measurements.

Its tool is a point that moves with the commanded twist, a little late; joints move along so that logs are not constant.
Faults, a pressed emergency stop and a cut cable can be ordered for the n-th twist.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from tests.hardware.kortex import messages
from tests.hardware.kortex.client import MAGIC
from tests.hardware.kortex.messages import CONSTANTS, NAMES, UIDS, Empty, Frame, parsed

HOME_DEG = np.array([0.0, 15.0, 180.0, 230.0, 0.0, 55.0, 90.0])
HOME_M = np.array([0.5767, 0.0013, 0.4337])
LAG_S = 0.03
EMERGENCY = 0x800000


class FakeArm:
    """A context manager; `calls` lists (name, request) in order, without keep-alives and feedback."""

    def __init__(self, *, password: str = "admin", start: Any = HOME_M) -> None:
        self.calls: list[tuple[str, Any]] = []
        self.twist_times: list[float] = []
        self.sessions_open = 0
        self.connection_timeouts_ms: list[int] = []
        self.position = np.array(start, dtype=float)
        self.velocity, self.wanted = np.zeros(3), np.zeros(3)
        self.wrench = np.zeros(6)
        self.gripper = 0.0
        self.fault_bank = 0
        self.abort_home = False
        self.at_twist: dict[int, Callable[[], None]] = {}
        """Called when so many twists have come."""
        self._password, self._subscribed = password, 0
        self._time, self._sessions = time.monotonic(), 0
        self._lock = threading.RLock()
        self._tcp = socket.create_server(("127.0.0.1", 0))
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.bind(("127.0.0.1", 0))
        self._udp.settimeout(0.1)
        self.tcp_port, self.udp_port = self._tcp.getsockname()[1], self._udp.getsockname()[1]
        self._links: list[socket.socket] = []
        self._open = True
        self._threads = [threading.Thread(target=target, daemon=True) for target in (self._accept, self._datagrams)]

    def __enter__(self) -> FakeArm:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self.cut()

    def cut(self) -> None:
        """Pull the cable: no answer from now on."""
        self._open = False
        for link in [*self._links, self._tcp]:
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()

    def fault(self, bank: int = 0x10) -> None:
        with self._lock:
            self._advance()
            self.fault_bank = bank
            self.wanted, self.velocity = np.zeros(3), np.zeros(3)

    def press_emergency_stop(self) -> None:
        self.fault(EMERGENCY)

    def names(self) -> list[str]:
        return [name for name, _ in self.calls]

    def stopped_after_last_twist(self) -> bool:
        names = self.names()
        last = max((index for index, name in enumerate(names) if name == "SendTwistCommand"), default=-1)
        return "Stop" in names[last + 1 :]

    def _accept(self) -> None:
        while self._open:
            try:
                link, _ = self._tcp.accept()
            except OSError:
                return
            self._links.append(link)
            threading.Thread(target=self._serve, args=(link,), daemon=True).start()

    def _serve(self, link: socket.socket) -> None:
        stream = link.makefile("rb")
        try:
            while (head := stream.read(12)) and len(head) == 12:
                assert head[:8] == MAGIC
                frame = Frame.decode(stream.read(struct.unpack(">I", head[8:])[0]))

                def send(data: bytes) -> None:
                    link.sendall(MAGIC + struct.pack(">I", len(data)) + data)

                for answer in self._answer(frame):
                    send(answer.encode())
        except (OSError, ValueError):
            pass  # the link was cut
        finally:
            stream.close()

    def _datagrams(self) -> None:
        while self._open:
            try:
                data, sender = self._udp.recvfrom(65536)
                for answer in self._answer(Frame.decode(data)):
                    if self._open:
                        self._udp.sendto(answer.encode(), sender)
            except TimeoutError:
                continue
            except OSError:
                break
        self._udp.close()

    def _answer(self, frame: Frame) -> list[Frame]:
        name = NAMES[frame.uid]
        with self._lock:
            self._advance()
            error = (0, 0)
            reply: Any = Empty()
            session = frame.session
            later: list[Frame] = []
            if name == "CreateSession":
                info = parsed(messages.CreateSessionInfo, frame.payload)
                if info.password != self._password:
                    error = (3, 15)
                else:
                    self._sessions += 1
                    self.sessions_open += 1
                    self.connection_timeouts_ms.append(info.connection_inactivity_timeout)
                    session = self._sessions
            else:
                reply, error, later = getattr(self, f"_{name}", self._nothing)(frame)
            if name not in ("KeepAlive", "RefreshFeedback", "GetMeasuredGripperMovement"):
                request = parsed(messages.TwistCommand, frame.payload) if name == "SendTwistCommand" else None
                self.calls.append((name, request))
            return [Frame.build(3, frame.uid, session, frame.number, reply.SerializeToString(), *error), *later]

    def _nothing(self, _: Frame) -> Any:
        return Empty(), (0, 0), []

    def _CloseSession(self, frame: Frame) -> Any:
        self.sessions_open -= 1
        return self._nothing(frame)

    def _GetArmState(self, _: Frame) -> Any:
        return messages.ArmStateInformation(active_state=self._state()), (0, 0), []

    def _ReadAllActions(self, _: Frame) -> Any:
        actions = messages.ActionList()
        for number, label in enumerate(("Retract", "Home"), 1):
            action = actions.action_list.add()
            action.name, action.handle = label, messages.ActionHandle(identifier=number, action_type=7)
        return actions, (0, 0), []

    def _ActionTopic(self, _: Frame) -> Any:
        self._subscribed = 1
        return messages.NotificationHandle(identifier=1), (0, 0), []

    def _ExecuteActionFromReference(self, frame: Frame) -> Any:
        handle = parsed(messages.ActionHandle, frame.payload)
        assert handle.identifier == 2
        event = CONSTANTS["ACTION_ABORT"] if self.abort_home else CONSTANTS["ACTION_END"]
        if not self.abort_home:
            self.position = HOME_M.copy()
        told = messages.ActionNotification(action_event=event, handle=handle)
        later = (
            [Frame.build(5, UIDS["ActionTopic"], frame.session, 0, told.SerializeToString())] if self._subscribed else []
        )
        return Empty(), (0, 0), later

    def _SendTwistCommand(self, frame: Frame) -> Any:
        if self.fault_bank:
            return Empty(), (3, 22), []
        command = parsed(messages.TwistCommand, frame.payload)
        assert command.reference_frame == CONSTANTS["CARTESIAN_REFERENCE_FRAME_BASE"]
        self.wanted = np.array([command.twist.linear_x, command.twist.linear_y, command.twist.linear_z])
        self.twist_times.append(time.monotonic())
        happening = self.at_twist.get(len(self.twist_times))
        if happening is not None:
            happening()
        return self._nothing(frame)

    def _Stop(self, frame: Frame) -> Any:
        self.wanted = np.zeros(3)
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
        return reply, (0, 0), []

    def _RefreshFeedback(self, _: Frame) -> Any:
        reply = messages.Feedback()
        base = reply.base
        base.active_state = self._state()
        base.tool_pose_x, base.tool_pose_y, base.tool_pose_z = map(float, self.position)
        base.tool_pose_theta_x, base.tool_pose_theta_z = 90.0, 90.0
        for value, name in zip(
            self.wrench, ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z"), strict=True
        ):
            setattr(base, f"tool_external_wrench_{name}", float(value))
        base.fault_bank_a = self.fault_bank
        for angle in self._joints_deg():
            reply.actuators.add().position = float(angle)
        return reply, (0, 0), []

    def _GetMeasuredCartesianPose(self, _: Frame) -> Any:
        x, y, z = map(float, self.position)
        return messages.Pose(x=x, y=y, z=z, theta_x=90.0, theta_z=90.0), (0, 0), []

    def _GetMeasuredJointAngles(self, _: Frame) -> Any:
        reply = messages.JointAngles()
        for number, angle in enumerate(self._joints_deg()):
            joint = reply.joint_angles.add()
            joint.joint_identifier, joint.value = number, float(angle)
        return reply, (0, 0), []

    def _joints_deg(self) -> np.ndarray:
        """In 0..360, as the arm reports them; the first crosses zero while the tool moves sideways or up."""
        return (HOME_DEG + 60 * (self.position - HOME_M).sum()) % 360

    def _state(self) -> int:
        return CONSTANTS["ARMSTATE_IN_FAULT" if self.fault_bank else "ARMSTATE_SERVOING_READY"]

    def _advance(self) -> None:
        now = time.monotonic()
        elapsed, self._time = now - self._time, now
        fade = np.exp(-elapsed / LAG_S)  # first-order lag, integrated exactly
        self.position = self.position + self.wanted * elapsed + (self.velocity - self.wanted) * LAG_S * (1 - fade)
        self.velocity = self.wanted + (self.velocity - self.wanted) * fade
