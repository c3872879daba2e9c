"""A Ctrl-C that a library turns into another error still ends the command as a Ctrl-C.

Python raises KeyboardInterrupt wherever the main thread is. Where that is inside a library's C code, the library may drop
it and raise an error of its own (numpy's comparison of structured arrays: a TypeError without a cause). In a callback of
the interpreter it is lost altogether.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from diffcloud.errors import DiffCloudError

_heard: list[int] = []
"""The end of a pipe where the interpreter writes the number of each signal, whatever becomes of its exception."""


def listen() -> None:
    """Note each Ctrl-C from now on; only the main thread may call this."""
    if not _heard:
        read, write = os.pipe()
        for end in (read, write):
            os.set_blocking(end, False)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        _heard.append(read)
        sys.unraisablehook = _press_again
    was_pressed()  # one before this does not count


@contextmanager
def none_lost() -> Iterator[None]:
    """An error that a Ctrl-C was turned into within this block is a KeyboardInterrupt again.

    Raises:
        KeyboardInterrupt: from an error that is none of the project's own, after a Ctrl-C.
    """
    try:
        yield
    except KeyboardInterrupt:
        was_pressed()  # who catches it has answered this one
        raise
    except DiffCloudError:
        raise
    except Exception as error:
        if was_pressed():
            raise KeyboardInterrupt from error
        raise


@contextmanager
def pressed_after(seconds: float | None) -> Iterator[Callable[[], bool]]:
    """As if Ctrl-C were pressed, if this block still runs after so many seconds; only the main thread may call this.

    It is a signal of its own: a command that a script starts in the background ignores that of Ctrl-C.

    Args:
        seconds: None: never.

    Yields:
        Whether it was this that pressed.

    Raises:
        KeyboardInterrupt: the time is over.
    """
    over = threading.Event()

    def press(number: int, frame: object) -> None:
        over.set()
        raise KeyboardInterrupt

    if seconds is None:
        yield over.is_set
        return
    before = signal.signal(signal.SIGALRM, press)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield over.is_set
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def was_pressed() -> bool:
    """Whether Ctrl-C was pressed since this was last asked."""
    try:
        return bool(_heard) and not {signal.SIGINT, signal.SIGALRM}.isdisjoint(os.read(_heard[0], 1 << 16))
    except BlockingIOError:  # nothing was written
        return False


def _press_again(lost: sys.UnraisableHookArgs) -> None:
    """Python loses a Ctrl-C that comes in a callback, such as those of the import system: it is pressed once more then."""
    if isinstance(lost.exc_value, KeyboardInterrupt):
        # a real signal, which ends a wait of the main thread too
        again = threading.Timer(0.02, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT))
        again.daemon = True
        again.start()
    else:
        sys.__unraisablehook__(lost)
