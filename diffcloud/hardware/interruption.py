"""Signals end a capture, and stop the arm first.

Ctrl-C, Ctrl-Z, Ctrl-\\, a closed terminal, `kill`: whatever would end or suspend this process by default is caught. The
handler has Stop sent at once, then raises KeyboardInterrupt. A capture cannot be suspended and resumed: the arm and the
cameras would not wait for it, so Ctrl-Z ends it as Ctrl-C does.

SIGKILL, SIGSTOP and crashes cannot be caught; for these the arm lives in a process of its own (`arm_process`).
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_HARMLESS = {signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH}
"""Ignored by default."""
_CRASHES = {signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGTRAP, signal.SIGSYS, signal.SIGABRT}
"""Python code does not run any more when these come."""


def catchable_signals() -> set[int]:
    """All signals that end or suspend a process by default and can be caught."""
    uncatchable = {signal.SIGKILL, signal.SIGSTOP}
    return {int(number) for number in signal.valid_signals() - uncatchable - _HARMLESS - _CRASHES}


class Interruption:
    """Catches the signals while it is entered; handlers that the program set itself, and ignored signals, stay.

    Args:
        halt: sends Stop without waiting; is called from the handler.
    """

    def __init__(self, halt: Callable[[], None]) -> None:
        self._halt = halt
        self._held = False
        self._caught: str | None = None
        self._former: dict[int, object] = {}

    def __enter__(self) -> Interruption:
        if threading.current_thread() is threading.main_thread():  # only the main thread may set handlers
            for number in catchable_signals():
                if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                    self._former[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._former.items():
            signal.signal(number, handler)  # type: ignore[arg-type]  # what signal.signal has returned
        self._former = {}

    def check(self) -> None:
        """Raise what was caught, in case something swallowed it (an exception in a callback or destructor is lost).

        Raises:
            KeyboardInterrupt: a signal has come.
        """
        if self._caught is not None:
            raise KeyboardInterrupt(self._caught)

    @contextmanager
    def held(self) -> Iterator[None]:
        """A second Ctrl-C must not interrupt what the first one causes: in this block nothing is raised."""
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
    except ValueError:  # most real-time signals have none
        return str(number)
