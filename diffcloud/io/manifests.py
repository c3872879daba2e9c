"""What a command wrote into a folder, written down there, so that it removes that and nothing else."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path, PurePosixPath

from diffcloud.errors import DiffCloudError
from diffcloud.io.files import read_json, write_json

NAME = "manifest.json"
_LONGEST = 4096


def read_manifest(folder: Path) -> set[str]:
    """Paths relative to the folder, with slashes; empty where there is no manifest.

    Raises:
        DiffCloudError: damaged.
    """
    path = Path(folder) / NAME
    if not path.is_file():
        return set()
    told = read_json(path)
    files = told.get("files") if isinstance(told, dict) else None
    if not isinstance(files, list) or not all(isinstance(name, str) and len(name) <= _LONGEST for name in files):
        raise DiffCloudError(f"{path} must list `files`; remove it, and the command will remove no older results.")
    return set(files)


def write_manifest(folder: Path, names: Iterable[str]) -> None:
    """State what a command has written, or is going to write."""
    write_json(Path(folder) / NAME, {"files": sorted(names)})


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
