"""Driver of the Kinova Gen3, based on Kinova's `kortex_api`.

Commands use TCP. Measurements use UDP (`RefreshFeedback`: joints, tool pose, wrench and faults in one datagram). A
velocity is valid until the next command, so all exits send Stop. If the link is lost, the arm stops after the
connection timeout that is set when the session is opened. Kinova documents it as the inactivity after which the robot
stops any movement of the session. A thread of `kortex_api` sends a keep-alive every 150 ms. So the timeout detects a
lost link or a dead process, but not one that hangs. `arm_process` handles that case.

The motion to home is controlled here in joint space. From the arm's action named Home, only the joint angles are read.
The action itself has its own speed and would not be checked against the limits.

The arm uses degrees; this module returns radians. Joint angles are unwrapped at 360°, so that they can be interpolated.
"""

from __future__ import annotations

import collections
import collections.abc
import importlib
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffcloud.errors import HardwareError
from diffcloud.hardware.devices import ArmReading

TCP_PORT, UDP_PORT = 10000, 10001
JOINT_COUNT = 7

_SESSION_TIMEOUT_MS = 10_000
_CONNECTION_TIMEOUT_MS = 500
"""The arm stops if the link is silent for this time (three keep-alives)."""
_CALL_TIMEOUT_MS = 400
"""Timeout of one call. It is below the watchdog timeout, so that a lost link is reported as such."""
_TRANSIENT_S = 3.0
"""Time for which the arm may report manual control after a closed session or a Stop."""
_FAULTS = {
    0x10: "joint fault",
    0x400: "pose out of reach",
    0x2000: "current too high",
    0x4000: "voltage too high",
    0x8000: "voltage too low",
    0x10000: "tool too fast",
    0x100000: "force at the tool too high",
    0x800000: "emergency stop pressed",
    0x1000000: "emergency line open",
}
"""Bits of the base's fault bank A (Base.SafetyIdentifier)."""


@dataclass(frozen=True)
class Kortex:
    """The used parts of kortex_api."""

    TCPTransport: Any
    UDPTransport: Any
    RouterClient: Any
    RouterClientSendOptions: Any
    SessionManager: Any
    BaseClient: Any
    BaseCyclicClient: Any
    Session_pb2: Any
    Base_pb2: Any
    Common_pb2: Any


def load_kortex() -> Kortex:
    """Import kortex_api.

    Raises:
        HardwareError: it is not installed. The message explains how to install it.
    """
    # Its generated code works with protobuf 3.20, or with the pure Python implementation of newer versions.
    os.environ.setdefault("PROTOCOL_BUFFERS_PYTHON_IMPLEMENTATION", "python")
    for name in ("MutableMapping", "MutableSequence"):  # moved in Python 3.10, but the old protobuf needs them here
        if not hasattr(collections, name):
            setattr(collections, name, getattr(collections.abc, name))
    try:
        router = importlib.import_module("kortex_api.RouterClient")
        messages = "kortex_api.autogen.messages"
        stubs = "kortex_api.autogen.client_stubs"
        return Kortex(
            importlib.import_module("kortex_api.TCPTransport").TCPTransport,
            importlib.import_module("kortex_api.UDPTransport").UDPTransport,
            router.RouterClient,
            router.RouterClientSendOptions,
            importlib.import_module("kortex_api.SessionManager").SessionManager,
            importlib.import_module(f"{stubs}.BaseClientRpc").BaseClient,
            importlib.import_module(f"{stubs}.BaseCyclicClientRpc").BaseCyclicClient,
            importlib.import_module(f"{messages}.Session_pb2"),
            importlib.import_module(f"{messages}.Base_pb2"),
            importlib.import_module(f"{messages}.Common_pb2"),
        )
    except (ImportError, AttributeError, TypeError) as error:
        raise HardwareError(
            f"kortex_api cannot be imported ({error}). It is Kinova's own wheel, not on PyPI: download it (see "
            "https://github.com/Kinovarobotics/Kinova-kortex2_Gen3_G3L, section Python) and install it with "
            "pip install --no-deps kortex_api-2.*.whl && pip install 'protobuf==3.20.3' deprecated. The protobuf it asks "
            "for, 3.5.1, does not work on Python 3.10 or later; 3.20.3 does."
        ) from error


