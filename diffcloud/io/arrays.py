"""Read NPZ and NPY files from untrusted sources. Headers are checked before memory is allocated."""

from __future__ import annotations

import math
import os
import zipfile
import zlib
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import DiffCloudError
from diffcloud.io.inputs import MOST_BYTES, check_size, open_input

ELEMENTS = "biufSU"
"""Accepted kinds of elements: numbers and strings. Objects are refused."""
MOST_DIMENSIONS = 8
_PIECE = 16 << 20
"""Number of bytes decompressed at a time, directly into the array, so that no array is in memory twice."""


def read_npz(
    path: Path,
    *,
    kind: str,
    error: type[DiffCloudError],
    names: Collection[str] | None = None,
    most_bytes: int = MOST_BYTES,
) -> dict[str, NDArray[Any]]:
    """Read arrays by name.

    Args:
        kind: kind of file, for messages, such as "episode".
        names: arrays to read, by default all.

    Raises:
        error: the file is missing, not a regular file, damaged, encrypted, or too large (compressed or decompressed).
            Also if an array is missing, occurs twice, or has elements other than numbers and strings.
    """
    path = Path(path)
    try:
        with open_input(path, kind=kind, error=error, most_bytes=most_bytes) as file, zipfile.ZipFile(file) as archive:
            entries = archive.infolist()
            # The stated sizes can be trusted: zipfile stops at the size in the directory.
            size = sum(entry.file_size for entry in entries)
            check_size(path, size, kind, error, most_bytes, says="unpacks to")
            held = {entry.filename.removesuffix(".npy"): entry for entry in entries}
            if len(held) < len(entries):
                twice = Counter(entry.filename.removesuffix(".npy") for entry in entries).most_common(1)[0][0]
                raise ValueError(f"it holds {twice!r} twice; an array may stand there once. Write the file again")
            missing = sorted(set(names or ()) - set(held))
            if missing:
                raise ValueError(f"it lacks {', '.join(missing)}")
            found = {}
            for name in held if names is None else names:
                with archive.open(held[name]) as stream:
                    found[name] = _array(cast(BinaryIO, stream), held[name].file_size, name)
            return found
    # zipfile raises NotImplementedError for unknown compression, and RuntimeError for encrypted entries.
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, ValueError, OSError, EOFError) as damage:
        raise error(f"{path} is not a readable {kind}: {damage}.") from damage


def read_npy(path: Path, *, kind: str, error: type[DiffCloudError], most_bytes: int = MOST_BYTES) -> NDArray[Any]:
    """Read the array of one NPY file.

    Args:
        kind: kind of file, for messages.

    Raises:
        error: the file is missing, damaged, too large, or has elements other than numbers and strings.
    """
    path = Path(path)
    try:
        with open_input(path, kind=kind, error=error, most_bytes=most_bytes) as stream:
            return _array(stream, os.fstat(stream.fileno()).st_size, path.name)
    except (ValueError, OSError, EOFError) as damage:
        raise error(f"{path} is not a readable {kind}: {damage}.") from damage


def _array(stream: BinaryIO, size: int, name: str) -> NDArray[Any]:
    """Read one array from a stream of `size` bytes.

    Raises:
        ValueError: the header is invalid, or does not match the number of bytes.
    """
    try:
        shape, fortran, dtype = npy_header(stream)
    except ValueError as damage:
        raise ValueError(f"{name} has no header of an array ({damage})") from damage
    if not readable(dtype):
        raise ValueError(f"{name} has elements of type {dtype}; only numbers and non-empty strings are allowed")
    there = size - stream.tell()
    if len(shape) > MOST_DIMENSIONS or any(extent < 0 for extent in shape):
        raise ValueError(f"{name} has the shape {list(shape)}")
    stated = math.prod(shape) * dtype.itemsize  # Python integers do not overflow
    if stated != there:
        raise ValueError(f"{name} states {stated} bytes and has {there}")
    flat: NDArray[Any] = np.empty(math.prod(shape), dtype)
    whole, done = flat.view(np.uint8).data if there else memoryview(b""), 0
    while done < there:
        got = stream.readinto(whole[done : done + _PIECE])  # type: ignore[attr-defined]
        if not got:
            raise ValueError(f"{name} ends after {done} of {there} bytes")
        done += got
    return flat.reshape(shape, order="F" if fortran else "C")


def readable(dtype: np.dtype[Any]) -> bool:
    """Check that elements are numbers or non-empty strings. A small file may state any number of zero-byte elements,
    for each of which numpy would allocate memory."""
    return not dtype.hasobject and dtype.kind in ELEMENTS and dtype.itemsize > 0


def npy_header(stream: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read the header of an array: shape, whether in Fortran order, and element type.

    Raises:
        ValueError: there is no valid header.
    """
    try:
        version = np.lib.format.read_magic(stream)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        return read_header(stream)
    except Exception as damage:  # numpy parses the header as Python code; damage raises many types of errors
        raise ValueError(str(damage)) from damage
