"""Detect a Ctrl-C even if a library converts it to another error.

Python raises KeyboardInterrupt in the main thread. If this thread is inside C code of a library, the library may drop
the exception and raise its own. For example, numpy raises a TypeError without a cause when it compares structured
arrays. In a callback of the interpreter, the exception is lost.
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
"""Read end of a pipe to which the interpreter writes each signal number, even if the exception is lost."""


def listen() -> None:
    """Record each Ctrl-C from now on. Only the main thread may call this."""
    if not _heard:
        read, write = os.pipe()
        for end in (read, write):
            os.set_blocking(end, False)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        _heard.append(read)
        sys.unraisablehook = _press_again
    was_pressed()  # forget a Ctrl-C from before this call


@contextmanager
def none_lost() -> Iterator[None]:
    """Raise KeyboardInterrupt if an unexpected error ends this block after a Ctrl-C.

    Raises:
        KeyboardInterrupt: instead of an error that is not a DiffCloudError, after a Ctrl-C.
    """
    try:
        yield
    except KeyboardInterrupt:
        was_pressed()  # clear the record, since the caller handles this Ctrl-C
        raise
    except DiffCloudError:
        raise
    except Exception as error:
        if was_pressed():
            raise KeyboardInterrupt from error
        raise


@contextmanager
def pressed_after(seconds: float | None) -> Iterator[Callable[[], bool]]:
    """Raise KeyboardInterrupt, as for a Ctrl-C, if this block runs longer than `seconds`.

    SIGALRM is used, because background commands of a shell script ignore SIGINT. Only the main thread may call this.

    Args:
        seconds: time limit. None: no limit.

    Yields:
        Function that returns whether the time limit was reached.

    Raises:
        KeyboardInterrupt: the time limit was reached.
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
    """Whether Ctrl-C was pressed or the time limit was reached since the last call."""
    try:
        return bool(_heard) and not {signal.SIGINT, signal.SIGALRM}.isdisjoint(os.read(_heard[0], 1 << 16))
    except BlockingIOError:  # the pipe is empty
        return False


def _press_again(lost: sys.UnraisableHookArgs) -> None:
    """Send SIGINT again if a KeyboardInterrupt was lost in a callback, for example of the import system."""
    if isinstance(lost.exc_value, KeyboardInterrupt):
        # A real signal also interrupts a blocking wait of the main thread.
        again = threading.Timer(0.02, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT))
        again.daemon = True
        again.start()
    else:
        sys.__unraisablehook__(lost)