class KinovaArm:
    """A connected arm.

    Args:
        address: IP address or host name.
        kortex: the client library. None imports kortex_api.

    Raises:
        HardwareError: kortex_api is missing, the arm does not answer, or the password is wrong.
    """

    joint_count = JOINT_COUNT

    def __init__(
        self,
        address: str,
        *,
        username: str = "admin",
        password: str = "admin",
        kortex: Kortex | None = None,
        tcp_port: int = TCP_PORT,
        udp_port: int = UDP_PORT,
    ) -> None:
        self.address = address
        self._kortex = kortex or load_kortex()
        self._joints: NDArray[np.float64] | None = None
        self._links: list[tuple[Any, Any, Any]] = []
        try:
            self._base = self._kortex.BaseClient(self._link(self._kortex.TCPTransport, tcp_port, username, password))
            self._cyclic = self._kortex.BaseCyclicClient(
                self._link(self._kortex.UDPTransport, udp_port, username, password)
            )
        except BaseException:
            self.close()
            raise

    def describe(self) -> dict[str, Any]:
        """Return model and address."""
        return {"model": "Kinova Gen3", "gripper": "Robotiq 2F-85", "address": self.address, "joints": JOINT_COUNT}

    def prepare(self) -> None:
        """Take control of the arm, which must be ready.

        Raises:
            HardwareError: the arm is in fault, under manual control (gamepad, web page, by hand), or otherwise not
                ready. The message describes the remedy.
        """
        names = self._kortex.Common_pb2
        end = time.monotonic() + _TRANSIENT_S
        while True:
            state = self._call("GetArmState", self._base.GetArmState).active_state
            if state != names.ARMSTATE_SERVOING_MANUALLY_CONTROLLED or time.monotonic() > end:
                break
            time.sleep(0.05)
        if state == names.ARMSTATE_IN_FAULT:
            raise HardwareError(
                f"The arm at {self.address} is in fault ({self._faults(self._feedback())}). Release the emergency stop, "
                "look why, then clear it: diffcloud data capture --clear-faults, or the arm's web page."
            )
        if state == names.ARMSTATE_SERVOING_MANUALLY_CONTROLLED:
            raise HardwareError(
                f"The arm at {self.address} is under manual control: somebody drives it by gamepad, web page or hand. It "
                "is not taken from them; let go of it (and leave admittance mode), then try again."
            )
        if state != names.ARMSTATE_SERVOING_READY:
            raise HardwareError(f"The arm at {self.address} is not ready (state {state}); wait, or switch it on again.")
        mode = self._kortex.Base_pb2.ServoingModeInformation()
        mode.servoing_mode = self._kortex.Base_pb2.SINGLE_LEVEL_SERVOING
        self._call("SetServoingMode", self._base.SetServoingMode, mode)

    def clear_faults(self) -> None:
        """Clear faults. The emergency stop must be released first."""
        self._call("ClearFaults", self._base.ClearFaults)

    def home_joints(self) -> NDArray[np.float64]:
        """Return the joint angles [7] of the arm's action named Home [rad].

        Raises:
            HardwareError: the action does not exist, or has another number of joints.
        """
        wanted = self._kortex.Base_pb2.RequestedActionType()
        wanted.action_type = self._kortex.Base_pb2.REACH_JOINT_ANGLES
        actions = self._call("ReadAllActions", self._base.ReadAllActions, wanted).action_list
        for action in actions:
            if action.name == "Home":
                angles = action.reach_joint_angles.joint_angles.joint_angles
                degrees = [angle.value for angle in sorted(angles, key=lambda angle: angle.joint_identifier)]
                if len(degrees) != JOINT_COUNT or not np.isfinite(degrees).all():
                    raise HardwareError(
                        f"The action Home of the arm at {self.address} holds {degrees}, not 7 joint angles."
                    )
                return np.deg2rad(degrees)
        raise HardwareError(f"The arm at {self.address} has no action named Home; make one on its web page.")

    def read(self) -> ArmReading:
        """Measure joints, tool pose, wrench and gripper.

        Raises:
            HardwareError: the arm is in fault, or did not answer.
        """
        feedback = self._feedback()
        base = feedback.base
        if base.active_state == self._kortex.Common_pb2.ARMSTATE_IN_FAULT or base.fault_bank_a or base.fault_bank_b:
            raise HardwareError(f"The arm at {self.address} went into fault: {self._faults(feedback)}.")
        angles = np.array([base.tool_pose_theta_x, base.tool_pose_theta_y, base.tool_pose_theta_z])
        forces = [getattr(base, f"tool_external_wrench_force_{axis}") for axis in "xyz"]
        torques = [getattr(base, f"tool_external_wrench_torque_{axis}") for axis in "xyz"]
        return ArmReading(
            self._continued(np.deg2rad([actuator.position for actuator in feedback.actuators])),
            np.array([base.tool_pose_x, base.tool_pose_y, base.tool_pose_z]),
            # theta: rotations about the fixed x, y and z axes, in this order
            Rotation.from_euler("xyz", angles, degrees=True).as_quat(scalar_first=True),
            self._gripper(),
            np.array(forces + torques),
        )

    def send_velocity(self, linear_m_s: NDArray[np.float64]) -> None:
        """Move the tool with this velocity [3] in the base frame, without rotation, until the next command."""
        self._refuse_nan(linear_m_s)
        command = self._kortex.Base_pb2.TwistCommand()
        command.reference_frame = self._kortex.Common_pb2.CARTESIAN_REFERENCE_FRAME_BASE
        command.duration = 0
        command.twist.linear_x, command.twist.linear_y, command.twist.linear_z = map(float, linear_m_s)
        self._call("SendTwistCommand", self._base.SendTwistCommand, command)

    def send_joint_velocity(self, rad_s: NDArray[np.float64]) -> None:
        """Move the joints with these velocities [7] until the next command."""
        self._refuse_nan(rad_s)
        command = self._kortex.Base_pb2.JointSpeeds()
        for index, value in enumerate(np.rad2deg(rad_s)):
            joint = command.joint_speeds.add()
            joint.joint_identifier, joint.value = index, float(value)
        self._call("SendJointSpeedsCommand", self._base.SendJointSpeedsCommand, command)

    def set_gripper(self, position: float) -> None:
        """Move the gripper to a position from 0 (open) to 1 (closed), without waiting."""
        command = self._kortex.Base_pb2.GripperCommand()
        command.mode = self._kortex.Base_pb2.GRIPPER_POSITION
        finger = command.gripper.finger.add()
        finger.finger_identifier = 1
        finger.value = float(position)
        self._call("SendGripperCommand", self._base.SendGripperCommand, command)

    def stop(self) -> None:
        """Stop all motion."""
        self._call("Stop", self._base.Stop)

    def emergency_stop(self) -> None:
        """Call Kinova's ApplyEmergencyStop. The arm is in fault afterwards.

        `arm_process` calls this as a last resort, if Stop is refused or not answered. It does not replace the emergency
        button, which also works without a link.
        """
        self._call("ApplyEmergencyStop", self._base.ApplyEmergencyStop)

    def close(self) -> None:
        """Close sessions and links. Further calls have no effect. A lost link is not an error."""
        links, self._links = self._links, []
        for session, router, transport in reversed(links):
            for step in (
                lambda session=session: session.CloseSession(self._options()),
                lambda router=router: router.SetActivationStatus(False),
                transport.disconnect,
            ):
                try:
                    step()
                except Exception:  # a lost link raises many types of errors, and none can be handled here
                    continue

    def _link(self, kind: Any, port: int, username: str, password: str) -> Any:
        transport = kind()
        router = self._kortex.RouterClient(transport, lambda error: None)
        session = self._kortex.SessionManager(router)
        try:
            transport.connect(self.address, port)
            self._links.append((session, router, transport))
            info = self._kortex.Session_pb2.CreateSessionInfo()
            info.username, info.password = username, password
            info.session_inactivity_timeout = _SESSION_TIMEOUT_MS
            info.connection_inactivity_timeout = _CONNECTION_TIMEOUT_MS
            session.CreateSession(info)
        except Exception as error:  # kortex_api and sockets raise different types
            raise HardwareError(
                f"No arm answers at {self.address}:{port} ({type(error).__name__}: {error}). Check power, cable, that this "
                "computer is in the arm's network (ping it), and user name and password."
            ) from error
        return router

    def _refuse_nan(self, velocity: NDArray[np.float64]) -> None:
        if not np.isfinite(velocity).all():
            raise HardwareError(f"A velocity for the arm at {self.address} is not finite: {velocity}.")

    def _options(self) -> Any:
        options = self._kortex.RouterClientSendOptions()
        options.timeout_ms = _CALL_TIMEOUT_MS
        return options

    def _call(self, name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return function(*arguments, options=self._options())
        except Exception as error:  # KServerException, KClientException, timeouts and socket errors
            raise HardwareError(
                f"The arm at {self.address} did not carry out {name} ({type(error).__name__}: {error}): the link is lost, "
                "or the arm refused."
            ) from error

    def _feedback(self) -> Any:
        return self._call("RefreshFeedback", self._cyclic.RefreshFeedback)

    def _gripper(self) -> float | None:
        request = self._kortex.Base_pb2.GripperRequest()
        request.mode = self._kortex.Base_pb2.GRIPPER_POSITION
        fingers = self._call("GetMeasuredGripperMovement", self._base.GetMeasuredGripperMovement, request).finger
        return float(fingers[0].value) if len(fingers) else None

    def _continued(self, joints: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unwrap joint angles. The first reading is in (-pi, pi], later ones continue without jumps."""
        reference = np.zeros_like(joints) if self._joints is None else self._joints
        self._joints = reference + (joints - reference + np.pi) % (2 * np.pi) - np.pi
        return self._joints.copy()

    @staticmethod
    def _faults(feedback: Any) -> str:
        bank = int(feedback.base.fault_bank_a)
        named = [text for bit, text in _FAULTS.items() if bank & bit]
        return ", ".join(named) if named else f"fault banks {bank:#x} and {int(feedback.base.fault_bank_b):#x}"
