"""Still air around a cloth, as theory has it for a flat plate of its size.

A plate that swings through air takes air along: that adds to its inertia, and not to its weight. Per area of a plate with
the sides a <= b that moves along its normal it is

    m = π / 4 C_A(b / a) ρ a

with C_A from DNV-RP-C205 (2010), table D-2: 0.579 of a square, 1 of a long strip. Along the plate only a thin layer moves;
its friction on both sides is ρ sqrt(2 ν ω) of the velocity (Stokes' second problem; Landau & Lifshitz, Fluid Mechanics,
§24), here at the frequency ω² = 3 g / (2 b) of a plate that hangs from one side.

The added mass acts in all directions alike here, as a mass matrix with one number a node: along the cloth that is too much.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from diffcloud.mesh.topology import ClothMesh

AIR_DENSITY = 1.2
"""[kg/m³] At 20 °C."""
_VISCOSITY = 1.5e-5
"""Kinematic, of air [m²/s]."""
_GRAVITY = 9.81
"""[m/s²]"""
_RATIOS = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.25, 8.0, 10.0)
_ADDED = (0.579, 0.642, 0.690, 0.757, 0.801, 0.830, 0.872, 0.897, 0.917, 0.934, 0.947)
"""C_A at those ratios of a rectangle's sides."""


@dataclass(frozen=True)
class StillAir:
    """What still air does to a cloth."""

    added_mass: float
    """[kg/m²]"""
    linear_drag: float
    """[kg/(m²·s)]"""


def still_air(mesh: ClothMesh, density: float = AIR_DENSITY) -> StillAir:
    """Of the rectangle around a cloth's material coordinates.

    Args:
        density: of the air [kg/m³].
    """
    short, long = sorted(np.ptp(mesh.verts, axis=0).tolist())
    added = math.pi / 4 * float(np.interp(long / short, _RATIOS, _ADDED)) * density * short
    frequency = math.sqrt(1.5 * _GRAVITY / long)
    return StillAir(added, density * math.sqrt(2 * _VISCOSITY * frequency))
