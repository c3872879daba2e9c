"""One force, one file. Internal energies share the signature of `InternalEnergy`."""

from diffcloud.sim.energies.air import Air
from diffcloud.sim.energies.base import Geometry, InternalEnergy, Linearisation
from diffcloud.sim.energies.bending import Bending
from diffcloud.sim.energies.handles import Handles
from diffcloud.sim.energies.stretching import Stretching

__all__ = ["Air", "Bending", "Geometry", "Handles", "InternalEnergy", "Linearisation", "Stretching"]
