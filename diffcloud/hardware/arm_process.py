"""The arm's connection in its own process, which stops the arm if the capture hangs, is suspended, or dies.

A velocity command is valid until the next command, so some process must be able to send Stop. The capture may be
suspended (Ctrl-Z, SIGSTOP), killed, or blocked in a driver. So a child process owns the connection and does nothing
else. It runs in its own session, so signals of the terminal do not reach it. Any catchable signal makes it stop the
arm. It sends Stop

- if the arm moves and the capture has sent nothing for `watchdog_s` (watchdog),
- if the socket to the capture closes, because the capture has ended,
- if the capture requests it. `stop` waits for confirmation. `halt` does not wait and is safe in a signal handler.

If the arm does not confirm a Stop, the child repeats it, then applies the emergency stop, warns the user, and repeats
again. After a Stop, velocities are refused until the next `prepare`. If a velocity command overlaps with a Stop, a
second Stop follows. So the last command that the arm receives after a Stop is never a velocity.

If the child itself is killed or suspended, or the cable is cut, the arm's own connection timeout stops it (`kinova`).
This works only if the connection is not kept alive, so a child without a capture exits after a few seconds.

The socket keeps message boundaries (SOCK_SEQPACKET), so a signal cannot leave a partial message. The child is a plain
subprocess. multiprocessing would import the caller's `__main__`, which would restart a script without a guard. It would
also wait at exit for a child that ignores SIGTERM.
"""

from __future__ import annotations

import os
import pickle
import queue
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from types import FrameType
from typing import Any

from diffcloud.errors import DiffCloudError, HardwareError, UnconfirmedStopError
from diffcloud.hardware.devices import Arm, ArmReading, Floats
from diffcloud.hardware.interruption import catchable_signals

WATCHDOG_S = 0.5
"""Watchdog timeout: about 25 missed readings of the control loop."""

_STOP_ATTEMPTS = 2
_REPEAT_S = 0.2
"""Time between attempts at a Stop that the arm has not confirmed."""
_GIVE_UP_S = 3.0
"""Time for which the child tries to stop the arm after the capture has ended."""
_IN_FLIGHT_S = 0.5
"""Time to wait for a command that overlaps with a Stop, before a second Stop is sent."""
_LARGEST_MESSAGE = 1 << 16
_OPEN_TIMEOUT_S = 60.0
_CALL_TIMEOUT_S = 2.0
_TIMEOUTS_S = {"prepare": 10.0, "stop": 2.5, "emergency_stop": 2.5}
"""Timeouts of slower calls. `prepare` waits for a transient state, and a Stop may need several attempts."""
_VELOCITIES = ("send_velocity", "send_joint_velocity")
_CLOSE_TIMEOUT_S = 6.0
_DISCONNECT_TIMEOUT_S = 2.0
_SHOUT_EVERY_S = 1.0
_HALT = pickle.dumps((0, "halt", ()))
MAY_BE_MOVING = "THE ARM MAY STILL BE MOVING: PRESS THE EMERGENCY STOP."


