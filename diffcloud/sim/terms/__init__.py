"""The forces of a step, one file each; `term.py` says what a force is, `compiled.module` what is generated from it.

A new force is a file here and a line in `TERMS`.
"""

from importlib import import_module

from diffcloud.arcsim.contact.frames import EDGE_EDGE_MEETING, POINT_FACE_MEETING
from diffcloud.arcsim.contact.proximity import PROXIMITY_EDGE_EDGE, PROXIMITY_POINT_FACE
from diffcloud.sim.compiled.module import terms_module
from diffcloud.sim.contact.barrier import (
    BARRIER_EDGE_EDGE,
    BARRIER_PLANE,
    BARRIER_POINT_EDGE,
    BARRIER_POINT_FACE,
    BARRIER_POINT_POINT,
)
from diffcloud.sim.rigid.spin import SPIN
from diffcloud.sim.terms.term import Term

TERMS: tuple[Term, ...] = tuple(
    import_module(f"{__name__}.{file}").TERM
    for file in (
        "gravity",
        "stretching",
        "wrinkling",
        "bending",
        "air",
        "handles",
        "planes",
    )
)
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
