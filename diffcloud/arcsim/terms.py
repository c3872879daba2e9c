"""Force terms of ARCSim's step, and the kernels generated from them (`sim.compiled.module`)."""

from diffcloud.arcsim.contact.frames import EDGE_EDGE_MEETING, POINT_FACE_MEETING
from diffcloud.arcsim.contact.planes import PLANES
from diffcloud.arcsim.contact.proximity import PROXIMITY_EDGE_EDGE, PROXIMITY_POINT_FACE
from diffcloud.sim.compiled.module import integrator_kernels
from diffcloud.sim.terms import TERMS as SHARED
from diffcloud.sim.terms.term import Term

TERMS = (*SHARED, PLANES)
"""Force terms whose elements are fixed before the simulation."""
CONTACTS: tuple[Term, ...] = (PROXIMITY_POINT_FACE, PROXIMITY_EDGE_EDGE)
"""Contact terms, whose point pairs each step detects."""

kernels = integrator_kernels("arcsim", SHARED, (PLANES,), CONTACTS, (POINT_FACE_MEETING, EDGE_EDGE_MEETING))
"""Module of the generated kernels, such as `kernels.assemble`, `kernels.Terms` and `kernels.bending_force`."""
