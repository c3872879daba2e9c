"""Soft handles: springs f = k (x* - x₁) that pull nodes to their gripper's target.

k is the handles' stiffness times the strength of the step. x* is the target of the step (`sim.handles`), and x₁ the node's
position at its end. k and x* are passed as parameters, since targets are differentiable. Hard handles prescribe the
positions of their nodes, so they are not a force.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffcloud.sim.compiled.trace import Vector
from diffcloud.sim.terms.term import Element, Elements, Setup, Term


def force(handle: Element) -> Sequence[Vector]:
    """Spring force k (x* - x₁) [N]."""
    end = handle.positions[0] + handle.ahead * handle.after[0]
    return [handle.parameter("hold") * (handle.vector_parameter("target") - end)]


def build(setup: Setup) -> Elements:
    """Elements: all handles. Inactive handles have zero stiffness."""
    return Elements(np.array(setup.handles.nodes, dtype=np.int64).reshape(-1, 1))


TERM = Term("handles", corners=1, force=force, build=build, parameters={"hold": "element", "target": "vector"})
