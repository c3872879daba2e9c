"""Jobs on other machines, by a Dask scheduler whose workers have this version of the package and see the same folders."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from diffcloud.errors import ConfigError, DiffCloudError

_ANSWER_S = 10.0
"""Within which a scheduler answers."""
Item = TypeVar("Item")
Found = TypeVar("Found")


@contextmanager
def scheduler_client(address: str) -> Iterator[Any]:
    """A Dask client of a scheduler.

    Raises:
        ConfigError: none answers.
    """
    from distributed import Client

    try:
        client = Client(address, timeout=_ANSWER_S)
    except (OSError, ValueError) as error:
        raise ConfigError(f"No Dask scheduler answers at {address}: {error}. Start one with `dask scheduler`.") from error
    with client:
        yield client


def results_in_order(client: Any, work: Callable[[Item], Found], items: Sequence[Item]) -> Iterator[Found]:
    """What becomes of each item on the workers, in the order of the items.

    Raises:
        DiffCloudError: the scheduler or its workers are gone; what jobs have written stays.
        KeyboardInterrupt: Ctrl-C; what has not begun is cancelled.
    """
    futures = [client.submit(_from_folder, os.getcwd(), work, item, pure=False) for item in items]
    try:
        for future in futures:
            try:
                found = future.result()
            except DiffCloudError:
                raise
            except Exception as error:  # of many kinds, where Dask has lost its workers
                raise DiffCloudError(
                    f"The Dask scheduler or its workers ended without a word ({type(error).__name__}: {error}). What is "
                    "finished is kept; run the command again."
                ) from error
            yield found
            future.release()
    finally:
        client.cancel(futures)


def _from_folder(folder: str, work: Callable[[Item], Found], item: Item) -> Found:
    """On a worker: paths of a job are relative to the folder of the command."""
    os.chdir(folder)
    return work(item)
