"""The forces of a step, one file each; `term.py` says what a force is.

A new force is a file here and its name in `TERMS`.
"""

from diffcloud.sim.compiled.module import terms_module
from diffcloud.sim.contact.barrier import (
    BARRIER_EDGE_EDGE,
    BARRIER_PLANE,
    BARRIER_POINT_EDGE,
    BARRIER_POINT_FACE,
    BARRIER_POINT_POINT,
)
from diffcloud.sim.reference.frames import EDGE_EDGE_MEETING, POINT_FACE_MEETING
from diffcloud.sim.reference.proximity import PROXIMITY_EDGE_EDGE, PROXIMITY_POINT_FACE
from diffcloud.sim.rigid.spin import SPIN
from diffcloud.sim.terms.air import AIR
from diffcloud.sim.terms.bending import BENDING
from diffcloud.sim.terms.gravity import GRAVITY
from diffcloud.sim.terms.handles import HANDLES
from diffcloud.sim.terms.planes import PLANES
from diffcloud.sim.terms.stretching import STRETCHING

TERMS = (GRAVITY, STRETCHING, BENDING, AIR, HANDLES, PLANES)
"""Forces between nodes that are known before the motion. Both steps go through this list."""
CONTACTS = (
    PROXIMITY_POINT_FACE,
    PROXIMITY_EDGE_EDGE,
    BARRIER_POINT_POINT,
    BARRIER_POINT_EDGE,
    BARRIER_POINT_FACE,
    BARRIER_EDGE_EDGE,
    BARRIER_PLANE,
)
"""Forces between points that each step finds."""
FUNCTIONS = (POINT_FACE_MEETING, EDGE_EDGE_MEETING, SPIN)

kernels = terms_module(TERMS, CONTACTS, FUNCTIONS)
"""Everything that is generated from them: `kernels.assemble`, `kernels.Terms`, `kernels.bending_force`, ..."""
