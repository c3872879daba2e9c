"""Contact of ARCSim's step with half-spaces n · x >= offset: repulsion and lagged Coulomb friction.

Repulsion has the thickness τ, the violation c = max(τ + offset - n · x, 0), and the energy K c³/(6 τ). K is k_c times the
node's material area. The force is K c²/(2 τ) along n, and the stiffness K c/τ.

Friction uses the normal force f_n and sliding direction at the start of the step (lagged). With γ = min(μ f_n / |v_t|,
m / Δt), the force is -γ P v with P = I - n nᵀ, implicit in v. The second branch is sticking: it halves the sliding velocity
in each step. So a node on an incline of angle α creeps at g sin(α) Δt, which vanishes with the step.

Projection (`step.project`): a node whose candidate position is behind the plane is moved to the projection thickness above
it. For a single static plane this is the exact solution of the impact-zone problem (nodes do not couple), and inelastic.

Not reproduced from ARCSim: the doubled constraint of the node nearest to each obstacle face, contacts of cloth edges with
the obstacle's edges, and the plane's finite extent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from diffcloud.mesh.topology import ClothMesh
from diffcloud.sim.compiled.trace import Vector, dot, larger, maximum, norm
from diffcloud.sim.contact.half_spaces import half_spaces
from diffcloud.sim.surrounding import Surrounding
from diffcloud.sim.terms.term import Element, Elements, Setup, Term

_TINY = 1e-12


def force(node: Element) -> Sequence[Vector]:
    """Repulsion, to first order in the motion of the step, and friction with the velocity at the end of the step [N]."""
    normal, thickness = node.vector("normal"), node.constant("thickness")
    violation = maximum(thickness + node.constant("offset") - dot(node.positions[0], normal), 0.0)
    stiffness = violation * (node.constant("stiffness") / thickness)
    pushing = 0.5 * stiffness * violation
    limit = node.parameter("friction") * pushing
    before, after = node.before[0], node.after[0]
    speed = norm(before - dot(before, normal) * normal)
    sticking = limit * node.time_step / node.parameter("node_mass") + _TINY
    gamma = limit / larger(speed, sticking)
    along = pushing - stiffness * dot(node.ahead * after, normal) + gamma * dot(after, normal)
    return [along * normal - gamma * after]


def build(setup: Setup) -> Elements | None:
    """Elements: every node with every plane."""
    if not setup.surrounding.proximity:
        return None
    normals, offsets = stopping_planes(setup.mesh, setup.surrounding)
    nodes = np.tile(np.arange(len(setup.mesh.nodes)), len(normals))
    contact = setup.surrounding.contact
    return Elements(
        nodes[:, None],
        {
            "normal": np.repeat(normals, len(setup.mesh.nodes), axis=0),
            "offset": np.repeat(offsets, len(setup.mesh.nodes)),
            "stiffness": contact.stiffness * setup.mesh.node_area[nodes],
            "thickness": np.full(len(nodes), contact.repulsion_thickness),
        },
    )


PLANES = Term(
    "planes",
    corners=1,
    force=force,
    build=build,
    constants={"normal": (3,), "offset": (), "stiffness": (), "thickness": ()},
    parameters={"node_mass": "corner", "friction": "episode"},
)
"""Constants: unit normal towards the cloth; offset [m]; k_c times the node's area [N/m]; τ [m]."""


def stopping_planes(mesh: ClothMesh, surrounding: Surrounding) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The half-spaces that stop nodes (`half_spaces`); none if contact with meshes already includes them."""
    if surrounding.reference_contact is not None:
        surrounding = replace(surrounding, obstacles=())
    return half_spaces(mesh, surrounding)
