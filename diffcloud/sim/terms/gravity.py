"""Weight: f = m g on each node."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffcloud.sim.compiled.trace import Vector
from diffcloud.sim.terms.term import Element, Elements, Setup, Term


def force(node: Element) -> Sequence[Vector]:
    """m g."""
    return [node.parameter("node_mass") * node.vector("gravity")]


def build(setup: Setup) -> Elements:
    """All nodes."""
    nodes = np.arange(len(setup.mesh.nodes))[:, None]
    return Elements(nodes, {"gravity": np.tile(np.array(setup.surrounding.gravity, dtype=np.float64), (len(nodes), 1))})


TERM = Term("gravity", corners=1, force=force, build=build, constants={"gravity": (3,)}, parameters={"node_mass": "corner"})
"""Constants: g [m/s²]."""
