"""How many threads simulate a batch, and how they are waited for.

One thread has one cloth at a time, so that results are the same for any number of threads and any batch.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from typing import TypeVar

from diffcloud.errors import ConfigError

_LOOK = 0.1
"""[s] between two looks at progress and Ctrl-C."""
_chosen: list[int] = []


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
        stop: called when something interrupts; lets the jobs end soon.
    """
    with ThreadPoolExecutor(min(thread_count(), max(len(jobs), 1))) as pool:
        open_jobs = {pool.submit(job) for job in jobs}
        try:
            while open_jobs:
                done, open_jobs = wait(open_jobs, timeout=_LOOK, return_when=FIRST_EXCEPTION)
                for one in done:
                    one.result()
                look()
        except BaseException:
            stop()
            for one in open_jobs:
                one.cancel()
            raise


Given = TypeVar("Given")
Found = TypeVar("Found")


def map_threads(function: Callable[[Given], Found], given: Iterable[Given]) -> list[Found]:
    """The function's results, in order; torch's gradients are recorded where they are here."""
    import torch  # here: commands that only choose a number of threads start without it

    items, recording = list(given), torch.is_grad_enabled()
    if min(len(items), thread_count()) < 2:
        return [function(item) for item in items]

    def run(item: Given) -> Found:
        with torch.set_grad_enabled(recording):
            return function(item)

    with ThreadPoolExecutor(min(thread_count(), len(items))) as pool:
        return list(pool.map(run, items))
