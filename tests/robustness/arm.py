"""Faults of arm, cameras, disk and processes while an arm moves: how soon Stop reaches it, and what can be read afterwards.

The arm is the loopback arm of the tests, which speaks Kortex and stops by itself when its link is silent. It moves sideways
at 0.1 m/s when the fault comes. Where a process and the link to the arm live, Stop must reach it within 100 ms of the
fault's detection; how long detection takes is stated for each fault. Else the arm's own timeout has to stop it.
"""

from __future__ import annotations

import errno
import itertools
import os
import random
import resource
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal
from unittest.mock import patch

import numpy as np

from diffcloud.errors import DiffCloudError
from diffcloud.hardware import ArmProcess, CaptureSettings, capture
from diffcloud.hardware.arm_process import WATCHDOG_S
from diffcloud.hardware.recorders import Recorders
from diffcloud.io import raw_episodes
from diffcloud.io.raw_episodes import read_raw_episode
from tests.hardware.capturing import SPEED_M_S, Capture, sideways
from tests.hardware.kortex.opening import in_process
from tests.hardware.kortex.server import LAG_S, FakeArm
from tests.hardware.simulated import TestCard
from tests.robustness.inputs import SEED

STOP_WITHIN_S = 0.1
"""Of the detection."""
TIMEOUT_S = 0.5
"""Of a camera, and the arm's own for its link."""
READ_S, COMMAND_S, CALL_S, OVERDUE_S = 0.02, 0.1, 0.4, 0.5
"""Between readings of the arm, between velocities, until a call is given up, and until a driver hangs."""
_TWIST = 12
"""The one at which the fault comes."""
_HOUR_S = 3600.0
Happening = Callable[["Scene"], object]
Way = Literal["Stop", "emergency stop", "the arm's timeout", "no need"]


class Card(TestCard):
    """A camera that does what it is told before it delivers its next frame."""

    def __init__(self, name: str) -> None:
        super().__init__(name, fps=30)
        self.trouble: Callable[[Card], object] | None = None
        self.changed: Callable[[Any], Any] = lambda frame: frame
        self.closing: Callable[[], object] = lambda: None

    def read(self, timeout_s: float) -> Any:
        if self.trouble is not None:
            self.trouble(self)
        return self.changed(super().read(timeout_s))

    def close(self) -> None:
        super().close()
        self.closing()


@dataclass
class Scene:
    """A capture into which a fault comes."""

    folder: Path
    server: FakeArm
    arm: ArmProcess | None
    cards: list[Card]
    patches: ExitStack
    began: float | None = None
    """time.monotonic() of the fault."""
    place: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    """[3] of the tool then [m]."""

    def now(self) -> None:
        """The fault comes: only the first moment counts."""
        if self.began is None:
            self.began, self.place = time.monotonic(), self.server.position

    def instead(self, owner: Any, name: str, call: Callable[..., Any]) -> None:
        """From now on `call` gets the original and its arguments."""
        original = getattr(owner, name)
        self.patches.enter_context(patch.object(owner, name, lambda *args, **kw: call(original, *args, **kw)))


@dataclass(frozen=True)
class ArmFault:
    """One fault."""

    name: str
    happen: Happening
    detected_s: float = 0.0
    """Until it can be noticed, at the latest."""
    way: Way = "Stop"
    """How the arm comes to rest; no need where nothing is wrong that could hurt, and the capture ends well."""
    told: str = ""
    """Part of the error."""
    moment: Literal["at once", "own"] = "at once"
    """Whether the fault begins when it is ordered, or says itself when it begins."""


# --- what happens ---------------------------------------------------------------------------------------------------------


def _server(name: str, value: Any) -> Happening:
    return lambda scene: setattr(scene.server, name, value)


def _refuse(**calls: int) -> Happening:
    return lambda scene: scene.server.refused.update(calls)


def _wrench(axis: int, value: float) -> Happening:
    return lambda scene: scene.server.wrench.__setitem__(axis, value)


def _and(*happenings: Happening) -> Happening:
    return lambda scene: [happen(scene) for happen in happenings]


def _moved(by: tuple[float, float, float]) -> Happening:
    return lambda scene: setattr(scene.server, "position", scene.server.position + by)


def _joint(index: int, by_rad: float) -> Happening:
    return lambda scene: setattr(scene.server, "joints_rad", scene.server.joints_rad + by_rad * np.eye(7)[index])


