"""The few Kortex messages that a capture needs, in protobuf's wire format, without protobuf.

Attributes behave like those of generated protobuf code as far as the adapter uses them: zero by default, nested messages
there on first touch, `add()` on repeated ones. Field numbers are those of Kinova's published .proto files.
"""

from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any, ClassVar

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5


class Repeated(list):
    """A repeated field."""

    def __init__(self, kind: type[Message]) -> None:
        super().__init__()
        self._kind = kind

    def add(self) -> Any:
        self.append(self._kind())
        return self[-1]


class Message:
    """Fields: name -> (number, kind); kind is uint, fixed32, float, string, a message class, or a list of one."""

    FIELDS: ClassVar[dict[str, tuple[int, Any]]] = {}

    def __init__(self, **values: Any) -> None:
        for name, value in values.items():
            setattr(self, name, value)

    def __getattr__(self, name: str) -> Any:
        if name not in self.FIELDS:
            raise AttributeError(f"{type(self).__name__} has no field {name}")
        kind = self.FIELDS[name][1]
        value: Any
        if isinstance(kind, list):
            value = Repeated(kind[0])
        elif isinstance(kind, type):
            value = kind()
        else:
            value = {"string": "", "float": 0.0}.get(kind, 0)
        self.__dict__[name] = value
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self.FIELDS:
            raise AttributeError(f"{type(self).__name__} has no field {name}")
        self.__dict__[name] = value

    def SerializeToString(self) -> bytes:
        out = bytearray()
        for name, (number, kind) in sorted(self.FIELDS.items(), key=lambda item: item[1][0]):
            if name not in self.__dict__:
                continue
            value = self.__dict__[name]
            if isinstance(kind, list):
                for item in value:
                    out += _tagged(number, item.SerializeToString())
            elif isinstance(kind, type):
                out += _tagged(number, value.SerializeToString())
            elif kind == "string" and value:
                out += _tagged(number, value.encode())
            elif kind == "uint" and value:
                out += _varint(number << 3 | VARINT) + _varint(int(value))
            elif kind in ("fixed32", "float") and value:
                out += _varint(number << 3 | FIXED32) + struct.pack("<I" if kind == "fixed32" else "<f", value)
        return bytes(out)

    def ParseFromString(self, data: bytes) -> None:
        numbers = {number: (name, kind) for name, (number, kind) in self.FIELDS.items()}
        for number, wire, raw in _fields(data):
            if number not in numbers:
                continue
            name, kind = numbers[number]
            if isinstance(kind, list):
                getattr(self, name).add().ParseFromString(raw)
            elif isinstance(kind, type):
                getattr(self, name).ParseFromString(raw)
            elif wire == BYTES:
                setattr(self, name, raw.decode())
            elif wire == FIXED32:
                setattr(self, name, struct.unpack("<f" if kind == "float" else "<I", raw)[0])
            else:
                setattr(self, name, raw)


def parsed(kind: type[Message], data: bytes) -> Any:
    message = kind()
    message.ParseFromString(data)
    return message


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _tagged(number: int, data: bytes) -> bytes:
    return _varint(number << 3 | BYTES) + _varint(len(data)) + data


