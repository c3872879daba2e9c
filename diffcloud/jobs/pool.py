"""Run many independent jobs, in this process or in several."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing.synchronize import Event
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol, TypeVar

from diffcloud.console import progress_bar
from diffcloud.errors import DiffCloudError
from diffcloud.jobs import ctrl_c
from diffcloud.jobs.cluster import results_in_order, scheduler_client
from diffcloud.jobs.fork_server import worker_context
from diffcloud.jobs.memory import imports, keep_freed_memory
from diffcloud.sim.threads import cores, use_threads

Tell = Callable[[float, str], None]
"""Callback for the progress of a job: (fraction done, text)."""

_stop: Event | None = None
"""In a worker: event that is set when Ctrl-C was pressed."""


class Job(Protocol):
    """A job. Jobs and their results must be picklable."""

    @property
    def label(self) -> str:
        """Text for the progress display."""

    def run(self, tell: Tell) -> Any:
        """Run the job and return its result.

        Raises:
            DiffCloudError: this job failed. Other jobs continue.
        """


AnyJob = TypeVar("AnyJob", bound=Job)


def run_all(
    title: str, jobs: Sequence[AnyJob], workers: int | None, *, patient: bool = False, scheduler: str | None = None
) -> Iterator[tuple[AnyJob, Any, str | None]]:
    """Run all jobs. Yield (job, result, error message) in the order of the jobs.

    Args:
        workers: number of processes, each with one thread. 1: this process. None: one per core.
        scheduler: address of a Dask scheduler whose workers run the jobs instead. They need the same folders.
        patient: after Ctrl-C, wait for running jobs, which must call `check_interrupt`. Otherwise kill their processes.

    Raises:
        ConfigError: no scheduler answers.
        DiffCloudError: a process or the scheduler died.
        KeyboardInterrupt: Ctrl-C.
    """
    workers = cores() if workers is None else workers
    with progress_bar(title, len(jobs)) as update:
        if scheduler is not None and jobs:
            with scheduler_client(scheduler) as client:
                for index, (job, found) in enumerate(
                    zip(jobs, results_in_order(client, _attempt_there, jobs), strict=True)
                ):
                    update(index + 1, job.label)
                    yield (job, *found)
            return
        if workers == 1 or len(jobs) < 2:
            _one_thread()
            for index, job in enumerate(jobs):
                update(index, job.label)
                yield (job, *_attempt(job, partial(_tell, update, index, job.label)))
            return
        context = worker_context()
        stop = context.Event()
        with (
            # Send jobs in files. Before Python 3.11.5, a pool whose processes have died blocks forever while sending
            # data that exceed the pipe's buffer (gh-94777).
            TemporaryDirectory(prefix="diffcloud-") as folder,
            ProcessPoolExecutor(
                min(workers, len(jobs)), mp_context=context, initializer=_begin, initargs=(stop, patient)
            ) as pool,
        ):
            results = [pool.submit(_attempt_stored, _stored(job, Path(folder) / str(i))) for i, job in enumerate(jobs)]
            try:
                for index, (job, result) in enumerate(zip(jobs, results, strict=True)):
                    found = result.result()
                    update(index + 1, job.label)
                    yield (job, *found)
            except BrokenProcessPool as error:
                raise DiffCloudError(
                    "A worker process died, probably because memory ran out. Try fewer --workers."
                ) from error
            except BaseException:  # Ctrl-C, or the caller stopped the iteration
                stop.set()
                pool.shutdown(wait=False, cancel_futures=True)
                raise


def check_interrupt() -> None:
    """Raise KeyboardInterrupt if the jobs should stop. Jobs call this regularly.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed in the parent process, or in this process and a library dropped it.
    """
    if (_stop is not None and _stop.is_set()) or ctrl_c.was_pressed():
        raise KeyboardInterrupt


def _attempt(job: Job, tell: Tell = lambda done, text: None) -> tuple[Any, str | None]:
    try:
        return job.run(tell), None
    except DiffCloudError as error:
        return None, str(error)


def _attempt_there(job: Job) -> tuple[Any, str | None]:
    """Run a job on a Dask worker, with one thread."""
    _one_thread()
    use_threads(1)
    return _attempt(job)


def _stored(job: Job, path: Path) -> Path:
    path.write_bytes(pickle.dumps(job))
    return path


def _attempt_stored(path: Path) -> tuple[Any, str | None]:
    with imports():
        job: Job = pickle.loads(path.read_bytes())  # trusted: this program has just written it
    path.unlink()
    return _attempt(job)


def _tell(update: Callable[[float, str], None], index: int, label: str, done: float, text: str) -> None:
    update(index + done, f"{label}  {text}")


def _one_thread() -> None:
    """Limit torch to one thread, because sums over several threads may differ in the last bits."""
    with imports():
        import torch  # imported here, so that the garbage collector is paused
    torch.set_num_threads(1)


def _begin(stop: Event, patient: bool) -> None:
    """Set up a worker: ignore Ctrl-C, which the parent handles, and use one thread."""
    global _stop
    _stop = stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _one_thread()
    use_threads(1)
    keep_freed_memory()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if not patient:
        threading.Thread(target=_end_at, args=(stop,), daemon=True).start()


def _end_with_parent() -> None:
    """End this worker when its parent dies. A killed parent cannot notify its workers, which would wait forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _end_at(stop: Event) -> None:
    stop.wait()
    os._exit(0)
