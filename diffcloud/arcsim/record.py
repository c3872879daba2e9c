"""Record of an episode of ARCSim's steps, for its derivatives."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from diffcloud.arcsim.contact.impact_zones import Impacts, no_impacts
from diffcloud.compiled import kernel
from diffcloud.sim.compiled.copying import copy_to
from diffcloud.sim.compiled.data import Floats, Ints
from diffcloud.sim.compiled.pool import with_room


class Kept(NamedTuple):
    """Data of each step that the derivatives need."""

    solved: Floats
    """[S, V, 3] velocities after the linear system, before contact [m/s]."""
    begins: Ints
    """[S + 1, 5] first row of each step in `corners`, `impacts.met`, `impacts.passes`, `impacts.forces` and `factors`. A
    step without rows in `factors` has its factor recomputed."""
    corners: Ints
    """[., 5] kind and points of the repelling pairs."""
    constants: Floats
    """[., 4] sign, count, stiffness, and 1 if an obstacle takes part."""
    impacts: Impacts
    factors: Floats
    """[., 9] blocks of the matrix factors."""


@kernel
def nothing_kept(steps: int, nodes: int) -> Kept:
    """Create an empty record."""
    corners, constants, factors = np.empty((16, 5), np.int64), np.empty((16, 4)), np.empty((16, 9))
    begins = np.zeros((steps + 1, 5), np.int64)
    return Kept(np.empty((steps, nodes, 3)), begins, corners, constants, no_impacts(), factors)


@kernel
def remember(kept: Kept, step: int, solved: Floats, corners: Ints, constants: Floats, factor: Floats, limit: int) -> Kept:
    """Append a step to the record, except for its impacts."""
    copy_to(kept.solved[step], solved)
    begins = kept.begins
    pairs, rows = begins[step, 0], begins[step, 4]
    more = with_room(kept.corners, pairs, len(corners))
    numbers = with_room(kept.constants, pairs, len(corners))
    copy_to(more[pairs : pairs + len(corners)], corners)
    copy_to(numbers[pairs : pairs + len(corners)], constants)
    begins[step + 1, 0] = pairs + len(corners)
    factors = kept.factors
    if rows + len(factor) <= limit:
        factors = with_room(factors, rows, len(factor))
        copy_to(factors[rows : rows + len(factor)], factor)
        begins[step + 1, 4] = rows + len(factor)
    else:
        begins[step + 1, 4] = rows
    return Kept(kept.solved, begins, more, numbers, kept.impacts, factors)


@kernel
def with_impacts(kept: Kept, impacts: Impacts, step: int, keep: int) -> Kept:
    """Add the impacts of a step to the record. If derivatives are not needed, their memory is reused."""
    if keep >= 0:
        for k in range(3):
            kept.begins[step + 1, 1 + k] = impacts.used[k]
    else:
        for k in range(3):
            impacts.used[k] = 0
    return Kept(kept.solved, kept.begins, kept.corners, kept.constants, impacts, kept.factors)
