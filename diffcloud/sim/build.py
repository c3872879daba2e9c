"""Builds a `System` from a cloth mesh, a material and its surroundings."""

from __future__ import annotations

import numpy as np
import torch

from diffcloud.errors import SceneError
from diffcloud.mesh.topology import ClothMesh
from diffcloud.sim.grasp import stretching_factors
from diffcloud.sim.handles import Handles
from diffcloud.sim.integrators import load_integrator
from diffcloud.sim.materials import Material
from diffcloud.sim.properties import Properties, one_set
from diffcloud.sim.rigid.bodies import Bodies
from diffcloud.sim.surrounding import Order, Surrounding
from diffcloud.sim.system import System
from diffcloud.sim.terms.term import Setup


def build_system(
    mesh: ClothMesh,
    material: Material,
    *,
    time_step: float,
    handles: Handles,
    surrounding: Surrounding | None = None,
    mass_material: Material | None = None,
    integrator: str,
    order: Order = 2,
    shaped: bool = False,
) -> System:
    """Build a `System`.

    Args:
        time_step: [s].
        mass_material: its density gives the node masses; default `material`. The published experiments compute the masses
            from one material and the forces from another.
        integrator: a key of `integrators.INTEGRATORS`. "implicit" has smooth contact and rigid bodies, and iterates each
            step to convergence. "arcsim" reproduces ARCSim.
        order: of the implicit integrator: 2 for BDF2, 1 for backward Euler. Scenes with rigid bodies always use 1.
        shaped: use the angles of the given mesh as rest angles of the hinges. Otherwise the cloth is flat at rest.

    Raises:
        SceneError: the time step is not positive, a handle's node does not exist, the integrator is unknown, or it cannot
            simulate the surroundings.
    """
    surrounding = surrounding or Surrounding()
    if not time_step > 0:
        raise SceneError(f"The time step must be positive, got {time_step} s.")
    load_integrator(integrator).check(surrounding)
    for node in handles.nodes:
        if not 0 <= node < len(mesh.nodes):
            raise SceneError(f"A handle holds node {node}, but the cloth has nodes 0..{len(mesh.nodes) - 1}.")
    bodies = Bodies.build(surrounding.bodies)
    density = (mass_material or material).density
    properties = Properties(
        node_mass=torch.as_tensor((density + surrounding.added_mass) * mesh.node_area, dtype=torch.float64)[None],
        weight=torch.as_tensor(density * mesh.node_area, dtype=torch.float64)[None],
        stretching=torch.as_tensor(stretching_factors(mesh, handles.nodes, handles.grasp))[None],
        bending=torch.ones(1, len(mesh.hinges.length), dtype=torch.float64),
        body_mass=torch.as_tensor(np.asarray(bodies.mass, dtype=np.float64))[None],
        **one_set(
            {
                "shear": 1.0,
                "compression": material.compression,
                "damping": material.damping,
                "air_density": surrounding.air_density,
                "air_drag": surrounding.air_drag,
                "linear_drag": surrounding.linear_drag,
                "friction": surrounding.friction,
                "self_friction": surrounding.self_friction,
            }
        ),
    )
    return System(Setup(mesh, material, surrounding, handles, bodies, integrator, order, shaped), time_step, properties)
