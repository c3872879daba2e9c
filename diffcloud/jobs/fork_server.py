"""Start the process that forks workers while the command is still importing.

torch and the compiled kernels take seconds to import, first in the command and then in its workers. A fork server
imports the same modules in parallel with the command, and forks workers that already have them. The command itself must
not fork: with torch's threads the child may hang, and it would inherit locks on folders.
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
"""Start method. On macOS, libraries that torch loads may not survive a fork."""


def worker_context() -> BaseContext:
    """Return the multiprocessing context: fork server on Linux, spawn elsewhere."""
    return multiprocessing.get_context(_KIND)


def begin_importing(module: str, arguments: Sequence[str]) -> None:
    """Start the fork server and let it import a command's module. Without several workers, do nothing.

    Args:
        arguments: command-line arguments after `diffcloud`.
    """
    if _KIND == "spawn" or asked_workers(arguments) < 2:
        return
    from multiprocessing import forkserver

    worker_context().set_forkserver_preload(["diffcloud.cli.app", module])
    # Block SIGINT, so that the server and its workers inherit the blocked signal: only this process reacts to Ctrl-C,
    # and tells its workers. Start the resource tracker first, because its start unblocks signals.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def asked_workers(arguments: Sequence[str]) -> int:
    """Return the number of workers that --workers requests.

    The default is one per core for pipeline stages (with --params) and 1 for other commands. Invalid values count as 1,
    since the command reports them.
    """
    told = _after("--workers", arguments)
    if told is None:
        return 1 if _after("--params", arguments) is None else cores()
    try:
        return int(told)
    except ValueError:
        return 1


def _after(option: str, arguments: Sequence[str]) -> str | None:
    """Return the value of an option, given as two words or with an equals sign, or None."""
    for index, word in enumerate(arguments):
        name, equals, value = word.partition("=")
        if name == option:
            return value if equals else next(iter(arguments[index + 1 :]), None)
    return None
