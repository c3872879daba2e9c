"""Soft handles: springs that pull nodes to where a gripper wants them, f = k (x* - x₁).

k is the handles' stiffness times the strength of the step, x* the target of the step (`sim.handles`); both come with the
parameters, since targets are differentiable. Hard handles prescribe their nodes and are no force.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffcloud.sim.compiled.trace import Vector
from diffcloud.sim.terms.term import Element, Elements, Setup, Term


def force(handle: Element) -> Sequence[Vector]:
    """k (x* - x₁)"""
    end = handle.positions[0] + handle.ahead * handle.after[0]
    return [handle.parameter("hold") * (handle.vector_parameter("target") - end)]


def build(setup: Setup) -> Elements:
    """All handles; those that do not hold have no stiffness."""
    return Elements(np.array(setup.handles.nodes, dtype=np.int64).reshape(-1, 1))


TERM = Term("handles", corners=1, force=force, build=build, parameters={"hold": "element", "target": "vector"})
