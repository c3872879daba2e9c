"""What is constant in a run (`System`), how it is built, and what changes with each step (`State`)."""

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
    """Everything constant in a run."""

    setup: Setup
    time_step: float
    """[s]"""
    properties: Properties
    """Of the nominal material, batch 1."""

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
        """Meshes: static, moving (before their motion), and rigid bodies (at the start)."""
        around = self.setup.surrounding
        return (*around.obstacles, *(moving.mesh for moving in around.moving), *(body.mesh for body in around.bodies))

    @property
    def moving_points(self) -> int:
        """Of the obstacles that follow a motion."""
        return sum(len(moving.mesh.nodes) for moving in self.setup.surrounding.moving)

    @property
    def integrator(self) -> Integrator:
        return load_integrator(self.setup.integrator)

    @cached_property
    def scene(self) -> Any:
        """What the kernels of the integrator are given."""
        return self.integrator.build(self.setup, self.time_step)


@dataclass(frozen=True)
class State:
    """A batch of cloths at one time."""

    positions: Tensor
    """[B, V, 3] [m]"""
    velocities: Tensor
    """[B, V, 3] [m/s]"""
    bodies: BodyState | None = None
    """Of the rigid bodies; None: where they start."""
