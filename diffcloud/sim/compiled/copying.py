"""Array copies inside kernels."""

from __future__ import annotations

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats, Ints


@kernel
def copy_to(target: Floats | Ints, source: Floats | Ints) -> None:
    """target[:] = source, for arrays of equal shape with one or two axes. Numba's own assignment takes seconds to compile,
    because it includes an error message for different shapes."""
    if target.ndim == 1:
        for i in range(len(source)):
            target[i] = source[i]
    else:
        for i in range(len(source)):
            for k in range(source.shape[1]):
                target[i, k] = source[i, k]
