"""Test a driver against the requirements of a capture: units, frames, times, and stopping distance and time.

For an arm, readings alone are not sufficient. It must move slowly by a few centimetres and be stopped in each way that
a capture relies on: Stop, a silent capture (watchdog), and a lost link, as when a cable is cut.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffcloud.errors import DiffCloudError, HardwareError, LimitError, UnconfirmedStopError
from diffcloud.hardware.arm_limits import ArmChecker
from diffcloud.hardware.arm_process import WATCHDOG_S, ArmProcess
from diffcloud.hardware.contact import at_rest, sizes
from diffcloud.hardware.devices import ArmReading, Camera
from diffcloud.hardware.installed import Check
from diffcloud.sensing.validation.episode import FARTHEST_M, NEAREST_M

Floats = NDArray[np.float64]

SPEED_M_S = 0.02
"""Speed of all test motions."""
_MOVED_S = 1.0
_READ_MS = 20.0
"""Largest median time of one reading. The control loop reads 50 times a second."""
_COMMAND_S = 0.1
_STOP_S = 0.3
"""Largest time from Stop to standstill."""
_LINK_S = 1.0
"""Largest time from loss of the link to standstill."""
_STILL_M = 2e-4
_OFF = 0.3
"""Largest relative difference between measured and commanded velocity."""
_TURNED_RAD = float(np.deg2rad(2.0))
_NEEDED_M = 0.08
"""Free height needed above the tool."""
_PULLED_S = 5.0
"""Time for the user to pull the cable."""
_UP = np.array([0.0, 0.0, SPEED_M_S])


def check_camera(camera: Camera, *, seconds: float = 2.0, timeout_s: float = 1.0) -> Iterator[Check]:
    """Open a camera, read frames for some seconds, and close it. Yield the results of the checks."""
    try:
        info = camera.open()
    except DiffCloudError as error:
        yield Check("opens", "wrong", str(error))
        return
    frames, waits, failure = [], [], ""
    try:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            began = time.monotonic()
            frames.append((camera.read(timeout_s), time.monotonic()))
            waits.append(frames[-1][1] - began)
    except DiffCloudError as error:
        failure = str(error)
    finally:
        camera.close()
    if failure or len(frames) < 2:
        yield Check("delivers", "wrong", failure or f"{len(frames)} frames in {seconds:g} s")
        return
    yield Check("delivers", "ok", f"{len(frames) / seconds:.1f} frames a second, the longest wait {max(waits):.3f} s")
    times = np.array([frame.time_s for frame, _ in frames])
    ages = np.array([heard for _, heard in frames]) - times
    step = float(np.diff(times).min())
    yield _check("times increase", step > 0, f"smallest step {step:.4f} s")
    yield _check(
        "times are time.monotonic()", bool((ages > -0.05).all() and (ages < 2.0).all()),
        f"frames are {ages.min():.3f} to {ages.max():.3f} s old when they arrive; must be 0 to 2",
    )  # fmt: skip
    frame, size = frames[-1][0], (info.intrinsics.height, info.intrinsics.width)
    yield _check(
        "depth", frame.depth.dtype == np.uint16 and frame.depth.shape == size,
        f"{frame.depth.dtype} {list(frame.depth.shape)}; must be uint16 {list(size)}, as its intrinsics say",
    )  # fmt: skip
    if frame.color is not None:
        wanted = (*size, 3)
        yield _check(
            "colour", frame.color.dtype == np.uint8 and frame.color.shape == wanted,
            f"{frame.color.dtype} {list(frame.color.shape)}; must be uint8 {list(wanted)}, red green blue",
        )  # fmt: skip
    seen = frame.depth[frame.depth > 0]
    middle = float(np.median(seen)) * info.depth_scale_m if seen.size else 0.0
    yield _check(
        "depth scale", NEAREST_M < middle < FARTHEST_M,
        f"the median depth is {middle:.2f} m with {info.depth_scale_m:g} m per unit; must be {NEAREST_M:g} to "
        f"{FARTHEST_M:g}",
    )  # fmt: skip
    try:
        camera.read(0.05)
        yield Check("closed", "wrong", "it delivers frames after close()")
    except HardwareError:
        camera.close()
        yield Check("closed", "ok", "raises HardwareError when it is read after close(), and may be closed twice")


@dataclass(frozen=True)
class _Way:
    """Time and distance until an arm came to rest."""

    seconds: float
    moved_m: float


class _Guarded:
    """An arm that moves up, with all readings checked against the limits."""

    def __init__(self, arm: ArmProcess, checker: ArmChecker) -> None:
        self.arm = arm
        arm.prepare()
        self.rest, self._contact = at_rest(arm, checker.limits)
        self._watch, self._began = checker.watch("check", self.rest), time.monotonic()

    def read(self) -> ArmReading:
        """Read the arm and check the reading.

        Raises:
            LimitError: contact, or a limit of the arm is exceeded.
        """
        reading, t = self.arm.read(), time.monotonic() - self._began
        self._contact.check(f"At t = {t:.2f} s of the check", reading.wrench)
        self._watch.check(t, reading)
        return reading

    def up(self, seconds: float) -> tuple[Floats, Floats]:
        """Move up and return times [N] [s] and tool positions [N, 3] [m]. The arm is still moving at the end."""
        times, places, commanded = [], [], 0.0
        begun = time.monotonic()
        while (now := time.monotonic()) - begun < seconds:
            if now >= commanded:
                self.arm.send_velocity(_UP)
                commanded = now + _COMMAND_S
            places.append(self.read().tool_position_m)
            times.append(time.monotonic())
        return np.array(times) - begun, np.array(places)


def check_arm(
    connect: Callable[[], ArmProcess],
    checker: ArmChecker,
    *,
    move: bool,
    say: Callable[[str], None] = lambda _: None,
    ask: Callable[[str], None] | None = None,
) -> Iterator[Check]:
    """Check the readings of an arm and, with `move`, move it up and down by some centimetres at 2 cm/s.

    Args:
        connect: function that opens the arm. It is called again after the arm's process was killed.
        checker: robot description and limits. The workspace box must have room above the tool.
        say: called with progress messages.
        ask: shows a request (to pull or plug the cable) and waits until the user has done it. None skips this test.

    Raises:
        HardwareError, LimitError: the arm cannot be moved, or met an obstacle. It is stopped.
    """
    with closing(connect()) as arm:
        yield from _readings(arm, checker)
        if not move:
            return
        guarded = _Guarded(arm, checker)
        rest = guarded.rest
        checker.check_tool_frame(rest)
        needed = _NEEDED_M + (0.0 if ask is None else SPEED_M_S * _PULLED_S)
        top = rest.tool_position_m + np.array([0.0, 0.0, needed])
        if checker.limits.outside(top):
            raise LimitError(
                f"The tool needs {100 * needed:.0f} cm above it within the workspace box, and {top.round(3).tolist()} m is "
                "outside. Move the tool down, or widen workspace_m in rig.yaml."
            )
        say("moving up at 2 cm/s")
        yield from _motion(guarded)
        yield _rest("stands still after Stop", _stopped(guarded), _STOP_S)
        yield _rest("stands still when the capture is silent", _silent(guarded), WATCHDOG_S + _STOP_S)
        last = _Guarded(arm, checker).up(_MOVED_S / 2)[1][-1]
        say("the arm's process is killed, as if its link were lost")
        os.kill(arm.pid, signal.SIGKILL)
    time.sleep(2 * _LINK_S)
    with closing(connect()) as arm:
        yield _lost("stops by itself when its process is lost", arm, last)
        pulled = None if ask is None else _pulled(_Guarded(arm, checker), ask)
        if pulled is None:
            if ask is not None:
                yield Check(
                    "stops by itself when its cable is pulled", "missing", f"nobody pulled it within {_PULLED_S:g} s"
                )
            yield _back(_Guarded(arm, checker), rest, say)
            return
    with closing(connect()) as arm:
        yield _lost("stops by itself when its cable is pulled", arm, pulled)
        yield _back(_Guarded(arm, checker), rest, say)


def _pulled(guarded: _Guarded, ask: Callable[[str], None]) -> Floats | None:
    """Return the last tool position [3] before the link was lost, or None if the cable was not pulled.

    Raises:
        HardwareError, LimitError: something else ended the motion. Stop has been sent.
    """
    ask(f"The arm will move up at 2 cm/s for {_PULLED_S:g} s. Pull its network cable while it moves. Press Enter to start")
    last = None
    try:
        end = time.monotonic() + _PULLED_S
        while time.monotonic() < end:
            last = guarded.up(_COMMAND_S)[1][-1]
    except HardwareError as error:
        try:
            guarded.arm.stop()
        except UnconfirmedStopError:  # the link is lost; an arm with another problem would still confirm Stop
            if isinstance(error, LimitError):
                raise error from None
        else:
            raise
        ask("Plug the cable in again, wait until the arm can be reached, and press Enter")
        return last
    guarded.arm.stop()
    return None


def _lost(name: str, arm: ArmProcess, last: Floats) -> Check:
    found = arm.read().tool_position_m
    time.sleep(_COMMAND_S)
    still = float(np.linalg.norm(arm.read().tool_position_m - found)) < _STILL_M
    moved = float(np.linalg.norm(found - last))
    told = f"{1000 * moved:.0f} mm after the last reading; must be less than {1000 * SPEED_M_S * _LINK_S:.0f}"
    return _check(name, still and moved < SPEED_M_S * _LINK_S, told if still else "it still moves")


def _readings(arm: ArmProcess, checker: ArmChecker) -> Iterator[Check]:
    took, readings = [], []
    for _ in range(50):
        began = time.monotonic()
        readings.append(arm.read())
        took.append(time.monotonic() - began)
    milliseconds = 1000 * float(np.median(took))
    yield _check("reading", milliseconds <= _READ_MS, f"the median is {milliseconds:.1f} ms; at most {_READ_MS:g}")
    last = readings[-1]
    wanted = len(checker.robot.arm)
    largest = float(np.abs(last.joints_rad).max())
    yield _check(
        "joints", len(last.joints_rad) == wanted == arm.joint_count and largest < 4 * np.pi,
        f"{len(last.joints_rad)} angles, the largest {largest:.2f}; must be {wanted}, in radians",
    )  # fmt: skip
    length = float(np.linalg.norm(last.tool_quaternion))
    yield _check("quaternion", abs(length - 1) < 0.01, f"length {length:.4f}; must be 1, order w, x, y, z")
    try:
        checker.check_tool_frame(last)
        yield Check("tool frame", "ok", "where the joints and the description put it: in metres, in the base frame")
    except DiffCloudError as error:
        yield Check("tool frame", "wrong", str(error))
    finite = bool(np.isfinite([reading.wrench for reading in readings]).all())
    force, torque = sizes(np.mean([reading.wrench for reading in readings], axis=0))
    limits = checker.limits
    yield _check(
        "wrench", finite and len(last.wrench) == 6 and force <= limits.preload_N and torque <= limits.preload_Nm,
        f"{force:.1f} N and {torque:.1f} N·m at rest; must be six finite numbers, at most {limits.preload_N:g} N and "
        f"{limits.preload_Nm:g} N·m (static_force_n in rig.yaml)",
    )  # fmt: skip
    grip = last.gripper
    yield _check("gripper", grip is None or -0.05 <= grip <= 1.05, f"{grip}; must be 0 (open) to 1 (closed), or None")


def _motion(guarded: _Guarded) -> Iterator[Check]:
    """Compare commanded and measured velocity. The arm is still moving at the end."""
    times, places = guarded.up(_MOVED_S)
    late = times > _MOVED_S / 2  # after the arm has accelerated
    velocity = np.polyfit(times[late], places[late], 1)[0]
    off = float(np.linalg.norm(velocity - _UP)) / SPEED_M_S
    yield _check(
        "velocity", off < _OFF,
        f"{(1000 * velocity).round(1).tolist()} mm/s where {(1000 * _UP).tolist()} was commanded, in the base frame",
    )  # fmt: skip
    frames = [Rotation.from_quat(np.roll(one.tool_quaternion, -1)) for one in (guarded.rest, guarded.read())]
    turned = float((frames[1] * frames[0].inv()).magnitude())
    yield _check(
        "orientation", turned < _TURNED_RAD,
        f"turned by {np.rad2deg(turned):.2f}°; must be less than {np.rad2deg(_TURNED_RAD):g}°",
    )  # fmt: skip


def _stopped(guarded: _Guarded) -> _Way:
    before, begun = guarded.read().tool_position_m, time.monotonic()
    guarded.arm.stop()
    return _until_still(guarded.arm, begun, before)


def _silent(guarded: _Guarded) -> _Way:
    """Stop sending commands, as a capture that hangs. The arm's process must stop the arm."""
    guarded.arm.prepare()
    guarded.up(_COMMAND_S)
    before, begun = guarded.read().tool_position_m, time.monotonic()
    time.sleep(WATCHDOG_S + _COMMAND_S)
    return _until_still(guarded.arm, begun, before)


