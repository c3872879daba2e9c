"""The differentiable cloth simulator. Begin reading at `simulate.py`."""

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
