"""How many threads simulate, and how they are waited for.

One thread has one cloth at a time, so that results are the same for any number of threads and any batch. All simulations
of a process share one pool: where several recordings are compared side by side, no more threads simulate than were asked
for.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TypeVar

from diffcloud.errors import ConfigError

_LOOK = 0.1
"""[s] between two looks at progress and Ctrl-C."""
_chosen: list[int] = []
_simulating: list[tuple[int, ThreadPoolExecutor]] = []
_here = threading.local()


def cores() -> int:
    """That this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def thread_count() -> int:
    """Threads that simulate: all cores, unless `use_threads` said otherwise."""
    return _chosen[-1] if _chosen else cores()


def use_threads(count: int | None) -> None:
    """Simulate with so many threads from now on; None: all cores.

    Raises:
        ConfigError: less than one.
    """
    if count is not None and count < 1:
        raise ConfigError(f"--threads must be at least 1, got {count}.")
    _chosen[:] = [] if count is None else [count]


def run_all(jobs: Sequence[Callable[[], None]], *, look: Callable[[], None], stop: Callable[[], None]) -> None:
    """Run jobs, which leave Python's lock alone while they work.

    Args:
        look: called now and then meanwhile.
        stop: called when something interrupts; lets jobs that simulate end soon. Those that sweep an episode for its
            derivatives end with it.

    Raises:
        KeyboardInterrupt: Ctrl-C, in the main thread or, within `map_threads`, in the one that waits there.
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
    """The function's results, in order; torch's gradients are recorded where they are here. What it simulates ends soon
    after Ctrl-C."""
    import torch  # here: commands that only choose a number of threads start without it

    items, recording = list(given), torch.is_grad_enabled()
    if min(len(items), thread_count()) < 2:
        return [function(item) for item in items]
    interrupted = threading.Event()

    def run(item: Given) -> Found:
        _here.interrupted = interrupted
        with torch.set_grad_enabled(recording):
            return function(item)

    with ThreadPoolExecutor(min(thread_count(), len(items))) as pool:
        return _finish([pool.submit(run, item) for item in items], lambda: None, interrupted.set)


def _pool() -> ThreadPoolExecutor:
    """What simulates, with as many threads as are asked for now."""
    count = thread_count()
    if not _simulating or _simulating[-1][0] != count:
        _simulating[:] = [(count, ThreadPoolExecutor(count, thread_name_prefix="diffcloud"))]
    return _simulating[-1][1]


def _finish(futures: Sequence[Future[Found]], look: Callable[[], None], stop: Callable[[], None]) -> list[Found]:
    """Wait for all, and give what they found; the first error in order is raised. Ctrl-C, or an error of `look`, stops
    them, and is raised once they have ended."""
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


os.register_at_fork(after_in_child=_simulating.clear)  # its threads do not live there
