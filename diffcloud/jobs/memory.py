"""How this process treats memory: that of the allocator, and that of the collector of garbage."""

from __future__ import annotations

import ctypes
import gc
import platform
from collections.abc import Iterator
from contextlib import contextmanager

_TRIM, _MMAP = -1, -3
"""`M_TRIM_THRESHOLD` and `M_MMAP_THRESHOLD` of glibc's malloc.h."""
_KEEP_BYTES = 1 << 30


def keep_freed_memory() -> bool:
    """Let glibc keep large blocks that were freed, for the next one; whether that could be set.

    By default it returns them to the system and gets them again, emptied page by page: training and simulation, which
    allocate megabytes in every operation, then spend a third of their time there (measured). Where the C library is
    another one, nothing happens.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    return bool(mallopt(_MMAP, _KEEP_BYTES)) and bool(mallopt(_TRIM, _KEEP_BYTES))


@contextmanager
def imports() -> Iterator[None]:
    """What is imported here stays to the end, so no collector of garbage need go through it: neither meanwhile, nor later,
    nor at the end, which takes a third of the time that a command needs to start and to stop."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
