"""Chunks kept on disk while a set is simulated, so that an interrupted run goes on where it stopped.

The work folder lies beside the output. It belongs to one plan: a fingerprint of everything that decides the numbers,
including this package's source, says whether its chunks may be used.
"""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from diffcloud.datasets.chunks import Chunk, Replaced, SimulatedChunk
from diffcloud.errors import ConfigError, DatasetError
from diffcloud.io.files import atomic_path, read_json, write_json
from diffcloud.io.fingerprints import fingerprint

_CODE = ("mesh", "sim", "scene", "datasets")
"""Packages whose source decides the numbers."""


class WorkFolder:
    """The chunks of one plan that are finished."""

    def __init__(self, out: Path, plan: Any) -> None:
        """
        Args:
            out: the set's folder; the work folder is its sibling `<name>.partial`.
            plan: what decides the numbers: dataclasses, mappings, sequences, arrays, numbers, strings.

        Raises:
            ConfigError: the output exists and is no simulated set.
            DiffCloudError: the folder cannot be written.
        """
        out = Path(out).absolute()
        if out.exists() and not (out.is_dir() and ((out / "set.json").is_file() or not any(out.iterdir()))):
            raise ConfigError(
                f"{out} holds something else than a simulated set; give another --out, or remove it yourself."
            )
        self.out, self.path = out, out.with_name(f"{out.name}.partial")
        self.discarded = False
        mark = {"fingerprint": fingerprint(plan, packages=_CODE)}
        if self.path.exists() and self._mark() != mark:
            self.discarded = True
            shutil.rmtree(self.path)
        write_json(self.path / "plan.json", mark)

    def write(self, chunk: Chunk, result: SimulatedChunk) -> None:
        """Keep a finished chunk."""
        replaced = json.dumps([asdict(entry) for entry in result.replaced])
        with atomic_path(self._file(chunk)) as temporary:
            np.savez(
                temporary,
                allow_pickle=False,
                parameters=result.parameters,
                nodes=result.nodes,
                replaced=np.array(replaced),
            )

    def read(self, chunk: Chunk) -> SimulatedChunk | None:
        """A finished chunk, None if it is missing or damaged."""
        try:
            with self._file(chunk).open("rb") as file, np.load(file, allow_pickle=False) as archive:
                replaced = json.loads(str(archive["replaced"]))
                return SimulatedChunk(
                    archive["parameters"],
                    archive["nodes"],
                    tuple(Replaced(**{**entry, "parameters": tuple(entry["parameters"])}) for entry in replaced),
                )
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
            return None

    def publish(self, write: Callable[[Path], None]) -> None:
        """Let `write` fill a folder, put that in the place of the output, and remove this work folder.

        A kill at any moment leaves the former output, or none, and the chunks.
        """
        whole, former = self.path / "whole", self.path / "former"
        for rest in (whole, former):
            shutil.rmtree(rest, ignore_errors=True)
        whole.mkdir()
        write(whole)
        if self.out.exists():
            self.out.rename(former)
        whole.rename(self.out)
        shutil.rmtree(self.path)

    def _file(self, chunk: Chunk) -> Path:
        return self.path / f"{chunk.name}.npz"

    def _mark(self) -> Any:
        try:
            return read_json(self.path / "plan.json", error=DatasetError)
        except DatasetError:
            return None
