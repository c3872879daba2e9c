"""Manifests: a list of the files that a command wrote into a folder, so that it later removes only its own files."""

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
    """Return the listed paths relative to the folder, with slashes. Empty if there is no manifest.

    Raises:
        DiffCloudError: the manifest is damaged.
    """
    files = _read(folder).get("files", [])
    if not isinstance(files, list) or not all(isinstance(name, str) and len(name) <= _LONGEST for name in files):
        raise DiffCloudError(
            f"{Path(folder) / NAME} must list `files`; remove it, and the command will remove no older results."
        )
    return set(files)


def read_marks(folder: Path) -> dict[str, str]:
    """Return result -> fingerprint of its inputs, for all finished results. Empty if unknown.

    Raises:
        DiffCloudError: the manifest is damaged.
    """
    marks = _read(folder).get("fingerprints", {})
    return {str(name): str(mark) for name, mark in marks.items()} if isinstance(marks, dict) else {}


def write_manifest(folder: Path, names: Iterable[str], marks: Mapping[str, str] | None = None) -> None:
    """Write the list of files that a command has written, or is going to write.

    Args:
        marks: fingerprints, see `read_marks`.
    """
    told = {} if marks is None else {"fingerprints": dict(sorted(marks.items()))}
    write_json(Path(folder) / NAME, {"files": sorted(names), **told})


def remove_manifest(folder: Path) -> None:
    """Remove the manifest of a folder without results, and the folder if it is then empty."""
    remove_files(folder, [NAME])
    with suppress(OSError):  # the folder is not empty
        Path(folder).rmdir()


def _read(folder: Path) -> dict[str, Any]:
    path = Path(folder) / NAME
    told = read_json(path) if path.is_file() else {}
    return told if isinstance(told, dict) else {"files": None}


def remove_files(folder: Path, names: Iterable[str]) -> list[str]:
    """Remove those of the files that exist, and folders that become empty. Return the removed names.

    Raises:
        DiffCloudError: a name leads out of the folder, or a file cannot be removed.
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
            with suppress(OSError):  # the folder is not empty
                if parent.parts:
                    (folder / parent).rmdir()
    return removed
