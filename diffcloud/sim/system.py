"""Constant data of a simulation (`System`) and its state at one time (`State`)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from torch import Tensor

from diffcloud.mesh.topology import ClothMesh, SurfaceMesh
from diffcloud.sim.handles import Handles
from diffcloud.sim.integrators import Integrator, load_integrator
from diffcloud.sim.properties import Properties
from diffcloud.sim.rigid.bodies import Bodies, BodyState
from diffcloud.sim.terms.term import Setup


@dataclass(frozen=True)
class System:
    """All data that are constant in a simulation."""

    setup: Setup
    time_step: float
    """Length of a step [s]."""
    properties: Properties
    """Properties of the nominal material, batch 1."""

    @property
    def bodies(self) -> Bodies:
        return self.setup.bodies

    @property
    def mesh(self) -> ClothMesh:
        return self.setup.mesh

    @property
    def handles(self) -> Handles:
        return self.setup.handles

    @property
    def obstacles(self) -> tuple[SurfaceMesh, ...]:
        """All obstacle meshes: static, moving (before their motion), and rigid bodies (at the start)."""
        around = self.setup.surrounding
        return (*around.obstacles, *(moving.mesh for moving in around.moving), *(body.mesh for body in around.bodies))

    @property
    def moving_points(self) -> int:
        """Number of points on moving obstacles."""
        return sum(len(moving.mesh.nodes) for moving in self.setup.surrounding.moving)

    @property
    def integrator(self) -> Integrator:
        return load_integrator(self.setup.integrator)

    @cached_property
    def scene(self) -> Any:
        """Constant data for the kernels of the integrator."""
        return self.integrator.build(self.setup, self.time_step)


@dataclass(frozen=True)
class State:
    """State of a batch of cloths at one time."""

    positions: Tensor
    """[B, V, 3] node positions [m]."""
    velocities: Tensor
    """[B, V, 3] node velocities [m/s]."""
    bodies: BodyState | None = None
    """States of the rigid bodies; None: their initial states."""
