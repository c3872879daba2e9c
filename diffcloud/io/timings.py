"""Wall time and package versions of a result, in a hidden file beside it that DVC ignores.

Results are byte-identical between runs. Timings are not, so they are kept in a separate file, which may be missing.
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
"""Name of the file beside a result. `.dvcignore` has the same pattern."""
_FILES = (".json", ".safetensors")
"""Suffixes of results that are files. Other results are folders, whose names may have a dot."""


def timings_path(result: AnyPath) -> AnyPath:
    """Return the path of the timings of a result (file or folder)."""
    return result.with_name(NAME.format(result.stem if result.suffix in _FILES else result.name))


def write_timings(result: Path, seconds: float, **more: Any) -> None:
    """Write the wall time of a result [s], the package versions, and further entries `more`."""
    versions = {"diffcloud": diffcloud.__version__, "torch": torch.__version__, "python": platform.python_version()}
    write_json(timings_path(result), {"seconds": seconds, **more, "versions": versions})


def read_timings(result: Path) -> dict[str, Any]:
    """Read the timings of a result. Empty if they are missing or damaged, because no result depends on them."""
    try:
        told = read_json(timings_path(result))
    except DiffCloudError:
        return {}
    return told if isinstance(told, dict) else {}


def read_seconds(result: Path) -> float | None:
    """Return the wall time of a result [s], or None if unknown."""
    seconds = read_timings(result).get("seconds")
    if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not seconds >= 0:
        return None
    return float(seconds)