def _until_still(arm: ArmProcess, begun: float, before: Floats) -> _Way:
    last, quiet = arm.read().tool_position_m, time.monotonic()
    while time.monotonic() - quiet < 0.2 and time.monotonic() - begun < 3.0:
        place = arm.read().tool_position_m
        if np.linalg.norm(place - last) > _STILL_M:
            last, quiet = place, time.monotonic()
        time.sleep(0.005)
    return _Way(quiet - begun, float(np.linalg.norm(last - before)))


def _rest(name: str, way: _Way, within_s: float) -> Check:
    told = f"after {way.seconds:.2f} s and {1000 * way.moved_m:.1f} mm; at most {within_s:g} s"
    return _check(name, way.seconds <= within_s, told)


def _back(guarded: _Guarded, rest: ArmReading, say: Callable[[str], None]) -> Check:
    """Move back to the start at the same speed, until the measured position is within 1 mm."""
    say("moving back")
    end = time.monotonic() + 3 * _NEEDED_M / SPEED_M_S
    try:
        while time.monotonic() < end:
            way = rest.tool_position_m - guarded.read().tool_position_m
            distance = float(np.linalg.norm(way))
            if distance < 1e-3:
                break
            guarded.arm.send_velocity(way * min(SPEED_M_S / distance, 1.0))
            time.sleep(_COMMAND_S / 2)
    finally:
        guarded.arm.stop()
    left = float(np.linalg.norm(rest.tool_position_m - guarded.arm.read().tool_position_m))
    return _check("is back", left < 3e-3, f"{1000 * left:.1f} mm from where it began; must be less than 3")


def _check(name: str, right: bool, told: str) -> Check:
    return Check(name, "ok" if right else "wrong", told)
