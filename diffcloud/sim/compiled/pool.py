"""Arrays that grow inside kernels."""

from __future__ import annotations

import numpy as np

from diffcloud.compiled import kernel


@kernel
def with_room(pool, used: int, more: int):  # type: ignore[no-untyped-def]
    """Return the array [capacity, width], or a longer copy if `more` rows do not fit after the `used` ones."""
    if used + more <= len(pool):
        return pool
    longer = np.empty((max(2 * len(pool), used + more), pool.shape[1]), pool.dtype)
    for row in range(used):
        for column in range(pool.shape[1]):
            longer[row, column] = pool[row, column]
    return longer
