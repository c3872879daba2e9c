"""Compiling ahead."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed

from diffcloud.compiled import mark_built
from diffcloud.errors import DiffCloudError

Work = Sequence[tuple[str, str]]
"""Names, and functions as "module:function" that call each kernel once with arguments of the types it is used with."""


def compile_all(progress: Callable[[int, str], None], work: Work, *, processes: int) -> None:
    """Compile everything that is not in the cache folder, and remember that it is complete.

    Args:
        progress: called with how many pieces of work are done, and the name of one that is not.
        work: what compiles, each in a process of its own.
        processes: at once.

    Raises:
        DiffCloudError: a piece failed.
    """
    left = [name for name, _ in work]
    progress(0, left[0])
    with ThreadPoolExecutor(processes) as pool:
        jobs = {pool.submit(_run, place): name for name, place in work}
        for job in as_completed(jobs):
            job.result()
            left.remove(jobs[job])
            progress(len(work) - len(left), left[0] if left else "")
    mark_built()


def _run(place: str) -> None:
    module, function = place.split(":")
    code = (
        f"from diffcloud.compiled import announcement; announcement.silent = True; import {module}; {module}.{function}()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise DiffCloudError(f"Compiling {place} failed: {done.stderr.strip().splitlines()[-1:]}")