class ArmProcess:
    """A connected arm in a child process. It implements `devices.GuardedArm`.

    Args:
        open_arm: function that connects to the arm. It is pickled and called in the child, so it must be a function of
            a module (or a `functools.partial` of one), not of a script.
        watchdog_s: longest silence of the capture while the arm moves.

    Raises:
        HardwareError: `open_arm` failed, or the child could not be started.
    """

    def __init__(self, open_arm: Callable[[], Arm], *, watchdog_s: float = WATCHDOG_S) -> None:
        self._lock = threading.Lock()
        self._number = 0
        try:
            self._socket, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        except OSError as error:
            raise HardwareError(
                f"This system has no sockets that keep message boundaries ({error}), over which the process that holds the "
                "arm is reached. Linux has them, macOS does not: drive the arm from Linux."
            ) from error
        code = (
            f"import sys; sys.path[:] = {sys.path!r}; from diffcloud.hardware.arm_process import serve; "
            f"serve({there.fileno()})"
        )
        try:
            with there:
                self._process = subprocess.Popen(
                    [sys.executable, "-c", code],
                    pass_fds=[there.fileno()],
                    start_new_session=True,
                    stdin=subprocess.DEVNULL,
                    stdout=2,  # keep prints of libraries out of the capture's output
                )
        except OSError as error:
            self._socket.close()
            raise HardwareError(f"The process that is to hold the arm could not be started: {error}.") from error
        try:
            # Send the factory over the socket. It may have a password, which must not appear in the process list.
            self._socket.settimeout(_OPEN_TIMEOUT_S)
            self._socket.send(pickle.dumps((open_arm, watchdog_s)))
            self._description, self.joint_count = self._answer(0, "open", _OPEN_TIMEOUT_S)
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """Process ID of the child."""
        return self._process.pid

    def describe(self) -> dict[str, Any]:
        """Return model and address of the arm."""
        return dict(self._description)

    def clear_faults(self) -> None:
        """See `Arm`."""
        self._call("clear_faults")

    def prepare(self) -> None:
        """See `Arm`. Velocities are accepted afterwards."""
        self._call("prepare")

    def home_joints(self) -> Floats:
        """See `Arm`."""
        joints: Floats = self._call("home_joints")
        return joints

    def read(self) -> ArmReading:
        """See `Arm`."""
        reading: ArmReading = self._call("read")
        return reading

    def send_velocity(self, linear_m_s: Floats) -> None:
        """See `Arm`.

        Raises:
            HardwareError: also after a Stop until the next `prepare`. The message has the reason of the Stop.
        """
        self._call("send_velocity", linear_m_s)

    def send_joint_velocity(self, rad_s: Floats) -> None:
        """See `Arm`. Refused after a Stop, as in `send_velocity`."""
        self._call("send_joint_velocity", rad_s)

    def set_gripper(self, position: float) -> None:
        """See `Arm`."""
        self._call("set_gripper", position)

    def stop(self) -> None:
        """Stop all motion. Velocities are refused until the next `prepare`.

        Raises:
            UnconfirmedStopError: the arm confirmed neither Stop nor emergency stop. The child keeps trying.
        """
        self._stop("stop")

    def emergency_stop(self) -> None:
        """Apply the arm's emergency stop without trying Stop first. Otherwise as `stop`."""
        self._stop("emergency_stop")

    def halt(self) -> None:
        """Request a Stop without waiting. The message is atomic, so a signal handler may call this at any time."""
        with suppress(OSError):  # the child is gone or its queue is full; `stop`, which follows, reports this
            os.write(self._socket.fileno(), _HALT)  # bypass the socket object, which an interrupted call may be using

    def close(self) -> None:
        """Disconnect and end the child, which first stops a moving arm. Further calls have no effect."""
        self._socket.close()
        try:
            self._process.wait(_CLOSE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()  # the driver hangs; the arm's connection timeout then stops the arm
            self._process.wait()

    def _stop(self, name: str) -> None:
        try:
            self._call(name)
        except UnconfirmedStopError:
            raise
        except HardwareError as error:
            raise UnconfirmedStopError(f"{MAY_BE_MOVING} Stop could not be sent: {error}") from error

    def _call(self, name: str, *arguments: Any) -> Any:
        with self._lock:
            self._number += 1
            try:
                self._socket.send(pickle.dumps((self._number, name, arguments)))
            except OSError as error:
                raise HardwareError(f"The process that holds the arm is gone ({error}).") from error
            return self._answer(self._number, name, _TIMEOUTS_S.get(name, _CALL_TIMEOUT_S))

    def _answer(self, wanted: int, name: str, timeout_s: float) -> Any:
        deadline = time.monotonic() + timeout_s
        while True:
            self._socket.settimeout(max(1e-3, deadline - time.monotonic()))
            try:
                data = self._socket.recv(_LARGEST_MESSAGE)
            except TimeoutError as error:
                raise HardwareError(
                    f"The process that holds the arm did not answer to {name} within {timeout_s:g} s: it hangs or was "
                    "suspended."
                ) from error
            except OSError as error:
                raise HardwareError(f"The link to the process that holds the arm is broken ({error}).") from error
            if not data:
                raise HardwareError(f"The process that holds the arm ended during {name}: it was killed, or it crashed.")
            number, value, error_raised = pickle.loads(data)
            if number != wanted:  # late answer to a call that a signal interrupted
                continue
            if error_raised is not None:
                raise error_raised
            return value


def serve(handle: int) -> None:
    """Main function of the child: open the arm, execute requests, and watch the capture.

    Args:
        handle: inherited file descriptor of the socket to the capture.
    """
    waker, woken = socket.socketpair()
    waker.setblocking(False)
    for number in catchable_signals():
        signal.signal(number, _wake)
    signal.set_wakeup_fd(waker.fileno(), warn_on_full_buffer=False)
    with socket.socket(fileno=handle) as link, waker, woken:
        try:
            open_arm, watchdog_s = pickle.loads(link.recv(_LARGEST_MESSAGE))
            arm = open_arm()
        except Exception as error:
            _send(link, 0, None, _sendable(error))
            return
        try:
            _send(link, 0, (arm.describe(), arm.joint_count), None)
            _Service(link, woken, arm, watchdog_s).run()
        finally:
            # Close in a thread, so that a driver that hangs does not keep the connection alive.
            closing = threading.Thread(target=arm.close, daemon=True)
            closing.start()
            closing.join(_DISCONNECT_TIMEOUT_S)
            os._exit(0)


def _wake(number: int, _: FrameType | None) -> None:
    """Keep a signal from ending or suspending the process. The wakeup socket notifies the main loop of it."""


@dataclass(frozen=True)
class _Request:
    number: int
    name: str
    arguments: tuple[Any, ...]
    stops: int
    """Number of Stops requested before this request."""


class _Service:
    """Executes requests in a worker thread, while the main thread receives messages and calls only Stop.

    So neither a call that hangs nor a slow answer of the arm delays a Stop.
    """

    def __init__(self, link: socket.socket, woken: socket.socket, arm: Arm, watchdog_s: float) -> None:
        self._link, self._woken, self._arm, self._watchdog_s = link, woken, arm, watchdog_s
        self._requests: queue.SimpleQueue[_Request | None] = queue.SimpleQueue()
        self._commanding = threading.Lock()
        """Held while a velocity command is being sent to the arm."""
        self._stops = 0
        """Number of Stops requested so far. Velocities are accepted only while `_prepared` equals it. So a `prepare`
        from before a Stop can never unlock velocities after it."""
        self._prepared = -1
        self._reason = "it has not been prepared yet"
        self._moving = False
        """A velocity was received since the last confirmed Stop."""
        self._unconfirmed = False
        self._tried = self._shouted = 0.0

    def run(self) -> None:
        """Serve until the capture closes the socket or dies. Then stop the arm if it moves."""
        worker = threading.Thread(target=self._work, name="arm calls", daemon=True)
        worker.start()
        reason = "the capture has ended"
        try:
            self._attend()
        except Exception as error:  # stop the arm on any failure
            reason = f"the process that holds it failed ({type(error).__name__}: {error})"
            _shout(f"The arm is stopped and its connection closed: {reason}.")
        self._requests.put(None)
        if self._moving:
            self._halt(reason)
            end = time.monotonic() + _GIVE_UP_S
            while self._unconfirmed and time.monotonic() < end:
                time.sleep(_REPEAT_S)
                self._try_stop(1)

    def _attend(self) -> None:
        heard = time.monotonic()
        while True:
            patience = None
            if self._unconfirmed:
                patience = _REPEAT_S
            elif self._moving:
                patience = max(0.0, heard + self._watchdog_s - time.monotonic())
            ready, _, _ = select.select([self._link, self._woken], [], [], patience)
            if self._woken in ready:
                self._woken.recv(4096)
                self._halt("a signal came to the process that holds it")
            if self._link in ready:
                data = _received(self._link)
                if not data:
                    break
                heard = time.monotonic()
                self._receive(data)
            if self._unconfirmed:
                if time.monotonic() - self._tried >= _REPEAT_S:
                    self._try_stop(1)
            elif self._moving and time.monotonic() - heard >= self._watchdog_s:
                self._halt(f"nothing came from the capture for {self._watchdog_s:g} s: it hangs, or was suspended")

    def _receive(self, data: bytes) -> None:
        number, name, arguments = pickle.loads(data)
        if name == "halt":
            self._halt("the capture was interrupted")
        elif name == "stop":
            _send(self._link, number, None, self._halt("the capture sent Stop"))
        elif name == "emergency_stop":
            _send(self._link, number, None, self._halt("the capture sent the emergency stop", attempts=0))
        elif name in _VELOCITIES and self._prepared != self._stops:
            # Refuse before the watchdog is armed: no Stop is needed for an arm that has not moved.
            _send(self._link, number, None, self._refusal())
        else:
            if name in _VELOCITIES:
                self._moving = True  # arm the watchdog, even if the command fails later
            self._requests.put(_Request(number, name, arguments, self._stops))

    def _refusal(self) -> HardwareError:
        return HardwareError(f"The arm was stopped and takes no velocities until it is prepared again: {self._reason}.")

    def _halt(self, reason: str, attempts: int = _STOP_ATTEMPTS) -> UnconfirmedStopError | None:
        self._stops += 1  # first, so that no velocity is sent from now on
        self._reason = reason
        return self._try_stop(attempts)

    def _try_stop(self, attempts: int) -> UnconfirmedStopError | None:
        """Try Stop, then the emergency stop. Return None if the arm confirmed one of them."""
        self._unconfirmed = True
        in_flight = self._commanding.locked()
        failure = self._stop_confirmed(attempts)
        if in_flight:
            # This velocity passed the check before the Stop, and may have reached the arm after it.
            if self._commanding.acquire(timeout=_IN_FLIGHT_S):
                self._commanding.release()
                failure = self._stop_confirmed(attempts)
            else:
                failure = HardwareError("a velocity command hangs on its way to the arm")
        self._tried = time.monotonic()
        if failure is None:
            self._moving = self._unconfirmed = False
            return None
        text = f"{MAY_BE_MOVING} It did not confirm Stop ({failure})"
        if time.monotonic() - self._shouted >= _SHOUT_EVERY_S:
            self._shouted = time.monotonic()
            _shout(f"{text}; Stop is repeated.")
        return UnconfirmedStopError(f"{text}; Stop was repeated, and goes on being repeated while this process lives.")

    def _stop_confirmed(self, attempts: int) -> Exception | None:
        failure: Exception | None = None
        for _ in range(attempts):
            try:
                self._arm.stop()
                return None
            except Exception as error:  # try again after any error of the driver
                failure = error
        try:
            # Last resort: an arm that refuses Stop may accept this, and is in fault afterwards. If the link is lost,
            # this fails like Stop and costs one more call.
            self._arm.emergency_stop()
            told = "The arm's" if failure is None else f"The arm did not confirm Stop ({failure}); its"
            _shout(f"{told} emergency stop was applied, and it is in fault.")
            return None
        except Exception as error:
            return failure or error

    def _work(self) -> None:
        while (request := self._requests.get()) is not None:
            try:  # pickling is inside, because results of a driver may not be picklable
                answer = pickle.dumps((request.number, self._carry_out(request), None))
            except Exception as failure:  # send every failure to the capture, and keep this thread alive
                answer = pickle.dumps((request.number, None, _sendable(failure)))
            _deliver(self._link, answer)

    def _carry_out(self, request: _Request) -> Any:
        call = getattr(self._arm, request.name)
        if request.name in _VELOCITIES:
            with self._commanding:
                if self._prepared != self._stops:
                    raise self._refusal()
                return call(*request.arguments)
        value = call(*request.arguments)
        if request.name == "prepare":
            self._prepared = request.stops
        return value


def _sendable(error: Exception) -> DiffCloudError:
    """Convert errors of other types to HardwareError. The parent may not be able to unpickle a driver's own types."""
    if type(error) in (HardwareError, UnconfirmedStopError):
        return error  # type: ignore[return-value]  # the type was checked above
    return HardwareError(str(error) if isinstance(error, DiffCloudError) else f"{type(error).__name__}: {error}")


def _received(link: socket.socket) -> bytes:
    """Receive one message. Empty if the other side is gone."""
    try:
        return link.recv(_LARGEST_MESSAGE)
    except OSError:
        return b""


def _send(link: socket.socket, number: int, value: Any, error: DiffCloudError | None) -> None:
    _deliver(link, pickle.dumps((number, value, error)))


def _deliver(link: socket.socket, message: bytes) -> None:
    with suppress(OSError):  # the capture is gone; the main thread also notices it and stops the arm
        link.send(message)


def _shout(text: str) -> None:
    with suppress(OSError):  # the terminal may be gone
        os.write(2, f"{text}\n".encode())