def _read_varint(data: bytes, position: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return value, position


def _fields(data: bytes) -> Any:
    position = 0
    while position < len(data):
        tag, position = _read_varint(data, position)
        number, wire = tag >> 3, tag & 7
        if wire == VARINT:
            raw, position = _read_varint(data, position)
        else:
            length = {FIXED32: 4, FIXED64: 8}.get(wire)
            if length is None:
                length, position = _read_varint(data, position)
            raw = data[position : position + length]
            position += length
        yield number, wire, raw


def _message(class_name: str, **fields: tuple[int, Any]) -> Any:
    return type(class_name, (Message,), {"FIELDS": fields})


_POSE = ("x", "y", "z", "theta_x", "theta_y", "theta_z")
Header = _message(
    "Header",
    frame_info=(1, "fixed32"),
    message_info=(2, "fixed32"),
    service_info=(3, "fixed32"),
    payload_info=(4, "fixed32"),
)


class Frame:
    """Header and payload; the payload is bytes, which `Message` does not know."""

    def __init__(self, header: Any, payload: bytes) -> None:
        self.header, self.payload = header, payload

    def encode(self) -> bytes:
        return _tagged(1, self.header.SerializeToString()) + _tagged(2, self.payload)

    @staticmethod
    def decode(data: bytes) -> Frame:
        parts = {number: raw for number, _, raw in _fields(data)}
        return Frame(parsed(Header, parts[1]), parts.get(2, b""))

    @staticmethod
    def build(kind: int, uid: int, session: int, number: int, payload: bytes, error: int = 0, suberror: int = 0) -> Frame:
        """kind: 1 request, 3 response, 5 notification; uid: service (high half) and function (low half)."""
        service, function = uid >> 16, uid & 0xFFFF
        header = Header(
            frame_info=1 << 28 | kind << 24 | error << 12 | suberror,
            message_info=session << 16 | number,
            service_info=1 << 28 | service << 16 | function,
            payload_info=len(payload),
        )
        return Frame(header, payload)

    @property
    def kind(self) -> int:
        return self.header.frame_info >> 24 & 0xF

    @property
    def error(self) -> tuple[int, int]:
        return self.header.frame_info >> 12 & 0xF, self.header.frame_info & 0xFFF

    @property
    def uid(self) -> int:
        return self.header.service_info & 0xFFFFFFF

    @property
    def session(self) -> int:
        return self.header.message_info >> 16

    @property
    def number(self) -> int:
        return self.header.message_info & 0xFFFF


Empty = _message("Empty")
CreateSessionInfo = _message(
    "CreateSessionInfo",
    username=(1, "string"),
    session_inactivity_timeout=(2, "uint"),
    password=(3, "string"),
    connection_inactivity_timeout=(4, "uint"),
)
ServoingModeInformation = _message("ServoingModeInformation", servoing_mode=(1, "uint"))
RequestedActionType = _message("RequestedActionType", action_type=(1, "uint"))
ActionHandle = _message("ActionHandle", identifier=(1, "uint"), action_type=(2, "uint"))
JointAngle = _message("JointAngle", joint_identifier=(1, "uint"), value=(2, "float"))
JointAngles = _message("JointAngles", joint_angles=(1, [JointAngle]))
ConstrainedJointAngles = _message("ConstrainedJointAngles", joint_angles=(1, JointAngles))
Action = _message("Action", handle=(1, ActionHandle), name=(2, "string"), reach_joint_angles=(10, ConstrainedJointAngles))
ActionList = _message("ActionList", action_list=(1, [Action]))
Pose = _message("Pose", **{name: (index + 1, "float") for index, name in enumerate(_POSE)})
Twist = _message(
    "Twist",
    **{f"{kind}_{axis}": (3 * block + index + 1, "float")
       for block, kind in enumerate(("linear", "angular")) for index, axis in enumerate("xyz")},
)  # fmt: skip
TwistCommand = _message("TwistCommand", reference_frame=(1, "uint"), twist=(2, Twist), duration=(3, "uint"))
JointSpeed = _message("JointSpeed", joint_identifier=(1, "uint"), value=(2, "float"), duration=(3, "uint"))
JointSpeeds = _message("JointSpeeds", joint_speeds=(1, [JointSpeed]), duration=(2, "uint"))
Finger = _message("Finger", finger_identifier=(1, "uint"), value=(2, "float"))
Gripper = _message("Gripper", finger=(1, [Finger]))
GripperCommand = _message("GripperCommand", mode=(1, "uint"), gripper=(2, Gripper), duration=(3, "uint"))
GripperRequest = _message("GripperRequest", mode=(1, "uint"))
ArmStateInformation = _message("ArmStateInformation", active_state=(1, "uint"))
BaseFeedback = _message(
    "BaseFeedback",
    active_state=(2, "uint"),
    **{f"tool_pose_{name}": (13 + index, "float") for index, name in enumerate(_POSE)},
    **{f"tool_external_wrench_{kind}_{axis}": (25 + 3 * block + index, "float")
       for block, kind in enumerate(("force", "torque")) for index, axis in enumerate("xyz")},
    fault_bank_a=(31, "fixed32"),
    fault_bank_b=(32, "fixed32"),
)  # fmt: skip
ActuatorFeedback = _message("ActuatorFeedback", position=(4, "float"), velocity=(5, "float"))
Feedback = _message("Feedback", frame_id=(1, "fixed32"), base=(2, BaseFeedback), actuators=(3, [ActuatorFeedback]))

UIDS = {
    "CreateSession": 0x10001,
    "CloseSession": 0x10002,
    "KeepAlive": 0x10003,
    "ReadAllActions": 0x2002C,
    "Stop": 0x20070,
    "GetMeasuredCartesianPose": 0x20073,
    "SendTwistCommand": 0x20079,
    "GetMeasuredJointAngles": 0x2007E,
    "SendJointSpeedsCommand": 0x20084,
    "SendGripperCommand": 0x20088,
    "GetMeasuredGripperMovement": 0x20089,
    "ApplyEmergencyStop": 0x20091,
    "ClearFaults": 0x20092,
    "SetServoingMode": 0x20098,
    "GetArmState": 0x200AF,
    "RefreshFeedback": 0x30003,
}
NAMES = {uid: name for name, uid in UIDS.items()}

CONSTANTS = {
    "SINGLE_LEVEL_SERVOING": 2,
    "REACH_JOINT_ANGLES": 7,
    "GRIPPER_POSITION": 3,
    "CARTESIAN_REFERENCE_FRAME_BASE": 3,
    "ARMSTATE_IN_FAULT": 4,
    "ARMSTATE_SERVOING_READY": 7,
    "ARMSTATE_SERVOING_MANUALLY_CONTROLLED": 9,
}
EVERYTHING = SimpleNamespace(
    **CONSTANTS, **{name: kind for name, kind in globals().items() if isinstance(kind, type) and name[0].isupper()}
)
"""Stands for Session_pb2, Base_pb2 and Common_pb2 alike."""
