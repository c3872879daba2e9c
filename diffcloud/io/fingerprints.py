"""Fingerprints that tell whether a stored result is up to date with its settings, data and source code."""

from __future__ import annotations

import hashlib
import inspect
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import diffcloud
from diffcloud.io.files import read_json


def fingerprint(plan: Any, *, packages: Sequence[str]) -> str:
    """Return a hexadecimal digest of the plan, the source files, and the versions of torch and numpy.

    Args:
        plan: settings and data: dataclasses, mappings, sequences, arrays, numbers, strings.
        packages: sub-packages of diffcloud whose source code affects the result.

    Raises:
        TypeError: a value of the plan is known only by its address in memory.
    """
    digest = hashlib.sha256()
    for package in packages:
        for source in sorted((Path(diffcloud.__file__).parent / package).rglob("*.py")):
            digest.update(source.read_bytes())
    digest.update(json.dumps([torch.__version__, np.__version__, _described(plan)], sort_keys=True).encode())
    return digest.hexdigest()


def kept_record(path: Path, mark: str) -> dict[str, Any] | None:
    """Return the JSON object at `path` if it has this fingerprint, otherwise None.

    Raises:
        DiffCloudError: the file is not valid JSON.
    """
    kept = read_json(path) if path.is_file() else None
    return kept if isinstance(kept, dict) and kept.get("fingerprint") == mark else None


def _described(value: Any) -> Any:
    """Convert a value to plain JSON that is equal exactly for equal values."""
    if isinstance(value, np.ndarray):
        return [str(value.dtype), value.shape, hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()]
    if is_dataclass(value) and not isinstance(value, type):
        return [type(value).__name__, {field.name: _described(getattr(value, field.name)) for field in fields(value)}]
    if isinstance(value, Mapping):
        return {str(key): _described(entry) for key, entry in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_described(entry) for entry in value]
    if inspect.isroutine(value):
        return f"{value.__module__}.{value.__qualname__}"
    if " at 0x" in (text := repr(value)):
        raise TypeError(f"{text} has no fingerprint: it is known by its address in memory, which each process changes.")
    return text
