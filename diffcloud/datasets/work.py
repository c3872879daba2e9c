"""Store finished chunks on disk during a simulation, so that an interrupted run can be resumed.

The work folder is beside the output and belongs to one plan. A fingerprint of everything that affects the results,
including source code, tells whether its chunks can be reused. The folder lists its files, and only these are ever
removed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from diffcloud.datasets.chunks import Chunk, Replaced, SimulatedChunk
from diffcloud.errors import ConfigError, DatasetError
from diffcloud.io.arrays import read_npz
from diffcloud.io.files import files_in, read_json, together, write_json, write_npz
from diffcloud.io.fingerprints import fingerprint
from diffcloud.io.manifests import remove_files
from diffcloud.io.simulated import LARGEST_BYTES, simulated_files

_CODE = ("mesh", "sim", "scene", "datasets")
"""Packages whose source code affects the results."""
_ARRAYS = ("parameters", "nodes", "replaced")
_PLAN = "plan.json"


class WorkFolder:
    """The folder of finished chunks of a plan."""

    def __init__(self, out: Path, plan: Any, chunks: Sequence[Chunk]) -> None:
        """Open or create the work folder.

        Args:
            out: folder of the set. The work folder is its sibling `<name>.partial`.
            plan: inputs of the results: dataclasses, mappings, sequences, arrays, numbers, strings.
            chunks: all chunks of the plan.

        Raises:
            ConfigError: the output or work folder exists and has other contents.
            DiffCloudError: the folder is not writable.
        """
        self.out = Path(out).absolute()
        self.path = self.out.with_name(f"{self.out.name}.partial")
        mark = fingerprint(plan, packages=_CODE)
        former = self._plan()
        if former is None:  # otherwise the call that created the work folder has checked the output
            self._refuse_others()
        self.discarded = former is not None and former["fingerprint"] != mark
        if former is not None and self.discarded:
            remove_files(self.path, former["files"])
        replaced = simulated_files(self.out) or (former["replaces"] if former is not None else [])
        self._files = [*(self._file(chunk).name for chunk in chunks), _PLAN]
        self._replaces: list[str] = replaced
        write_json(self.path / _PLAN, {"fingerprint": mark, "files": self._files, "replaces": replaced})

    def write(self, chunk: Chunk, result: SimulatedChunk) -> None:
        """Store a finished chunk."""
        replaced = np.array(json.dumps([asdict(entry) for entry in result.replaced]))
        arrays = {"parameters": result.parameters, "nodes": result.nodes, "replaced": replaced}
        write_npz(self._file(chunk), compressed=False, **arrays)

    def read(self, chunk: Chunk) -> SimulatedChunk | None:
        """Read a finished chunk. None if it is missing or damaged."""
        try:
            path, most = self._file(chunk), LARGEST_BYTES
            told = read_npz(path, kind="chunk of runs", error=DatasetError, names=_ARRAYS, most_bytes=most)
            replaced = json.loads(str(told["replaced"]))
            return SimulatedChunk(
                told["parameters"],
                told["nodes"],
                tuple(Replaced(**{**entry, "parameters": tuple(entry["parameters"])}) for entry in replaced),
            )
        except (DatasetError, ValueError, KeyError, TypeError):
            return None

    def publish(self, write: Callable[[Path], list[str]]) -> None:
        """Call `write`, which writes the set and returns file names. Then remove remains of an old set, and this
        folder.

        If the process is killed at any time, the old set or no set remains, and the chunks.
        """
        with together():
            written = write(self.out)
        remove_files(self.out, set(self._replaces) - set(written))
        remove_files(self.path, self._files)
        with suppress(OSError):  # the folder has other files
            self.path.rmdir()

    def _refuse_others(self) -> None:
        if self.out.exists() and not (self.out.is_dir() and ((self.out / "set.json").is_file() or not files_in(self.out))):
            raise ConfigError(
                f"{self.out} holds something else than a simulated set; give another --out, or remove it yourself."
            )
        if self.path.exists() and not (self.path.is_dir() and not files_in(self.path)):
            raise ConfigError(
                f"{self.path}, where finished runs would be kept, holds something else; give another --out, or move it."
            )

    def _file(self, chunk: Chunk) -> Path:
        return self.path / f"{chunk.name}.npz"

    def _plan(self) -> dict[str, Any] | None:
        """Return the contents of the plan file. None if it is missing or invalid."""
        try:
            told = read_json(self.path / _PLAN, error=DatasetError)
        except DatasetError:
            return None
        named = isinstance(told, dict) and isinstance(told.get("fingerprint"), str)
        lists = named and all(isinstance(told.get(key), list) for key in ("files", "replaces"))
        return told if lists else None
