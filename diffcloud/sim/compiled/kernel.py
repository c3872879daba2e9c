"""Compiled functions and where they are kept.

numba compiles a kernel when it is first called and keeps the machine code in the user's cache folder. The folder's
name holds a fingerprint of every source that goes into kernels, since numba itself looks at one function's file and
not at those it calls; so an upgrade compiles again and never mixes versions. Several processes may compile at once:
files are written whole.

`DIFFCLOUD_CACHE_DIR` puts the folder elsewhere. `DIFFCLOUD_UNCOMPILED=1` runs all kernels as plain Python, for a
debugger; a step then takes seconds.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import llvmlite
import numba
from platformdirs import user_cache_path

UNCOMPILED = os.environ.get("DIFFCLOUD_UNCOMPILED", "") not in ("", "0")
_SIM = Path(__file__).parents[1]

F = TypeVar("F", bound=Callable[..., Any])


@cache
def cache_folder() -> Path:
    """Where compiled and generated code of this version lies."""
    digest = hashlib.sha256(f"{numba.__version__} {llvmlite.__version__}".encode())
    for source in sorted(_SIM.rglob("*.py")):
        digest.update(source.relative_to(_SIM).as_posix().encode())
        digest.update(source.read_bytes())
    root = Path(os.environ["DIFFCLOUD_CACHE_DIR"]) if "DIFFCLOUD_CACHE_DIR" in os.environ else user_cache_path("diffcloud")
    return root / "kernels" / digest.hexdigest()[:16]


def kernel(function: F) -> F:
    """A function that numba compiles: of arrays, numbers and named tuples of them. It releases the interpreter's
    lock."""
    if UNCOMPILED:
        return function
    given, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(cache_folder())  # of other people's functions, and of this
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)  # type: ignore[no-any-return]
    finally:
        numba.config.CACHE_DIR = given


def inlined(function: F) -> F:
    """A kernel whose code is put where it is called. Of kernels that call large ones: each kernel is compiled with
    all that it calls, so that deep calls are compiled again on every level."""
    if UNCOMPILED:
        return function
    return numba.njit(inline="always", nogil=True, error_model="numpy")(function)  # type: ignore[no-any-return]
