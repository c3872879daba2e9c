"""Short simulations that call every kernel, to compile them ahead of time (`diffcloud doctor --compile`)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from diffcloud.mesh.shapes import grid_cloth, rectangle_surface
from diffcloud.sim.build import build_system
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.integrators import load_integrator
from diffcloud.sim.materials import isotropic
from diffcloud.sim.properties import Properties
from diffcloud.sim.simulate import rollout, rollout_tangents
from diffcloud.sim.surrounding import Surrounding


def implicit() -> None:
    """Compile the kernels of the implicit integrator."""
    _episode("implicit")


def arcsim() -> None:
    """Compile the kernels of the arcsim integrator."""
    _episode("arcsim")


def _episode(name: str) -> None:
    mesh = grid_cloth(3, 3, 0.1, 0.1)
    mesh = replace(mesh, nodes=np.add(mesh.nodes, (0.0, 0.0, 0.002)))
    table = rectangle_surface((0.0, 0.0), (1.0, 1.0), 0.0)
    system = build_system(
        mesh,
        isotropic("any", density=0.2, stretching=50.0, bending=1e-5),
        time_step=0.01,
        handles=Handles((Handle(0),)),
        surrounding=load_integrator(name).with_contact(Surrounding(obstacles=(table,))),
        integrator=name,
    )
    given = system.properties
    rollout(
        system, 2, properties=Properties(*(one.clone().requires_grad_() for one in given.tensors()))
    ).positions.sum().backward()
    with torch.no_grad():
        rollout_tangents(system, 1, properties=given, tangents=given)
