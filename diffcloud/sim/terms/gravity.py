"""Weight: f = m g on each node. The air that moves with a cloth adds to its inertia, and not to m."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffcloud.sim.compiled.trace import Vector
from diffcloud.sim.terms.term import Element, Elements, Setup, Term


def force(node: Element) -> Sequence[Vector]:
    """m g."""
    return [node.parameter("weight") * node.vector("acceleration")]


def build(setup: Setup) -> Elements:
    """All nodes."""
    nodes = np.arange(len(setup.mesh.nodes))[:, None]
    return Elements(
        nodes, {"acceleration": np.tile(np.array(setup.surrounding.gravity, dtype=np.float64), (len(nodes), 1))}
    )


TERM = Term(
    "gravity",
    corners=1,
    force=force,
    build=build,
    constants={"acceleration": (3,)},
    parameters={"weight": "corner"},
)
"""Constants: g [m/s²]."""
