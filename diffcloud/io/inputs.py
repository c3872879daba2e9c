"""Open input files of the user: only regular files of limited size. A named pipe, for example, would block forever."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

from diffcloud.errors import DiffCloudError

MOST_BYTES = 1 << 30
"""Largest size of a file, and of its decompressed contents. Readers need up to twice this memory."""
_KINDS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
}


def open_input(
    path: Path, *, kind: str = "file", error: type[DiffCloudError] = DiffCloudError, most_bytes: int = MOST_BYTES
) -> BinaryIO:
    """Open a regular file for reading, without blocking.

    Args:
        kind: kind of file, for messages, such as "gripper file".
        most_bytes: largest accepted size.

    Raises:
        error: the path is missing, not readable, too large, or not a regular file (folder, pipe, socket, device).
    """
    path = Path(path)
    try:
        check_regular(path, os.stat(path), kind, error)  # before opening: opening a device may have side effects
        # O_NONBLOCK: do not wait if the file was replaced by a pipe in the meantime.
        stream = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb")
    except FileNotFoundError as missing:
        raise error(f"No such {kind}: {path}.") from missing
    except (OSError, ValueError) as refused:  # ValueError: a name that no file can have
        raise error(f"Cannot read {path}: {getattr(refused, 'strerror', None) or refused}.") from refused
    found = os.fstat(stream.fileno())
    try:
        check_regular(path, found, kind, error)
        check_size(path, found.st_size, kind, error, most_bytes)
    except DiffCloudError:
        stream.close()
        raise
    return stream


def check_input(
    path: Path, *, kind: str = "file", error: type[DiffCloudError] = DiffCloudError, most_bytes: int = MOST_BYTES
) -> None:
    """Make the checks of `open_input`, for a library that opens the file by its path.

    Raises:
        error: as `open_input`.
    """
    open_input(path, kind=kind, error=error, most_bytes=most_bytes).close()


def read_input(
    path: Path, *, kind: str = "file", error: type[DiffCloudError] = DiffCloudError, most_bytes: int = MOST_BYTES
) -> bytes:
    """Read all bytes of a regular file.

    Raises:
        error: as `open_input`, or the file is longer than its stated size.
    """
    with open_input(path, kind=kind, error=error, most_bytes=most_bytes) as stream:
        try:
            data = stream.read(most_bytes + 1)
        except OSError as damage:
            raise error(f"Cannot read {path}: {damage.strerror or damage}.") from damage
    check_size(path, len(data), kind, error, most_bytes)
    return data


def read_text(
    path: Path, *, kind: str = "file", error: type[DiffCloudError] = DiffCloudError, most_bytes: int = MOST_BYTES
) -> str:
    """Read a regular UTF-8 text file. Line ends become line feeds.

    Raises:
        error: as `read_input`, or the text is not UTF-8.
    """
    try:
        text = read_input(path, kind=kind, error=error, most_bytes=most_bytes).decode("utf-8")
    except UnicodeDecodeError as damage:
        raise error(f"{path} is not a readable {kind}: {damage}. Save it as UTF-8.") from damage
    return text.replace("\r\n", "\n").replace("\r", "\n")


def check_regular(path: Path, found: os.stat_result, kind: str, error: type[DiffCloudError]) -> None:
    """Check that a path is a regular file.

    Raises:
        error: the path is something else.
    """
    if not stat.S_ISREG(found.st_mode):
        what = _KINDS.get(stat.S_IFMT(found.st_mode), "not a regular file")
        raise error(f"{path} is {what}. {_a(kind)} must be a regular file. Write its content to a file, and give that.")


def check_size(
    path: Path, size: int, kind: str, error: type[DiffCloudError], most_bytes: int, *, says: str = "has"
) -> None:
    """Check the size of a file [bytes].

    Args:
        says: verb before the size in the message.

    Raises:
        error: the file is too large.
    """
    if size > most_bytes:
        raise error(
            f"{path} {says} {_shown(size)}. {_a(kind)} may have {_shown(most_bytes)}. Is it the right file? If so, make it "
            "smaller: fewer frames, points or digits."
        )


def _shown(size: int) -> str:
    return f"{size / 1e9:.2f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


def _a(kind: str) -> str:
    return f"{'An' if kind[0] in 'aeio' else 'A'} {kind}"
