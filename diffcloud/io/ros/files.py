"""Open ROS recordings: a file, the parts of a split recording, or a rosbag2 folder.

Recorders split long recordings into files `name_0`, `name_1`, ... A single part is incomplete, and often lacks the
transforms, which are sent only once. rosbag2 lists the parts in metadata.yaml. rosbag1 only numbers them, but users
number separate takes in the same manner. There, files are parts of one recording if their times adjoin.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import yaml

from diffcloud.errors import DiffCloudError, EpisodeError
from diffcloud.io.inputs import check_input
from diffcloud.io.ros.topics import POINT_CLOUD, is_depth

_METADATA = "metadata.yaml"
_NUMBERED = re.compile(r"(.*)_(\d+)")
_DATE = re.compile(r"_?\d{4}-\d{2}-\d{2}-\d{2}-\d{2}-\d{2}")
"""Start time that rosbag1 adds to the name of each part."""
_ADJOINING_S = 5.0
"""Largest gap between parts. They adjoin closely, but may start with a slow topic. Between takes, the cloth must
be spread again, which takes longer."""


@contextmanager
def opened(paths: Sequence[Path]) -> Iterator[Any]:
    """Yield a reader (`rosbags.highlevel.AnyReader`) of all files together, with messages in order of arrival.

    Raises:
        EpisodeError: a file is missing or damaged. This includes damage that is found later, inside the block.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    shown = ", ".join(map(str, paths))
    for path in paths:
        if Path(path).exists() and not Path(path).is_dir():
            check_input(path, kind="recording", error=EpisodeError, most_bytes=sys.maxsize)
    # rosbag2 recordings before 2023 have no message definitions. Those of ROS Humble are compatible.
    try:
        reader = AnyReader([Path(path) for path in paths], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except FileNotFoundError as error:
        raise EpisodeError(f"No such recording: {error}.") from error
    except Exception as error:  # rosbags raises many types of errors on damaged files
        raise EpisodeError(f"{shown} is not a readable ROS recording ({type(error).__name__}: {error}).") from error
    try:
        yield reader
    except (DiffCloudError, MemoryError):
        raise
    except Exception as error:
        raise EpisodeError(f"{shown} cannot be read to its end ({type(error).__name__}: {error}).") from error
    finally:
        with suppress(Exception):
            reader.close()


def refuse_lone_parts(paths: Sequence[Path]) -> tuple[str, ...]:
    """Check that no part of a split recording is missing.

    Returns:
        Warnings about files that may be parts but are not readable.

    Raises:
        EpisodeError: parts are missing. The message names the folder or files to use instead.
    """
    warnings: list[str] = []
    given = {Path(path).resolve() for path in paths}
    for path in map(Path, paths):
        if path.is_dir():
            continue
        listed = _listed_beside(path)
        if path.name in listed:
            if {(path.parent / name).resolve() for name in listed} - given:
                raise EpisodeError(
                    f"{path} is one of the {len(listed)} parts of a split recording ({', '.join(listed)}): give the folder "
                    f"{path.parent} to import all of it."
                )
            continue
        parts, unsure = _adjoining(path)
        if {part.resolve() for part in parts} - given:
            raise EpisodeError(
                f"{path} is one of the {len(parts)} parts of a split recording, whose times adjoin: give all of them, "
                f"{' '.join(map(str, parts))}. To import one alone, move it to a folder of its own."
            )
        warnings += [
            f"{other} cannot be read; if it is a part of the same recording as {path.name}, that part is missing."
            for other in unsure
        ]
    return tuple(dict.fromkeys(warnings))


def _listed_beside(path: Path) -> list[str]:
    """List the files of the rosbag2 recording in the same folder as `path`. Empty without metadata.yaml."""
    try:
        data = yaml.safe_load((path.parent / _METADATA).read_text(encoding="utf-8"))
        return [PurePath(name).name for name in data["rosbag2_bagfile_information"]["relative_file_paths"]]
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError):
        return []  # a damaged metadata.yaml is reported when the folder itself is opened


def _adjoining(path: Path) -> tuple[list[Path], list[Path]]:
    """Return the parts of the recording that `path` belongs to, in order, and unreadable files with matching names."""
    match = _NUMBERED.fullmatch(path.stem)
    if match is None:
        return [path], []
    number = int(match.group(2))
    # Files with the same name, except for the number and the date.
    beside = {
        int(found.group(2)): other
        for other in sorted(path.parent.iterdir())
        if other.suffix == path.suffix
        and other.is_file()
        and (found := _NUMBERED.fullmatch(other.stem)) is not None
        and _DATE.sub("", found.group(1)) == _DATE.sub("", match.group(1))
    }
    parts, unsure = [path], []
    for step in (-1, 1):
        last, next_number = _extent(path), number + step
        while last is not None and next_number in beside:
            following = _extent(beside[next_number])
            if following is None:
                unsure.append(beside[next_number])
            elif last.adjoins(following):
                parts.insert(0 if step < 0 else len(parts), beside[next_number])
            if following is None or not last.adjoins(following):
                break
            last, next_number = following, next_number + step
    return parts, unsure


@dataclass(frozen=True)
class _Extent:
    """Time range [s] and depth topics of a file."""

    start_s: float
    end_s: float
    surfaces: frozenset[str]
    """Topics of depth images and of clouds."""

    def adjoins(self, other: _Extent) -> bool:
        near = self.start_s <= other.end_s + _ADJOINING_S and other.start_s <= self.end_s + _ADJOINING_S
        return near and bool(self.surfaces & other.surfaces)  # cameras recorded side by side are no parts


def _extent(path: Path) -> _Extent | None:
    """Return the extent of a file, or None if it is not readable."""
    try:
        with opened([path]) as reader:
            surfaces = frozenset(
                held.topic
                for held in reader.connections
                if is_depth(held.topic, held.msgtype) or held.msgtype == POINT_CLOUD
            )
            return _Extent(1e-9 * reader.start_time, 1e-9 * reader.end_time, surfaces)
    except EpisodeError:
        return None
