"""Registry of scene file readers and file-based experiments in packages above this one. Their modules are imported on
first use, so that this package does not depend on them."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from diffcloud.errors import SceneError, unknown_name
from diffcloud.scene.description import Scene

if TYPE_CHECKING:
    from diffcloud.scene.scenarios.scenario import Scenario

READERS = {".json": "diffcloud.arcsim.load"}
"""Suffix of a scene file -> module with `load_scene(path) -> Scene`."""
EXPERIMENTS = dict.fromkeys(("release_lift", "release_fold", "release_hang", "release_band"), "diffcloud.arcsim.release")
"""Name -> module with `load_experiment(name, path) -> Scenario`."""


def load_scene(path: Path) -> Scene:
    """Read a scene file with the reader for its suffix.

    Raises:
        SceneError, MeshError: there is no reader for the suffix, or the file is invalid.
    """
    suffix = Path(path).suffix
    if suffix not in READERS:
        raise SceneError(f"{path}: " + unknown_name("kind of scene file", suffix, READERS))
    scene: Scene = import_module(READERS[suffix]).load_scene(Path(path))
    return scene


def load_experiment(name: str, path: Path) -> Scenario:
    """Return an experiment with its scene file.

    Args:
        name: a key of `EXPERIMENTS`.

    Raises:
        SceneError, MeshError: the file is invalid or belongs to another experiment.
    """
    experiment: Scenario = import_module(EXPERIMENTS[name]).load_experiment(name, Path(path))
    return experiment
