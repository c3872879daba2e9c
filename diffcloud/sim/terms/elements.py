"""Collects the elements of all force terms of a system for the kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from diffcloud.errors import SceneError, unknown_name
from diffcloud.sim.compiled.sparse import Pattern, pattern, slots
from diffcloud.sim.terms.term import Elements, Setup, Term


def elements(setup: Setup, terms: Sequence[Term], kernels: Any, bodies: int = 0) -> tuple[Any, Pattern]:
    """Build the elements of all terms, and the sparsity pattern of the step's matrix.

    The rows of the matrix are the cloth nodes, followed by the centre and the rotation of each body.

    Args:
        terms, kernels: force terms of an integrator, and the kernels generated from them.
        bodies: number of rigid bodies.

    Returns:
        The elements as `kernels.Terms`, and the pattern.

    Raises:
        SceneError: the surroundings have settings for an unknown force.
    """
    names = [term.name for term in terms]
    for name in setup.surrounding.forces:
        if name not in names:
            raise SceneError(unknown_name("force", name, names))
    found = [term.build(setup) or _none(term) for term in terms]
    groups = [np.ascontiguousarray(one.nodes, dtype=np.int64) for one in found]
    count = len(setup.mesh.nodes)
    of_bodies = count + np.arange(2 * bodies, dtype=np.int64).reshape(-1, 2)
    of = pattern(count + 2 * bodies, [*groups, of_bodies])
    parts = []
    for term, one, group in zip(terms, found, groups, strict=True):
        numbers = [*(one.constants[name] for name in term.constants), *(one.tables[name] for name in term.tables)]
        arrays = [np.ascontiguousarray(array, dtype=np.float64) for array in numbers]
        parts.append(getattr(kernels, term.class_name)(group, slots(of, group), *arrays))
    return kernels.Terms(*parts), of


def _none(term: Term) -> Elements:
    """Empty elements, for a term that does not act in this scene."""
    return Elements(
        np.zeros((0, term.corners), np.int64),
        {name: np.zeros((0, *shape)) for name, shape in term.constants.items()},
        {name: np.zeros((0,) * axes) for name, axes in term.tables.items()},
    )
