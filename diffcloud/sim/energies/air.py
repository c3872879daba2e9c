"""Air drag and wind on each face, explicit in the step (ARCSim).

    f = ρ_air a |v_n| v_n N + drag a v_t,   v_rel = v_wind - mean corner velocity

with a the material-space area; a third of f acts on each corner.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from diffcloud.sim.elements import Elements, safe_norm
from diffcloud.sim.energies.base import Geometry
from diffcloud.sim.properties import Properties


@dataclass(frozen=True)
class Air:
    """Wind and drag over F faces."""

    elements: Elements
    area: Tensor
    """[F] material-space area [m²]."""
    wind: Tensor
    """[3] velocity of the air [m/s]."""

    def forces(self, at: Geometry, velocities: Tensor, properties: Properties) -> Tensor:
        """[B, V, 3] [N] at velocities [B, V, 3] [m/s]."""
        unit = at.area_normals / safe_norm(at.area_normals)[..., None]
        relative = self.wind - self.elements.gather(velocities).mean(2)
        normal = (relative * unit).sum(-1, keepdim=True)
        drag = properties.air_drag[:, None, None]
        pressure = (properties.air_density[:, None, None] * normal.abs() - drag) * normal
        force = (self.area[:, None] / 3) * (pressure * unit + drag * relative)
        return self.elements.scatter(force[:, :, None].expand(-1, -1, 3, -1))
