"""Stop the arm when a signal ends the capture.

All catchable signals that would end or suspend the process are handled: Ctrl-C, Ctrl-Z, Ctrl-\\, a closed terminal,
`kill`. The handler sends Stop at once and raises KeyboardInterrupt. A capture cannot be resumed, since arm and cameras
would not wait, so Ctrl-Z ends it like Ctrl-C.

SIGKILL, SIGSTOP and crashes cannot be caught. For these cases a separate process stops the arm (`arm_process`).
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_HARMLESS = {signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH}
"""Signals that are ignored by default."""
_CRASHES = {signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGTRAP, signal.SIGSYS, signal.SIGABRT}
"""Signals after which Python code does not run any more."""


def catchable_signals() -> set[int]:
    """Return all catchable signals that end or suspend a process by default."""
    uncatchable = {signal.SIGKILL, signal.SIGSTOP}
    return {int(number) for number in signal.valid_signals() - uncatchable - _HARMLESS - _CRASHES}


class Interruption:
    """Context manager that handles signals. Ignored signals and handlers set by the program are not changed.

    Args:
        halt: function that sends Stop without waiting. The signal handler calls it.
    """

    def __init__(self, halt: Callable[[], None]) -> None:
        self._halt = halt
        self._held = False
        self._caught: str | None = None
        self._former: dict[int, object] = {}

    def __enter__(self) -> Interruption:
        if threading.current_thread() is threading.main_thread():  # Python allows only the main thread to set handlers
            for number in catchable_signals():
                if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                    self._former[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._former.items():
            signal.signal(number, handler)  # type: ignore[arg-type]  # a value that signal.signal returned
        self._former = {}

    def check(self) -> None:
        """Raise the exception of a caught signal again, in case it was lost in a callback or destructor.

        Raises:
            KeyboardInterrupt: a signal was received.
        """
        if self._caught is not None:
            raise KeyboardInterrupt(self._caught)

    @contextmanager
    def held(self) -> Iterator[None]:
        """In this block, signals raise nothing, so that a second Ctrl-C cannot interrupt the reaction to the first."""
        self._held = True
        try:
            yield
        finally:
            self._held = False

    def _handle(self, number: int, _: FrameType | None) -> None:
        self._caught = f"signal {_name(number)}"
        self._halt()
        if not self._held:
            raise KeyboardInterrupt(self._caught)


def _name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:  # most real-time signals have no name
        return str(number)
