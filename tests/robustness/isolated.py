"""One reading of a damaged file, in a process of its own, with limits of time and memory.

The process is a fork of one that has imported everything, so that thousands take minutes.
"""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import psutil

from diffcloud.errors import DiffCloudError

SECONDS, MEGABYTES = 20.0, 2000.0
"""More than any reading may take."""
_RESERVE = 4 << 30
"""Addresses beyond what is mapped already [bytes]: a reading that asks for more is told, and the machine survives."""
Verdict = Literal["taken", "refused", "traceback", "hang", "memory", "left over"]
"""Taken or refused by name; all else is a fault."""


@dataclass(frozen=True)
class Outcome:
    """What became of one reading."""

    verdict: Verdict
    told: str
    """The error's text, or what was left over."""
    seconds: float
    megabytes: float
    """That it took beyond what the process began with."""


def read_alone(folder: Path, read: Callable[[], None]) -> Outcome:
    """Run in a fork that stands in a folder; an error must leave the folder as it was."""
    folder = Path(folder)
    before = set(folder.rglob("*"))
    with tempfile.TemporaryFile() as told:
        began = time.monotonic()
        child = os.fork()
        if child == 0:
            _run(folder, read, told.fileno())
        status, usage, hung = _wait(child, began + SECONDS)
        seconds = time.monotonic() - began
        told.seek(0)
        first, _, rest = told.read().partition(b"\n")
        began_with, rest = (int(first), rest) if first.isdigit() else (0, first + b" " + rest)
        text = " ".join(rest.decode(errors="replace").split())
    # as the fork counted it: pages of libraries, of which this process has many, are not its own until it uses them
    taken = max(0.0, 1024 * usage.ru_maxrss - began_with) / 1e6
    code = os.waitstatus_to_exitcode(status)
    left = sorted(str(path.relative_to(folder)) for path in set(folder.rglob("*")) - before)
    for name in left:  # the next reading begins as this one did
        path = folder / name
        shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
    if hung:
        return Outcome("hang", text, seconds, taken)
    if taken > MEGABYTES or "Out of memory" in text or code == -signal.SIGKILL:
        return Outcome("memory", text, seconds, taken)
    if code not in (0, 1, 2) or "Unexpected error" in text or "Traceback" in text:
        return Outcome("traceback", text, seconds, taken)
    left = [name for name in left if not name.endswith(".diffcloud-lock")]
    if code != 0 and left:
        return Outcome("left over", f"{', '.join(left)}; {text}", seconds, taken)
    return Outcome("taken" if code == 0 else "refused", text, seconds, taken)


def _run(folder: Path, read: Callable[[], None], told: int) -> None:
    """In the fork; ends the process."""
    code = 70
    try:
        os.setsid()
        os.chdir(folder)
        os.dup2(told, 1)
        os.dup2(told, 2)
        memory = psutil.Process().memory_info()
        os.write(told, b"%d\n" % memory.rss)
        resource.setrlimit(resource.RLIMIT_AS, (memory.vms + _RESERVE,) * 2)
        try:
            read()
            code = 0
        except DiffCloudError as error:
            print(error)
            code = 1
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        except MemoryError:
            print("Out of memory")
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _wait(child: int, until: float) -> tuple[int, resource.struct_rusage, bool]:
    """Exit status, what it used, and whether it had to be ended."""
    pause = 0.002
    while time.monotonic() < until:
        found, status, usage = os.wait4(child, os.WNOHANG)
        if found:
            return status, usage, False
        time.sleep(pause)
        pause = min(0.05, 1.5 * pause)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    _, status, usage = os.wait4(child, 0)
    return status, usage, True
