"""Added mass and drag of still air around a cloth, from the theory of a flat plate of the same size.

A plate that swings through air moves some of the air with it. This adds to its inertia, but not to its weight. The added
mass per area of a plate with sides a <= b that moves along its normal is

    m = π / 4 C_A(b / a) ρ a

with C_A from DNV-RP-C205 (2010), table D-2: 0.579 for a square, 1 for a long strip. Along the plate only a thin layer
moves. Its friction on both sides is ρ sqrt(2 ν ω) times the velocity (Stokes' second problem; Landau & Lifshitz, Fluid
Mechanics, §24). The frequency ω is that of a plate that hangs from one side: ω² = 3 g / (2 b).

This model applies the added mass in all directions, as a mass matrix with one number per node. Along the cloth this is too
much.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from diffcloud.mesh.topology import ClothMesh

AIR_DENSITY = 1.2
"""Air density at 20 °C [kg/m³]."""
_VISCOSITY = 1.5e-5
"""Kinematic viscosity of air [m²/s]."""
_GRAVITY = 9.81
"""Gravitational acceleration [m/s²]."""
_RATIOS = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.25, 8.0, 10.0)
_ADDED = (0.579, 0.642, 0.690, 0.757, 0.801, 0.830, 0.872, 0.897, 0.917, 0.934, 0.947)
"""C_A at the aspect ratios `_RATIOS`."""


@dataclass(frozen=True)
class StillAir:
    """Effect of still air on a cloth."""

    added_mass: float
    """Mass per area of the air that moves with the cloth [kg/m²]."""
    linear_drag: float
    """Coefficient of the linear drag [kg/(m²·s)]."""


def still_air(mesh: ClothMesh, density: float = AIR_DENSITY) -> StillAir:
    """Added mass and drag for the bounding rectangle of a cloth in material space, in air of a density [kg/m³]."""
    short, long = sorted(np.ptp(mesh.verts, axis=0).tolist())
    added = math.pi / 4 * float(np.interp(long / short, _RATIOS, _ADDED)) * density * short
    frequency = math.sqrt(1.5 * _GRAVITY / long)
    return StillAir(added, density * math.sqrt(2 * _VISCOSITY * frequency))
