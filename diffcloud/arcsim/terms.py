"""The forces of ARCSim's step, and the kernels that are generated from them (`sim.compiled.module`)."""

from diffcloud.arcsim.contact.frames import EDGE_EDGE_MEETING, POINT_FACE_MEETING
from diffcloud.arcsim.contact.planes import PLANES
from diffcloud.arcsim.contact.proximity import PROXIMITY_EDGE_EDGE, PROXIMITY_POINT_FACE
from diffcloud.sim.compiled.module import integrator_kernels
from diffcloud.sim.terms import TERMS as SHARED
from diffcloud.sim.terms.term import Term

TERMS = (*SHARED, PLANES)
"""Forces between nodes that are known before the motion."""
CONTACTS: tuple[Term, ...] = (PROXIMITY_POINT_FACE, PROXIMITY_EDGE_EDGE)
"""Forces between points that each step finds."""

kernels = integrator_kernels("arcsim", SHARED, (PLANES,), CONTACTS, (POINT_FACE_MEETING, EDGE_EDGE_MEETING))
"""`kernels.assemble`, `kernels.Terms`, `kernels.bending_force`, ..."""
