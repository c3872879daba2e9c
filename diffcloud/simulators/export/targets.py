"""The targets of `diffcloud export`. A new one is a writer in a module of its own, and a line here.

Nothing here imports torch, so that help is quick.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from diffcloud.errors import ConfigError, unknown_name

if TYPE_CHECKING:
    from diffcloud.simulators.export.cloth import ExportedCloth

Writer = Callable[["ExportedCloth", Path, list[str]], tuple[list[str], list[str]]]
"""Writes a cloth's files into a folder, with the sentences of what the cloth itself leaves out. Returns the names of the
files, and a sentence for everything else that they leave out."""


@dataclass(frozen=True)
class Target:
    """A simulator or a file format."""

    about: str
    """What the files are written for, with its version."""
    writer: str
    """MODULE:FUNCTION of a `Writer`."""
    simplified: bool = False
    """Whether it gets the isotropic sheet (`ExportedCloth.problem`) instead of the whole material."""
    runs: bool = False
    """Whether `--check` can run it."""

    @property
    def write(self) -> Writer:
        module, _, name = self.writer.partition(":")
        found: Writer = getattr(import_module(module), name)
        return found


_OWN = "diffcloud.simulators.export.write"
TARGETS: dict[str, Target] = {
    "mujoco": Target("MuJoCo 4.0.0", f"{_OWN}:mujoco_files", simplified=True, runs=True),
    "newton": Target("Newton 1.8.0 with Warp 1.19.0", f"{_OWN}:newton_files", simplified=True, runs=True),
    "isaac": Target("Isaac Sim 5 (Omni Physics 107 or later)", f"{_OWN}:isaac_files", simplified=True),
    "arcsim": Target("ARCSim 0.2 and DiffSim", f"{_OWN}:arcsim_files"),
    "obj": Target("Wavefront OBJ and CSV", f"{_OWN}:obj_files"),
}
"""Name -> target."""


def target_named(name: str) -> Target:
    """
    Raises:
        ConfigError: no such target.
    """
    if name not in TARGETS:
        raise ConfigError(unknown_name("target", name, TARGETS))
    return TARGETS[name]
