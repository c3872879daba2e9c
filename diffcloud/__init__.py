"""DiffCloud: estimate the simulation parameters of a real cloth from point clouds of its motion.

    import diffcloud as dc

    recording = dc.load_recording("lift1.npz")
    scenes = dc.find_scenes([recording], size=(0.40, 0.30), density=0.24)
    found = dc.fit([recording], scenes)
    print(found)
    dc.export(found, "mujoco", "mujoco", samples=20)

The public names are in `__all__` and are imported on first use. Lengths are in metres, z is up.

Imports between packages go in one direction (checked by a test):

    mesh, io  <-  sim  <-  scene  <-  arcsim   (sim and scene refer to modules of arcsim by name only)
    clouds     <- mesh, io
    estimation <- sim, scene, clouds
    identification, evaluation <- estimation
    datasets   <- sim, scene, clouds
    regressors <- mesh, clouds, io
    sensing    <- mesh, clouds, io
    hardware   <- sensing, io                  (packages of cameras and arm are imported when a device is opened)
    reporting, library <- everything above
    cli        <- everything; imported only by pipeline (the stages of `dvc repro`) and studies
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from diffcloud.errors import DiffCloudError

if TYPE_CHECKING:
    from diffcloud.estimation.settings import FitSettings
    from diffcloud.io.episodes import Episode
    from diffcloud.library import (
        Estimate,
        Fit,
        Scene,
        chamfer,
        export,
        find_scenes,
        fit,
        load_recording,
        report,
        sample_surface,
    )

__version__ = "0.1.0"

_PLACES = {"FitSettings": "diffcloud.estimation.settings", "Episode": "diffcloud.io.episodes"}
"""Module of each public name that is not in `library`."""
__all__ = [
    "DiffCloudError",
    "Episode",
    "Estimate",
    "Fit",
    "FitSettings",
    "Scene",
    "chamfer",
    "export",
    "find_scenes",
    "fit",
    "load_recording",
    "report",
    "sample_surface",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'diffcloud' has no attribute {name!r}")
    return getattr(import_module(_PLACES.get(name, "diffcloud.library")), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
