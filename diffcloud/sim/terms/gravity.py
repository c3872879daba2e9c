"""Weight: f = m γ g on each node, with a multiplier γ on gravity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffcloud.sim.compiled.trace import Vector
from diffcloud.sim.terms.term import Element, Elements, Setup, Term


def force(node: Element) -> Sequence[Vector]:
    """m γ g."""
    return [(node.parameter("node_mass") * node.parameter("gravity")) * node.vector("acceleration")]


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
    parameters={"node_mass": "corner", "gravity": "episode"},
)
"""Constants: g [m/s²]."""
