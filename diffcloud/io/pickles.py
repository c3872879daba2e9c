"""Reading pickled `.npy` files of strangers: plain containers, numbers, strings and numpy arrays only.

A pickle is a program. This unpickler resolves a fixed list of names that build arrays and containers, and refuses any
other, so that a file cannot run code.
"""

from __future__ import annotations

import importlib
import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from diffcloud.errors import EpisodeError

_LARGEST_BYTES = 256 * 2**20
_ALLOWED = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("builtins", "set"): set,
    ("builtins", "frozenset"): frozenset,
    ("builtins", "complex"): complex,
    ("collections", "OrderedDict"): dict,
}
_RECONSTRUCT = {
    (module, name) for module in ("numpy.core.multiarray", "numpy._core.multiarray") for name in ("_reconstruct", "scalar")
}


class _PlainUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _ALLOWED:
            return _ALLOWED[module, name]
        if (module, name) in _RECONSTRUCT:
            return getattr(importlib.import_module("numpy._core.multiarray"), name)
        raise EpisodeError(f"refers to {module}.{name}; only plain containers, numbers and numpy arrays are read")


def load_npy(path: Path) -> Any:
    """Read an `.npy` file: a plain array, or a pickled object made of plain containers and arrays.

    Raises:
        EpisodeError: missing, too large, damaged, or a pickle that carries anything else.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        if size > _LARGEST_BYTES:
            raise EpisodeError(f"{path} has {size} bytes; at most {_LARGEST_BYTES} are read.")
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise EpisodeError(f"No such file: {path}.") from error
    except OSError as error:
        raise EpisodeError(f"Cannot read {path}: {error.strerror}.") from error
    try:
        return np.load(io.BytesIO(data), allow_pickle=False)
    except ValueError as error:
        if "allow_pickle" not in str(error) and "Object arrays" not in str(error):
            raise EpisodeError(f"{path} is not a readable .npy file: {error}.") from error
    except EOFError as error:
        raise EpisodeError(f"{path} is empty.") from error
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, _ = read_header(stream)
        value = _PlainUnpickler(stream, encoding="latin1").load()
    except EpisodeError as error:
        raise EpisodeError(f"{path} {error}.") from error
    except Exception as error:  # a damaged pickle may fail in any way
        raise EpisodeError(f"{path} is a damaged pickle: {error}.") from error
    return value.item() if shape == () and isinstance(value, np.ndarray) else value
