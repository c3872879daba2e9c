"""A simulated UR5e arm with a network interface, and its driver, as an example for your own driver.

    python -m diffcloud.hardware.examples.simulated_ur5e --port 5005
    diffcloud data capture --rig rig.yaml ...

rig.yaml holds `arm_driver: diffcloud.hardware.examples.simulated_ur5e:SimulatedUR5e` and `arm: 127.0.0.1:5005`.

The controller represents the arm's own computer. It moves the joints 125 times a second, and stops them if it receives
nothing for half a second. Any real arm needs such a timeout too, in case a process dies or a cable breaks.
"""

from __future__ import annotations

import json
import socket
import socketserver
import threading
import time
from importlib.resources import as_file, files
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffcloud.errors import HardwareError
from diffcloud.hardware.devices import ArmReading
from diffcloud.sensing.robot import Robot

Floats = NDArray[np.float64]

HOME_RAD = np.deg2rad([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])
"""Home pose: the tool points down, 0.49 m in front of the base and 0.36 m above it."""
_TICK_S = 0.008
_SILENCE_S = 0.5
_CALL_TIMEOUT_S = 0.4
_LAG_S = 0.02
"""Time constant with which the joints follow a commanded velocity."""


def ur5e() -> Robot:
    """Return the robot description of the simulated arm."""
    with as_file(files(__package__) / "ur5e.urdf") as path:
        return Robot.from_urdf(path)


