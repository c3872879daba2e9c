"""Run jobs on other machines with a Dask scheduler. Its workers need the same package version and the same folders."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from diffcloud.errors import ConfigError, DiffCloudError

_ANSWER_S = 10.0
"""Time within which a scheduler must answer."""
Item = TypeVar("Item")
Found = TypeVar("Found")


@contextmanager
def scheduler_client(address: str) -> Iterator[Any]:
    """Connect to a Dask scheduler and yield the client.

    Raises:
        ConfigError: no scheduler answers.
    """
    from distributed import Client

    try:
        client = Client(address, timeout=_ANSWER_S)
    except (OSError, ValueError) as error:
        raise ConfigError(f"No Dask scheduler answers at {address}: {error}. Start one with `dask scheduler`.") from error
    with client:
        yield client


def results_in_order(client: Any, work: Callable[[Item], Found], items: Sequence[Item]) -> Iterator[Found]:
    """Apply a function to the items on the workers, and yield the results in the order of the items.

    Raises:
        DiffCloudError: the scheduler or its workers are gone. Files written by jobs remain.
        KeyboardInterrupt: Ctrl-C. Jobs that have not started are cancelled.
    """
    futures = [client.submit(_from_folder, os.getcwd(), work, item, pure=False) for item in items]
    try:
        for future in futures:
            try:
                found = future.result()
            except DiffCloudError:
                raise
            except Exception as error:  # Dask raises several types if it has lost its workers
                raise DiffCloudError(
                    f"The Dask scheduler or its workers ended unexpectedly ({type(error).__name__}: {error}). Finished "
                    "results are kept. Run the command again."
                ) from error
            yield found
            future.release()
    finally:
        client.cancel(futures)


def _from_folder(folder: str, work: Callable[[Item], Found], item: Item) -> Found:
    """Run an item on a worker, in the folder of the command, because a job's paths are relative to it."""
    os.chdir(folder)
    return work(item)
