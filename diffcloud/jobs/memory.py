"""Tuning of the memory allocator and the garbage collector."""

from __future__ import annotations

import ctypes
import gc
import platform
from collections.abc import Iterator
from contextlib import contextmanager

_TRIM, _MMAP = -1, -3
"""Values of `M_TRIM_THRESHOLD` and `M_MMAP_THRESHOLD` in glibc's malloc.h."""
_KEEP_BYTES = 1 << 30


def keep_freed_memory() -> bool:
    """Let glibc keep freed large blocks for reuse. Return whether this was possible.

    By default, glibc returns large blocks to the system, and the system clears each page when it is allocated again.
    Training and simulation allocate megabytes in every operation and spend a third of their time on this (measured).
    With another C library, this has no effect.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    return bool(mallopt(_MMAP, _KEEP_BYTES)) and bool(mallopt(_TRIM, _KEEP_BYTES))


@contextmanager
def imports() -> Iterator[None]:
    """Exclude objects imported in this block from garbage collection, since they live until the process ends.

    Collecting them takes a third of the time in which a command starts and stops.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
