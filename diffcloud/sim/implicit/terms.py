"""Force terms of the implicit integrator, and the kernels generated from them (`sim.compiled.module`)."""

from diffcloud.sim.compiled.module import integrator_kernels
from diffcloud.sim.contact.barrier import (
    BARRIER_EDGE_EDGE,
    BARRIER_PLANE,
    BARRIER_POINT_EDGE,
    BARRIER_POINT_FACE,
    BARRIER_POINT_POINT,
)
from diffcloud.sim.rigid.spin import SPIN
from diffcloud.sim.terms import TERMS
from diffcloud.sim.terms.term import Term

CONTACTS: tuple[Term, ...] = (
    BARRIER_POINT_POINT,
    BARRIER_POINT_EDGE,
    BARRIER_POINT_FACE,
    BARRIER_EDGE_EDGE,
    BARRIER_PLANE,
)
"""Contact terms, whose point pairs each step detects."""

kernels = integrator_kernels("implicit", TERMS, (), CONTACTS, (SPIN,))
"""Module of the generated kernels, such as `kernels.jacobian`, `kernels.Terms` and `kernels.bending_force`."""
