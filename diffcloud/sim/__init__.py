"""The differentiable cloth simulator. Begin reading at `simulate.py`."""

from diffcloud.sim.materials import Material, preset, presets, read_material
from diffcloud.sim.properties import PARAMETERS, Properties, scaled_properties
from diffcloud.sim.simulate import Rollout, init, rollout, step
from diffcloud.sim.state import State, System
from diffcloud.sim.tangents import rollout_tangents

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
    "step",
]
