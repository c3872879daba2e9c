"""A minimal client with the call surface of kortex_api, for machines without Kinova's wheel."""

from __future__ import annotations

import socket
import struct
import threading
from concurrent.futures import Future
from contextlib import suppress
from typing import Any

from diffcloud.hardware.kinova import Kortex
from tests.hardware.kortex import messages
from tests.hardware.kortex.messages import EVERYTHING, UIDS, Empty, Frame, Message, parsed

MAGIC = b"\x07xEtRoK\x07"


class KServerException(Exception):
    """The arm answered with an error."""


class TCPTransport:
    def connect(self, address: str, port: int) -> None:
        self._socket = socket.create_connection((address, port), timeout=2)
        self._socket.settimeout(None)

    def send(self, data: bytes) -> None:
        self._socket.sendall(MAGIC + struct.pack(">I", len(data)) + data)

    def receive(self) -> bytes | None:
        """One frame, or None when the link is gone."""
        head = self._exactly(12)
        if head is None or head[:8] != MAGIC:
            return None
        return self._exactly(struct.unpack(">I", head[8:])[0])

    def _exactly(self, count: int) -> bytes | None:
        data = b""
        while len(data) < count:
            try:
                more = self._socket.recv(count - len(data))
            except OSError:
                return None
            if not more:
                return None
            data += more
        return data

    def disconnect(self) -> None:
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


class UDPTransport:
    def connect(self, address: str, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((address, port))
        self._socket.settimeout(0.1)
        self._open = True

    def send(self, data: bytes) -> None:
        self._socket.send(data)

    def receive(self) -> bytes | None:
        while self._open:
            try:
                return self._socket.recv(65536)
            except TimeoutError:
                continue
            except ConnectionRefusedError:  # nobody listens there any more
                continue
            except OSError:
                return None
        return None

    def disconnect(self) -> None:
        self._open = False
        self._socket.close()


class RouterClientSendOptions:
    def __init__(self) -> None:
        self.timeout_ms = 10000


class RouterClient:
    def __init__(self, transport: Any, error_callback: Any) -> None:
        self._transport, self._callback = transport, error_callback
        self.session = 0
        self._waiting: dict[int, Future[Frame]] = {}
        self._number, self._lock = 0, threading.Lock()
        self._reader: threading.Thread | None = None

    def SetActivationStatus(self, active: bool) -> None:
        pass

    def call(self, name: str, request: Any, options: RouterClientSendOptions | None = None) -> bytes:
        if self._reader is None:
            self._reader = threading.Thread(target=self._read, daemon=True)
            self._reader.start()
        answer: Future[Frame] = Future()
        with self._lock:
            self._number = self._number % 0xFFFF + 1
            number = self._number
            self._waiting[number] = answer
            self._transport.send(Frame.build(1, UIDS[name], self.session, number, request.SerializeToString()).encode())
        frame = answer.result((options or RouterClientSendOptions()).timeout_ms / 1000)
        if frame.error != (0, 0):
            raise KServerException(f"error {frame.error[0]}, sub-error {frame.error[1]}")
        self.last = frame
        return frame.payload

    def _read(self) -> None:
        while (data := self._transport.receive()) is not None:
            frame = Frame.decode(data)
            if (answer := self._waiting.pop(frame.number, None)) is not None:
                answer.set_result(frame)
        for answer in self._waiting.values():
            answer.set_exception(ConnectionError("the link was closed"))


class SessionManager:
    def __init__(self, router: RouterClient) -> None:
        self._router = router
        self._ended = threading.Event()

    def CreateSession(self, info: Any) -> None:
        self._router.call("CreateSession", info)
        self._router.session = self._router.last.session
        threading.Thread(target=self._keep_alive, daemon=True).start()

    def CloseSession(self, options: Any = None) -> None:
        self._ended.set()
        self._router.call("CloseSession", Empty(), options)

    def _keep_alive(self) -> None:
        while not self._ended.wait(0.15):
            try:
                self._router.call("KeepAlive", Empty())
            except Exception:
                return


def _stub(name: str, answer: type[Message]) -> Any:
    def call(self: Any, request: Any = None, deviceId: int = 0, options: Any = None) -> Any:
        return parsed(answer, self._router.call(name, Empty() if request is None else request, options))

    return call


class BaseClient:
    def __init__(self, router: RouterClient) -> None:
        self._router = router

    GetArmState = _stub("GetArmState", messages.ArmStateInformation)
    SetServoingMode = _stub("SetServoingMode", Empty)
    ReadAllActions = _stub("ReadAllActions", messages.ActionList)
    SendJointSpeedsCommand = _stub("SendJointSpeedsCommand", Empty)
    SendTwistCommand = _stub("SendTwistCommand", Empty)
    Stop = _stub("Stop", Empty)
    ApplyEmergencyStop = _stub("ApplyEmergencyStop", Empty)
    ClearFaults = _stub("ClearFaults", Empty)
    SendGripperCommand = _stub("SendGripperCommand", Empty)
    GetMeasuredGripperMovement = _stub("GetMeasuredGripperMovement", messages.Gripper)
    GetMeasuredCartesianPose = _stub("GetMeasuredCartesianPose", messages.Pose)
    GetMeasuredJointAngles = _stub("GetMeasuredJointAngles", messages.JointAngles)


class BaseCyclicClient:
    def __init__(self, router: RouterClient) -> None:
        self._router = router

    def RefreshFeedback(self, deviceId: int = 0, options: Any = None) -> Any:
        return parsed(messages.Feedback, self._router.call("RefreshFeedback", Empty(), options))


MINIMAL = Kortex(
    TCPTransport,
    UDPTransport,
    RouterClient,
    RouterClientSendOptions,
    SessionManager,
    BaseClient,
    BaseCyclicClient,
    EVERYTHING,
    EVERYTHING,
    EVERYTHING,
)
