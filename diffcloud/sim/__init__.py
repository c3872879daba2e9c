"""The differentiable cloth simulator. Begin reading at `simulate.py`."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffcloud.sim.materials import Material, preset, presets, read_material
    from diffcloud.sim.properties import PARAMETERS, Properties, scaled_properties
    from diffcloud.sim.simulate import Rollout, init, rollout, rollout_tangents
    from diffcloud.sim.system import State, System

__all__ = [
    "PARAMETERS",
    "Material",
    "Properties",
    "Rollout",
    "State",
    "System",
    "init",
    "preset",
    "presets",
    "read_material",
    "rollout",
    "rollout_tangents",
    "scaled_properties",
]

_MODULES = ("materials", "properties", "simulate", "system")


def __getattr__(name: str) -> Any:
    """Import public names on first use: torch and the kernels take two seconds, and a material table needs neither."""
    if name in __all__:
        for module in map(importlib.import_module, (f"{__name__}.{module}" for module in _MODULES)):
            if name in vars(module):
                return vars(module)[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
