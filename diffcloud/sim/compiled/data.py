"""Named tuples of arrays (float64 and int64) that kernels pass to each other. Numba compiles them to plain structures."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]


class Parameters(NamedTuple):
    """Differentiable inputs of the simulation of one cloth. Gradients and directional derivatives have the same fields."""

    node_mass: Floats
    """[V] inertial mass: the cloth and the air that moves with it [kg]."""
    weight: Floats
    """[V] mass on which gravity acts: the cloth only [kg]."""
    inverse_mass: Floats
    """[N] 1 / node mass of cloth nodes, zero for points of obstacles and bodies [1/kg]."""
    stretching: Floats
    """[F] multiplier on the stretching table of each face [-]."""
    shear: Floats
    """[1] multiplier on the shear column of the stretching table [-]."""
    compression: Floats
    """[1] fraction of the stretching stiffness that resists compression [-]."""
    bending: Floats
    """[H] multiplier on the bending table of each hinge [-]."""
    damping: Floats
    """[1] stiffness-proportional damping [s]."""
    air_density: Floats
    """[1] air density for the quadratic normal drag [kg/m³]."""
    air_drag: Floats
    """[1] coefficient of the linear tangential drag [kg/(m²·s)]."""
    linear_drag: Floats
    """[1] coefficient of the linear drag in all directions [kg/(m²·s)]."""
    friction: Floats
    """[1] Coulomb coefficient between cloth and obstacles [-]."""
    self_friction: Floats
    """[1] Coulomb coefficient of the cloth with itself [-]."""
    body_mass: Floats
    """[B] mass of the rigid bodies [kg]."""
    hold: Floats
    """[H] stiffness of each soft handle in this step [N/m]."""
    target: Floats
    """[H, 3] target position of each handle's node in this step [m]."""


class Motion(NamedTuple):
    """State of all points in one step: cloth nodes, obstacle points, body points. Gradients and derivatives have the same
    fields."""

    positions: Floats
    """[N, 3] positions at which forces are evaluated [m]."""
    before: Floats
    """[N, 3] velocities at the start of the step [m/s]."""
    after: Floats
    """[N, 3] velocities at the end of the step [m/s]."""
    displacement: Floats
    """[N, 3] displacement d of the linearised elastic forces F - H d [m]."""


class Timing(NamedTuple):
    """Step length and time of the force evaluation."""

    time_step: float
    """Time step [s]."""
    ahead: float
    """Time from `positions` to the end of the step [s]: the time step, or zero if they are those of its end."""
