"""What a command wrote into a folder, written down there, so that it removes that and nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

from diffcloud.errors import DiffCloudError
from diffcloud.io.files import read_json, write_json

NAME = "manifest.json"
_LONGEST = 4096


def read_manifest(folder: Path) -> set[str]:
    """Paths relative to the folder, with slashes; empty where there is no manifest.

    Raises:
        DiffCloudError: damaged.
    """
    files = _read(folder).get("files", [])
    if not isinstance(files, list) or not all(isinstance(name, str) and len(name) <= _LONGEST for name in files):
        raise DiffCloudError(
            f"{Path(folder) / NAME} must list `files`; remove it, and the command will remove no older results."
        )
    return set(files)


def read_marks(folder: Path) -> dict[str, str]:
    """Result -> fingerprint of what it was made from, of the finished results; empty where nothing is known.

    Raises:
        DiffCloudError: damaged.
    """
    marks = _read(folder).get("fingerprints", {})
    return {str(name): str(mark) for name, mark in marks.items()} if isinstance(marks, dict) else {}


def write_manifest(folder: Path, names: Iterable[str], marks: Mapping[str, str] | None = None) -> None:
    """State what a command has written, or is going to write.

    Args:
        marks: see `read_marks`.
    """
    told = {} if marks is None else {"fingerprints": dict(sorted(marks.items()))}
    write_json(Path(folder) / NAME, {"files": sorted(names), **told})


def remove_manifest(folder: Path) -> None:
    """Of a folder in which nothing was made; the folder too, where it was all that it held."""
    remove_files(folder, [NAME])
    with suppress(OSError):  # it has something else in it
        Path(folder).rmdir()


def _read(folder: Path) -> dict[str, Any]:
    path = Path(folder) / NAME
    told = read_json(path) if path.is_file() else {}
    return told if isinstance(told, dict) else {"files": None}


def remove_files(folder: Path, names: Iterable[str]) -> list[str]:
    """Remove files of a folder, as far as they are there, and the folders that this leaves empty; what was removed.

    Raises:
        DiffCloudError: a name that leads out of the folder, or a file that cannot be removed.
    """
    folder, removed = Path(folder), []
    for name in names:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise DiffCloudError(f"{folder}: {name!r} lies outside of the folder and is not removed.")
        path = folder / name
        if not path.is_file():
            continue
        try:
            path.unlink()
        except OSError as error:
            raise DiffCloudError(f"Cannot remove {path}: {error.strerror}.") from error
        removed.append(name)
        for parent in path.relative_to(folder).parents:
            with suppress(OSError):  # it has something else in it
                if parent.parts:
                    (folder / parent).rmdir()
    return removed