class Controller:
    """The simulated arm with its controller. `serve` answers JSON requests, one per line."""

    def __init__(self, joints_rad: Floats = HOME_RAD) -> None:
        self._robot, self._lock = ur5e(), threading.RLock()
        self._joints, self._speeds = np.array(joints_rad, dtype=np.float64), np.zeros(6)
        self._tool_velocity: Floats | None = None
        self._joint_velocity = np.zeros(6)
        self._gripper, self._fault, self._prepared = 0.0, "", False
        self._heard = time.monotonic()
        self._ending = threading.Event()

    def serve(self, port: int = 0) -> socketserver.ThreadingTCPServer:
        """Start a server. Its `server_address` has the port, and its `shutdown` stops it."""
        controller = self

        class Link(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                for line in self.rfile:
                    self.wfile.write(controller.answer(line) + b"\n")

        server = socketserver.ThreadingTCPServer(("127.0.0.1", port), Link)
        server.daemon_threads = True
        for target in (server.serve_forever, self._move):
            threading.Thread(target=target, daemon=True).start()
        return server

    def end(self) -> None:
        self._ending.set()

    @property
    def tool_position(self) -> Floats:
        """[3] current tool position [m]."""
        with self._lock:
            return np.array(self._robot.tool_pose(self._joints)[:3, 3])

    def answer(self, line: bytes) -> bytes:
        try:
            told = json.loads(line)
            with self._lock:
                self._heard = time.monotonic()
                value = getattr(self, f"_call_{told['call']}")(*told.get("arguments", ()))
            return json.dumps({"value": value}).encode()
        except Exception as error:  # the controller must survive any request
            return json.dumps({"error": f"{type(error).__name__}: {error}"}).encode()

    def _move(self) -> None:
        last = time.monotonic()
        while not self._ending.wait(_TICK_S):
            with self._lock:
                now = time.monotonic()
                step, last = min(now - last, 0.1), now  # elapsed time, since a busy computer may be late
                if now - self._heard > _SILENCE_S:
                    self._call_stop()
                wanted = self._joint_velocity
                if self._tool_velocity is not None:
                    jacobian = self._robot.jacobian(self._joints)
                    wanted = np.linalg.solve(jacobian, np.concatenate([self._tool_velocity, np.zeros(3)]))
                self._speeds = self._speeds + min(1.0, step / _LAG_S) * (wanted - self._speeds)
                self._joints = self._joints + step * self._speeds

    def _call_prepare(self) -> None:
        if self._fault:
            raise RuntimeError(f"protective stop ({self._fault})")
        self._prepared = True

    def _call_clear_faults(self) -> None:
        self._fault = ""

    def _call_read(self) -> dict[str, Any]:
        if self._fault:
            raise RuntimeError(f"protective stop ({self._fault})")
        pose = self._robot.tool_pose(self._joints)
        return {
            "joints_rad": self._joints.tolist(),
            "position_m": pose[:3, 3].tolist(),
            "quaternion_xyzw": Rotation.from_matrix(pose[:3, :3]).as_quat().tolist(),
            "gripper": self._gripper,
            "wrench": [0.0] * 6,
        }

    def _call_tool_velocity(self, velocity: list[float]) -> None:
        self._refuse_unprepared()
        self._tool_velocity, self._joint_velocity = np.array(velocity), np.zeros(6)

    def _call_joint_velocity(self, velocity: list[float]) -> None:
        self._refuse_unprepared()
        self._tool_velocity, self._joint_velocity = None, np.array(velocity)

    def _call_gripper(self, position: float) -> None:
        self._gripper = float(position)

    def _call_stop(self) -> None:
        self._tool_velocity, self._joint_velocity = None, np.zeros(6)

    def _call_emergency_stop(self) -> None:
        self._call_stop()
        self._fault, self._prepared = "emergency stop", False

    def _refuse_unprepared(self) -> None:
        if self._fault or not self._prepared:
            raise RuntimeError(self._fault or "not prepared")


class SimulatedUR5e:
    """An arm driver that implements `devices.Arm`.

    Args:
        address: HOST:PORT of the controller.

    Raises:
        HardwareError: no controller answers at the address.
    """

    joint_count = 6

    def __init__(self, address: str) -> None:
        self.address = address
        # Stop uses its own connection, so that it never waits for the answer to another call.
        self._calls, self._stops = _Link(address), _Link(address)

    def describe(self) -> dict[str, Any]:
        return {"model": "simulated UR5e", "address": self.address, "joints": self.joint_count}

    def clear_faults(self) -> None:
        self._calls.call("clear_faults")

    def prepare(self) -> None:
        self._calls.call("prepare")

    def home_joints(self) -> Floats:
        return HOME_RAD.copy()

    def read(self) -> ArmReading:
        told = self._calls.call("read")
        return ArmReading(
            np.array(told["joints_rad"]),
            np.array(told["position_m"]),
            np.roll(told["quaternion_xyzw"], 1),
            told["gripper"],
            np.array(told["wrench"]),
        )

    def send_velocity(self, linear_m_s: Floats) -> None:
        self._calls.call("tool_velocity", np.asarray(linear_m_s).tolist())

    def send_joint_velocity(self, rad_s: Floats) -> None:
        self._calls.call("joint_velocity", np.asarray(rad_s).tolist())

    def set_gripper(self, position: float) -> None:
        self._calls.call("gripper", position)

    def stop(self) -> None:
        self._stops.call("stop")

    def emergency_stop(self) -> None:
        self._stops.call("emergency_stop")

    def close(self) -> None:
        self._calls.close()
        self._stops.close()


class _Link:
    """A socket that handles one request at a time."""

    def __init__(self, address: str) -> None:
        host, _, port = address.rpartition(":")
        self._address, self._lock = address, threading.Lock()
        try:
            self._socket = socket.create_connection((host, int(port)), timeout=_CALL_TIMEOUT_S)
        except (OSError, ValueError) as error:
            raise HardwareError(f"No controller answers at {address} ({error}). Give HOST:PORT.") from error
        self._stream = self._socket.makefile("rb")

    def call(self, name: str, *arguments: Any) -> Any:
        with self._lock:
            try:
                self._socket.sendall(json.dumps({"call": name, "arguments": arguments}).encode() + b"\n")
                told = json.loads(self._stream.readline())
            except (OSError, ValueError) as error:
                raise HardwareError(f"The arm at {self._address} did not answer to {name} ({error}).") from error
        if "error" in told:
            raise HardwareError(f"The arm at {self._address} refused {name}: {told['error']}.")
        return told["value"]

    def close(self) -> None:
        self._stream.close()
        self._socket.close()


def main(port: Annotated[int, typer.Option(help="On this computer; 0: any that is free.")] = 5005) -> None:
    """Run the controller until Ctrl-C."""
    server = Controller().serve(port)
    print(f"simulated UR5e at 127.0.0.1:{server.server_address[1]}", flush=True)
    threading.Event().wait()


if __name__ == "__main__":
    typer.run(main)
