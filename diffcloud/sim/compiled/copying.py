"""Copies inside kernels."""

from __future__ import annotations

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats, Ints


@kernel
def copy_to(target: Floats | Ints, source: Floats | Ints) -> None:
    """target[:] = source, of one or two axes and equal shapes. Numba's own assignment compiles for seconds, because it can
    also write a message about shapes that differ."""
    if target.ndim == 1:
        for i in range(len(source)):
            target[i] = source[i]
    else:
        for i in range(len(source)):
            for k in range(source.shape[1]):
                target[i, k] = source[i, k]
