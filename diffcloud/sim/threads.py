"""The threads that simulate.

Each thread simulates one cloth at a time, so results do not depend on the number of threads or on the batch size. All
simulations of a process share one thread pool. So the number of threads stays the same if several recordings are simulated
at once.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TypeVar

from diffcloud.errors import ConfigError

_LOOK = 0.1
"""Interval between checks of progress and Ctrl-C [s]."""
_chosen: list[int] = []
_simulating: list[tuple[int, ThreadPoolExecutor]] = []
_here = threading.local()


def cores() -> int:
    """Number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def thread_count() -> int:
    """Number of simulating threads: all cores, unless `use_threads` set it."""
    return _chosen[-1] if _chosen else cores()


def use_threads(count: int | None) -> None:
    """Set the number of simulating threads; None: all cores.

    Raises:
        ConfigError: the count is less than one.
    """
    if count is not None and count < 1:
        raise ConfigError(f"--threads must be at least 1, got {count}.")
    _chosen[:] = [] if count is None else [count]


def run_all(jobs: Sequence[Callable[[], None]], *, look: Callable[[], None], stop: Callable[[], None]) -> None:
    """Run jobs that release Python's global interpreter lock in the thread pool, and wait for them.

    Args:
        look: called regularly while the jobs run.
        stop: called at an interruption. It makes running simulations end early. Jobs that compute gradients run to their
            end.

    Raises:
        KeyboardInterrupt: Ctrl-C in the main thread, or in the thread that waits in `map_threads`.
    """
    interrupted: threading.Event | None = getattr(_here, "interrupted", None)

    def look_up() -> None:
        if interrupted is not None and interrupted.is_set():
            raise KeyboardInterrupt
        look()

    _finish([_pool().submit(job) for job in jobs], look_up, stop)


Given = TypeVar("Given")
Found = TypeVar("Found")


def map_threads(function: Callable[[Given], Found], given: Iterable[Given]) -> list[Found]:
    """Apply a function to each item in threads, and return the results in order. The calling thread's setting for recording
    torch gradients applies. Simulations inside the function end soon after Ctrl-C, also in nested calls."""
    import torch  # imported here, because commands that only set the number of threads do not need it

    items, recording = list(given), torch.is_grad_enabled()
    if min(len(items), thread_count()) < 2:
        return [function(item) for item in items]
    interrupted, outer = threading.Event(), getattr(_here, "interrupted", None)

    def look() -> None:
        if outer is not None and outer.is_set():
            raise KeyboardInterrupt

    def run(item: Given) -> Found:
        _here.interrupted = interrupted
        with torch.set_grad_enabled(recording):
            return function(item)

    with ThreadPoolExecutor(min(thread_count(), len(items))) as pool:
        return _finish([pool.submit(run, item) for item in items], look, interrupted.set)


def _pool() -> ThreadPoolExecutor:
    """The thread pool for simulations, with the requested number of threads."""
    count = thread_count()
    if not _simulating or _simulating[-1][0] != count:
        _simulating[:] = [(count, ThreadPoolExecutor(count, thread_name_prefix="diffcloud"))]
    return _simulating[-1][1]


def _finish(futures: Sequence[Future[Found]], look: Callable[[], None], stop: Callable[[], None]) -> list[Found]:
    """Wait for all futures and return their results, or raise the first error in order. On Ctrl-C or an error of `look`,
    stop the jobs, wait for them, and raise it again."""
    open_jobs = set(futures)
    try:
        while open_jobs:
            open_jobs = wait(open_jobs, timeout=_LOOK).not_done
            look()
    except BaseException:
        stop()
        for one in open_jobs:
            one.cancel()
        wait(open_jobs)
        raise
    return [future.result() for future in futures]


os.register_at_fork(after_in_child=_simulating.clear)  # a forked process does not inherit the threads
