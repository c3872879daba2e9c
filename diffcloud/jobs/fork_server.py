"""The process that forks workers, started while this one still imports.

torch and the kernels take seconds to import. Without a server, the command would wait for that, and then its workers.
The server imports the same modules in parallel with the command and forks workers that have them already. The command
itself must not fork: with torch's threads the child may hang, and it would inherit the locks on folders.
"""

from __future__ import annotations

import multiprocessing
import signal
import sys
from collections.abc import Sequence
from multiprocessing import resource_tracker
from multiprocessing.context import BaseContext

from diffcloud.sim.threads import cores

_KIND = "forkserver" if sys.platform == "linux" else "spawn"
"""On macOS, libraries that torch loads may not survive a fork."""


def worker_context() -> BaseContext:
    """How worker processes start: forked from the server on Linux, spawned elsewhere."""
    return multiprocessing.get_context(_KIND)


def begin_importing(module: str, arguments: Sequence[str]) -> None:
    """Let the server import a command's module, if its arguments ask for several workers; else do nothing.

    Args:
        arguments: of the command line, after `diffcloud`.
    """
    if _KIND == "spawn" or asked_workers(arguments) < 2:
        return
    from multiprocessing import forkserver

    worker_context().set_forkserver_preload(["diffcloud.cli.app", module])
    # Ctrl-C is meant for this process, which tells its workers. The server and its workers inherit the blocked signal. The
    # tracker starts first, because starting it unblocks signals
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def asked_workers(arguments: Sequence[str]) -> int:
    """The value of --workers. Without it, the default (one per core) for a stage, which has --params, and 1 for other
    commands, which mostly have one job. Invalid values are left for the command to report."""
    told = _after("--workers", arguments)
    if told is None:
        return 1 if _after("--params", arguments) is None else cores()
    try:
        return int(told)
    except ValueError:
        return 1


def _after(option: str, arguments: Sequence[str]) -> str | None:
    """The value of an option, as two words or with an equals sign."""
    for index, word in enumerate(arguments):
        name, equals, value = word.partition("=")
        if name == option:
            return value if equals else next(iter(arguments[index + 1 :]), None)
    return None
