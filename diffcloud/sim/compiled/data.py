"""What kernels pass to each other: named tuples of arrays, which numba compiles to plain structures. float64 and int64."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]


class Parameters(NamedTuple):
    """What a motion can be differentiated by, of one cloth; gradients and rates have the same fields."""

    node_mass: Floats
    """[V] of the cloth and of the air that moves with it: what a force has to accelerate [kg]."""
    weight: Floats
    """[V] of the cloth alone: what gravity pulls at [kg]."""
    inverse_mass: Floats
    """[N] of all points, zero for those of obstacles and bodies; follows from the node masses [1/kg]."""
    stretching: Floats
    """[F] multiplier on the stretching table of each face [-]."""
    shear: Floats
    """[1] multiplier on the shear of the stretching table [-]."""
    compression: Floats
    """[1] part of the stretching stiffness that resists compression [-]."""
    bending: Floats
    """[H] multiplier on the bending table of each hinge [-]."""
    damping: Floats
    """[1] stiffness-proportional damping [s]."""
    air_density: Floats
    """[1] of the quadratic normal drag [kg/m³]."""
    air_drag: Floats
    """[1] of the linear tangential drag [kg/(m²·s)]."""
    linear_drag: Floats
    """[1] of the linear drag in all directions [kg/(m²·s)]."""
    friction: Floats
    """[1] Coulomb coefficient between cloth and obstacles [-]."""
    self_friction: Floats
    """[1] Coulomb coefficient between cloths [-]."""
    body_mass: Floats
    """[B] of the rigid bodies [kg]."""
    hold: Floats
    """[H] stiffness of each soft handle in this step [N/m]."""
    target: Floats
    """[H, 3] where each handle wants its node in this step [m]."""


class Motion(NamedTuple):
    """All points in one step, as terms see them: the cloth's nodes, then points of obstacles and of bodies. Gradients
    and rates have the same fields."""

    positions: Floats
    """[N, 3] where the forces are evaluated [m]."""
    before: Floats
    """[N, 3] velocities at the start of the step [m/s]."""
    after: Floats
    """[N, 3] velocities at its end [m/s]."""
    displacement: Floats
    """[N, 3] in which elastic forces are linear [m]."""


class Timing(NamedTuple):
    """When forces are evaluated."""

    time_step: float
    """[s]"""
    ahead: float
    """From the positions to the end of the step [s]: the time step where they are those of its start, else zero."""
