"""From a cloth mesh, a material and a surrounding to a System."""

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
    """Assemble a System.

    Args:
        time_step: [s].
        mass_material: material whose density gives the node masses, where it differs from `material` (the published
            experiments reload their tables after the masses were computed).
        integrator: a key of `integrators.INTEGRATORS`. "implicit" is the converged step with smooth contact and rigid
            bodies, "arcsim" is ARCSim's.
        order: of the implicit integrator: 2 for BDF2, 1 for backward Euler, which scenes with rigid bodies always have.
        shaped: whether the cloth's hinges are at rest as the mesh stands, not flat.

    Raises:
        SceneError: a time step that is not positive, a handle on a node that does not exist, no such integrator, or a
            surrounding that it cannot simulate.
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
