"""How long a result took, and with which versions: beside it, in a hidden file that DVC ignores.

A result has the same bytes whenever and wherever it is made; this has not, and it may be missing.
"""

from __future__ import annotations

import platform
from pathlib import Path, PurePath
from typing import Any, TypeVar

import torch

import diffcloud
from diffcloud.errors import DiffCloudError
from diffcloud.io.files import read_json, write_json

AnyPath = TypeVar("AnyPath", bound=PurePath)
NAME = ".{}.timings.json"
"""Of the file beside a result; `.dvcignore` has it too."""
_FILES = (".json", ".safetensors")
"""Suffixes of results that are files; others are folders, whose names may have a dot."""


def timings_path(result: AnyPath) -> AnyPath:
    """The file that belongs to a result, a file or a folder."""
    return result.with_name(NAME.format(result.stem if result.suffix in _FILES else result.name))


def write_timings(result: Path, seconds: float, **more: Any) -> None:
    """State the wall time of a result [s]; with the versions that it was made with, and `more`."""
    versions = {"diffcloud": diffcloud.__version__, "torch": torch.__version__, "python": platform.python_version()}
    write_json(timings_path(result), {"seconds": seconds, **more, "versions": versions})


def read_timings(result: Path) -> dict[str, Any]:
    """What is known; empty where nothing is, since a result does not depend on it."""
    try:
        told = read_json(timings_path(result))
    except DiffCloudError:
        return {}
    return told if isinstance(told, dict) else {}


def read_seconds(result: Path) -> float | None:
    """Wall time of a result [s]; None where it is not known."""
    seconds = read_timings(result).get("seconds")
    if isinstance(seconds, bool) or not isinstance(seconds, int | float) or seconds < 0:
        return None
    return float(seconds)
