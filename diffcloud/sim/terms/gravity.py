"""Weight: f = m g on each node. m excludes the added mass of the air."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffcloud.sim.compiled.trace import Vector
from diffcloud.sim.terms.term import Element, Elements, Setup, Term


def force(node: Element) -> Sequence[Vector]:
    """Weight m g [N]."""
    return [node.parameter("weight") * node.vector("acceleration")]


def build(setup: Setup) -> Elements:
    """Elements: all nodes."""
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
"""Constants: gravitational acceleration g [m/s²]."""
