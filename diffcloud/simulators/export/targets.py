"""Targets of `diffcloud export`. To add a target, write a writer function and add an entry to `TARGETS`.

This module does not import torch, so that `--help` is fast.
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
"""Function that writes a cloth's files into a folder. Its last argument has sentences about what the cloth itself
lacks. It returns the file names, and sentences about what else the files lack."""


@dataclass(frozen=True)
class Target:
    """A simulator or a file format."""

    about: str
    """Name and version of the simulator or format."""
    writer: str
    """MODULE:FUNCTION of a `Writer`."""
    simplified: bool = False
    """True: the target gets the isotropic sheet (`ExportedCloth.problem`). False: the complete material."""
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
"""Target name -> target."""


def target_named(name: str) -> Target:
    """Return the target of this name.

    Raises:
        ConfigError: there is no such target.
    """
    if name not in TARGETS:
        raise ConfigError(unknown_name("target", name, TARGETS))
    return TARGETS[name]
