"""Chunks kept on disk while a set is simulated, so that an interrupted run goes on where it stopped.

The work folder lies beside the output. It belongs to one plan: a fingerprint of everything that decides the numbers,
including this package's source, says whether its chunks may be used. It lists its files, and only these are ever removed.
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
"""Packages whose source decides the numbers."""
_ARRAYS = ("parameters", "nodes", "replaced")
_PLAN = "plan.json"


class WorkFolder:
    """The chunks of one plan that are finished."""

    def __init__(self, out: Path, plan: Any, chunks: Sequence[Chunk]) -> None:
        """
        Args:
            out: the set's folder; the work folder is its sibling `<name>.partial`.
            plan: what decides the numbers: dataclasses, mappings, sequences, arrays, numbers, strings.
            chunks: all of the plan.

        Raises:
            ConfigError: the output or the work folder exists and is something else.
            DiffCloudError: the folder cannot be written.
        """
        self.out = Path(out).absolute()
        self.path = self.out.with_name(f"{self.out.name}.partial")
        mark = fingerprint(plan, packages=_CODE)
        former = self._plan()
        if former is None:  # else the output was looked at by the call that made the work folder
            self._refuse_others()
        self.discarded = former is not None and former["fingerprint"] != mark
        if former is not None and self.discarded:
            remove_files(self.path, former["files"])
        replaced = simulated_files(self.out) or (former["replaces"] if former is not None else [])
        self._files = [*(self._file(chunk).name for chunk in chunks), _PLAN]
        self._replaces: list[str] = replaced
        write_json(self.path / _PLAN, {"fingerprint": mark, "files": self._files, "replaces": replaced})

    def write(self, chunk: Chunk, result: SimulatedChunk) -> None:
        """Keep a finished chunk."""
        replaced = np.array(json.dumps([asdict(entry) for entry in result.replaced]))
        arrays = {"parameters": result.parameters, "nodes": result.nodes, "replaced": replaced}
        write_npz(self._file(chunk), compressed=False, **arrays)

    def read(self, chunk: Chunk) -> SimulatedChunk | None:
        """A finished chunk, None if it is missing or damaged."""
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
        """Let `write` write the set and name its files; remove what is left of a former one, and this work folder.

        A kill at any moment leaves the former set, or none, and the chunks.
        """
        with together():
            written = write(self.out)
        remove_files(self.out, set(self._replaces) - set(written))
        remove_files(self.path, self._files)
        with suppress(OSError):  # somebody else has put something there
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
        """What the call that made the work folder has stated; None if there is none, or it is of something else."""
        try:
            told = read_json(self.path / _PLAN, error=DatasetError)
        except DatasetError:
            return None
        named = isinstance(told, dict) and isinstance(told.get("fingerprint"), str)
        lists = named and all(isinstance(told.get(key), list) for key in ("files", "replaces"))
        return told if lists else None