def _camera(trouble: Callable[[Scene, Card], object], *names: str) -> Happening:
    """Cameras of these names, or all, are in trouble at their next frame; that is when the fault begins."""

    def happen(scene: Scene) -> None:
        for card in scene.cards:
            if not names or card.name in names:
                card.trouble = lambda card: [scene.now(), trouble(scene, card)]

    return happen


def _raises(error: Exception) -> Callable[[Scene, Card], object]:
    def trouble(_: Scene, __: Card) -> None:
        raise error

    return trouble


def _silent(_: Scene, card: Card) -> None:
    time.sleep(TIMEOUT_S)
    raise DiffCloudError(f"Camera {card.name} delivered no frame for {TIMEOUT_S:g} s.")


def _frames(**changes: Callable[[Any], Any]) -> Callable[[Scene, Card], object]:
    """Frames of one camera with changed fields."""

    def trouble(_: Scene, card: Card) -> None:
        card.changed = lambda frame: replace(frame, **{name: change(frame) for name, change in changes.items()})

    return trouble


def _disk(owner: Any, name: str, number: int, part: str = "") -> Happening:
    """This call is refused by the system from now on, for paths that hold `part`."""

    def refuse(scene: Scene, original: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        if any(part in str(getattr(one, "_path", one)) for one in arguments):
            scene.now()
            raise OSError(number, os.strerror(number))
        return original(*arguments, **options)

    return lambda scene: scene.instead(owner, name, lambda *args, **kw: refuse(scene, *args, **kw))


def _no_file_grows(scene: Scene) -> None:
    """The system refuses any file beyond so many bytes: what it says of a full disk, at whichever write comes first."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.getsignal(signal.SIGXFSZ)
    assert ignored is signal.SIG_IGN  # Python's own choice
    size = (scene.folder / "robot.csv").stat().st_size
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 2000, hard))
    scene.patches.callback(resource.setrlimit, resource.RLIMIT_FSIZE, (soft, hard))
    scene.now()


def _slow_disk(seconds: float, frames: float = np.inf) -> Happening:
    """So many of the frames that come take this long."""
    slow_ones = itertools.count()

    def slow(original: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        if next(slow_ones) < frames:
            time.sleep(seconds)
        return original(*arguments, **options)

    return lambda scene: scene.instead(raw_episodes, "write_depth", slow)


def _bug(owner: Any, name: str, error: Exception) -> Happening:
    def raises(scene: Scene) -> None:
        scene.now()
        raise error

    return lambda scene: scene.instead(owner, name, lambda *_, **__: raises(scene))


def _clock(change_s: float) -> Happening:
    return lambda scene: scene.instead(time, "time", lambda original: original() + change_s)


def _signal(name: str, times: int = 1) -> Happening:
    return lambda scene: [os.kill(os.getpid(), getattr(signal, name)) for _ in range(times)]


def _signal_to_arm(name: str) -> Happening:
    def happen(scene: Scene) -> None:
        os.kill(scene.arm.pid, getattr(signal, name))
        if name == "SIGSTOP":  # else closing would wait for it
            scene.patches.callback(_woken, scene.arm.pid)

    return happen


def _woken(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)


_HARD = ZeroDivisionError("a bug")
IN_PROCESS = [
    # the arm
    *(ArmFault(f"the arm: {told}", lambda scene, bank=bank: scene.server.fault(bank), READ_S, told=f"fault: {told}")
      for bank, told in ((0x10, "joint fault"), (0x2000, "current too high"), (0x10000, "tool too fast"),
                         (0x800000, "emergency stop pressed"))),
    ArmFault("the arm: a fault without a name", lambda scene: scene.server.fault(0x2), READ_S, told="fault banks 0x2"),
    ArmFault("the link is cut", lambda scene: scene.server.cut(), READ_S, "the arm's timeout", "did not carry out"),
    ArmFault("the cable is pulled", lambda scene: scene.server.pull_cable(), CALL_S, "the arm's timeout", "did not"),
    ArmFault("the arm forgets its sessions", lambda scene: scene.server.sessions.clear(), READ_S, "the arm's timeout",
             "did not carry out"),
    ArmFault("velocities are refused", _refuse(SendTwistCommand=10**6), COMMAND_S, told="did not carry out SendTwist"),
    ArmFault("one velocity is refused", _refuse(SendTwistCommand=1), COMMAND_S, told="did not carry out SendTwist"),
    ArmFault("measurements are refused", _refuse(RefreshFeedback=10**6), READ_S, told="did not carry out RefreshFeedback"),
    ArmFault("the gripper's state is refused", _refuse(GetMeasuredGripperMovement=10**6), READ_S,
             told="did not carry out GetMeasured"),
    ArmFault("contact, and the first Stop is refused", _and(_refuse(Stop=1), _wrench(2, 50.0)), READ_S, told="50.0 N"),
    ArmFault("contact, and every Stop is refused", _and(_refuse(Stop=10**6), _wrench(2, 50.0)), READ_S, "emergency stop",
             "50.0 N"),
    # limits
    *(ArmFault(f"contact along {axis}", _wrench(index, -50.0), READ_S, told="the tool felt 50.0 N")
      for index, axis in enumerate("xyz")),
    ArmFault("a torque at the tool", _wrench(4, 11.0), READ_S, told="11.0 N·m"),
    ArmFault("a wrench that is no number", _wrench(0, float("nan")), READ_S, told="the tool felt nan N"),
    ArmFault("the tool is pushed off its path", _moved((0.0, 0.0, 0.1)), READ_S, told="from the trajectory"),
    ArmFault("the tool jumps out of the box", _moved((0.0, 0.0, 0.5)), READ_S, told="from the trajectory"),
    ArmFault("the tool is turned", lambda scene: scene.server.turn_tool(0.3), READ_S, told="turned by"),
    ArmFault("the tool's place is no number", _server("tool_offset", np.full(3, np.nan)), READ_S),
    ArmFault("an elbow turns", _joint(1, 0.4), READ_S),
    ArmFault("a joint leaves its range", _joint(5, -1.45), READ_S),
    # cameras
    *(ArmFault(f"camera {name} is unplugged", _camera(_raises(DiffCloudError("unplugged")), name), READ_S, told="unplugged",
               moment="own") for name in ("overhead", "side")),
    ArmFault("both cameras are unplugged", _camera(_raises(DiffCloudError("unplugged"))), READ_S, told="unplugged",
             moment="own"),
    ArmFault("a camera's driver raises an error of its own", _camera(_raises(RuntimeError("xioctl")), "side"), READ_S,
             told="Camera side: RuntimeError: xioctl", moment="own"),
    ArmFault("a camera's driver finds no memory", _camera(_raises(MemoryError("frame")), "side"), READ_S,
             told="MemoryError", moment="own"),
    ArmFault("a camera delivers nothing", _camera(_silent, "side"), TIMEOUT_S + READ_S, told="no frame for 0.5 s",
             moment="own"),
    ArmFault("a camera's driver hangs", _camera(lambda *_: time.sleep(6.0), "side"), TIMEOUT_S + OVERDUE_S + READ_S,
             told="its driver has not come back for 1 s", moment="own"),
    ArmFault("a camera's frames come late, but in time", _camera(lambda *_: time.sleep(0.3), "side"), way="no need"),
    ArmFault("a camera's clock runs backwards", _camera(_frames(time_s=lambda frame: frame.time_s - 5.0), "side"),
             READ_S + 1 / 30, told="its clock ran backwards by", moment="own"),
    ArmFault("a camera's clock is years ahead", _camera(_frames(time_s=lambda frame: 1e9), "side"), READ_S + 2 / 30,
             told="its clock is ahead by", moment="own"),
    ArmFault("images of another size", _camera(_frames(depth=lambda frame: frame.depth[:10]), "side"), READ_S + 1 / 30,
             told="an image of [10, 32] where [24, 32]", moment="own"),
    ArmFault("images of another type", _camera(_frames(depth=lambda frame: frame.depth.astype(complex)), "side"),
             READ_S + 1 / 30, moment="own"),
    ArmFault("an image is missing", _camera(_frames(depth=lambda frame: None), "side"), READ_S + 1 / 30,
             told="writing a frame", moment="own"),
    ArmFault("contact, and a camera cannot be closed", _and(
        lambda scene: setattr(scene.cards[0], "closing", lambda: 1 / 0), _wrench(2, 50.0)), READ_S, told="50.0 N"),
    # the disk
    ArmFault("full disk at an image", _disk(os, "replace", errno.ENOSPC, ".png"), READ_S, told="No space left",
             moment="own"),
    ArmFault("full disk at the arm's log", _disk(raw_episodes._Rows, "_write", errno.ENOSPC, "robot.csv"), READ_S,
             told="No space left", moment="own"),
    ArmFault("full disk at the times of the frames", _disk(raw_episodes._Rows, "_write", errno.ENOSPC, "timestamps.csv"),
             READ_S, told="No space left", moment="own"),
    ArmFault("no file may grow", _no_file_grows, 1.0, told="rite"),
    ArmFault("the disk becomes read-only", _disk(os, "replace", errno.EROFS, ".png"), READ_S, told="Read-only",
             moment="own"),
    ArmFault("the disk fails", _disk(os, "fsync", errno.EIO), READ_S, told="Input/output error", moment="own"),
    ArmFault("a slow disk", _slow_disk(0.15), way="no need"),
    ArmFault("a disk that hangs for a second", _slow_disk(1.0, frames=2), way="no need"),
    ArmFault("a disk that cannot keep up", _and(
        lambda scene: [setattr(card, "_fps", 200) for card in scene.cards], _slow_disk(4.0, frames=2)),
             64 / 100 + TIMEOUT_S + READ_S, told="cannot keep up"),
    # bugs of our own
    ArmFault("a bug where images are written", _bug(raw_episodes, "write_color", _HARD), READ_S,
             told="ZeroDivisionError: a bug", moment="own"),
    ArmFault("a bug where the log is written", _bug(raw_episodes.RawEpisodeWriter, "add_robot", _HARD), READ_S,
             told="ZeroDivisionError: a bug", moment="own"),
    ArmFault("a bug in the control loop", _bug(Recorders, "add_reading", _HARD), 0.0, told="a bug", moment="own"),
    # clocks
    *(ArmFault(f"the time of day is set {word}", _clock(change), way="no need")
      for word, change in (("back by an hour", -_HOUR_S), ("on by an hour", _HOUR_S))),
    # signals
    *(ArmFault(f"{name} to the capture", _signal(name), told=name)
      for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGTSTP", "SIGQUIT", "SIGUSR1")),
    ArmFault("Ctrl-C three times", _signal("SIGINT", 3), told="SIGINT"),
    *(ArmFault(f"{name} to the arm's process", _signal_to_arm(name), told="a signal came to the process")
      for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGTSTP")),
    ArmFault("SIGKILL to the arm's process", _signal_to_arm("SIGKILL"), READ_S, "the arm's timeout", "it was killed"),
    ArmFault("SIGSTOP to the arm's process", _signal_to_arm("SIGSTOP"), 2.0, "the arm's timeout", "hangs or was suspended"),
]  # fmt: skip


def _killed(scene: Scene, capturing: Capture) -> None:
    scene.now()
    capturing.signal(signal.SIGKILL)


def _suspended(scene: Scene, capturing: Capture) -> None:
    scene.now()
    capturing.signal(signal.SIGSTOP)


def _both_killed(scene: Scene, capturing: Capture) -> None:
    scene.now()
    os.kill(capturing.arm_pid, signal.SIGKILL)
    capturing.signal(signal.SIGKILL)


OF_PROCESSES: list[tuple[ArmFault, Callable[[Scene, Capture], None]]] = [
    (ArmFault("SIGKILL to the capture", lambda _: None), _killed),
    (ArmFault("SIGSTOP to the capture", lambda _: None, WATCHDOG_S), _suspended),
    (ArmFault("SIGKILL to both", lambda _: None, way="the arm's timeout"), _both_killed),
]
"""Of a capture in a process of its own."""
ALL = [*IN_PROCESS, *(fault for fault, _ in OF_PROCESSES)]


def all_of_arm(sample: int | None = None) -> Iterator[dict[str, Any]]:
    """Faults one by one, in this process's main thread: plain values, one mapping each."""
    chosen = ALL if sample is None else random.Random(f"{SEED} arm").sample(ALL, min(sample, len(ALL)))
    of_processes = {fault.name: happen for fault, happen in OF_PROCESSES}
    for fault in chosen:
        with tempfile.TemporaryDirectory() as folder:
            if fault.name in of_processes:
                yield _elsewhere(fault, of_processes[fault.name], Path(folder) / "e")
            else:
                yield _here(fault, Path(folder) / "e")


def _here(fault: ArmFault, folder: Path) -> dict[str, Any]:
    """A capture in this process."""
    with FakeArm() as server, closing(in_process(server)) as arm, ExitStack() as patches:
        scene = Scene(folder, server, arm, [Card("overhead"), Card("side")], patches)

        def happen() -> None:
            if fault.moment == "at once":
                scene.now()
            fault.happen(scene)

        server.at_twist[_TWIST] = happen
        settings = CaptureSettings(rate_hz=1 / COMMAND_S, hold_s=0.1, camera_timeout_s=TIMEOUT_S)
        error: BaseException | None = None
        try:
            capture(folder, scene.cards, arm=arm, trajectory=sideways(), settings=settings)
        except (Exception, KeyboardInterrupt) as raised:
            error = raised
        patches.close()  # the disk is as before, to be read
        return _told(fault, scene, error)


def _elsewhere(fault: ArmFault, happen: Callable[[Scene, Capture], None], folder: Path) -> dict[str, Any]:
    """A capture in a process of its own."""
    with FakeArm() as server, Capture(server, folder, WATCHDOG_S) as capturing, ExitStack() as patches:
        scene = Scene(folder, server, None, [], patches)
        happen(scene, capturing)
        server.rest()
        return _told(fault, scene, RuntimeError("the process was ended"))


def _told(fault: ArmFault, scene: Scene, error: BaseException | None) -> dict[str, Any]:
    late, wrong = _motion(fault, scene)
    if wrong is None and fault.way == "no need" and error is not None:
        wrong = "ended the capture"
    elif wrong is None and fault.way != "no need" and (error is None or fault.told not in str(error)):
        wrong = "told nothing" if error is None else "told something else"
    rows, frames = 0, 0
    try:
        rows, frames = _readable(scene.folder)
        if wrong is None and min(rows, frames) < 10:
            wrong = f"kept {frames} frames and {rows} rows"
    except DiffCloudError as unreadable:
        wrong, error = wrong or "cannot be read", unreadable
    return {
        "suite": "arm", "of": "arm", "where": fault.name, "what": fault.way, "wrong": wrong,
        "verdict": "survived" if wrong is None else "not survived",
        "told": "" if error is None else str(error).replace(str(scene.folder), "e")[:600],
        "detected_s": fault.detected_s, "late_ms": None if late is None else round(1000 * late, 1),
        "frames": frames, "rows": rows,
    }  # fmt: skip


def _motion(fault: ArmFault, scene: Scene) -> tuple[float | None, str | None]:
    """From the stated detection to the Stop that reached the arm [s], and what is wrong with how it came to rest."""
    server = scene.server
    if scene.began is None:
        return None, "the fault did not come"
    rest = server.rest()
    time.sleep(0.1)
    if np.linalg.norm(server.position - rest) > 1e-5:
        return None, "the arm moves on"
    stops = [
        (moment, name) for moment, name in zip(server.call_times, server.names(), strict=True)
        if moment >= scene.began and name in ("Stop", "ApplyEmergencyStop")
    ]  # fmt: skip
    if fault.way == "the arm's timeout":
        far = SPEED_M_S * (TIMEOUT_S + 2 * STOP_WITHIN_S + LAG_S)
        moved = float(np.linalg.norm(rest - scene.place))
        return None, None if moved < far else f"moved {1000 * moved:.0f} mm"
    if not stops:
        return None, "no Stop"
    if fault.way == "no need":
        return None, None
    if stops[-1][1] == "Stop" and fault.way == "emergency stop":
        return None, "no emergency stop"
    late = max(0.0, stops[0][0] - scene.began - fault.detected_s)
    return late, None if late <= STOP_WITHIN_S else f"Stop came {1000 * late:.0f} ms after the detection"


def _readable(folder: Path) -> tuple[int, int]:
    """Rows of the arm's log, and frames of the camera that has most; all are read.

    Raises:
        DiffCloudError: something cannot be read.
    """
    episode = read_raw_episode(folder)
    frames = []
    for camera in episode.cameras.values():
        for index in range(len(camera.frames)):
            camera.depth(index)
            camera.color(index)
        frames.append(len(camera.frames))
    return 0 if episode.robot is None else len(episode.robot.times), max(frames)
