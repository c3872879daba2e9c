"""How far points can move along straight lines before a pair touches: additive continuous collision detection.

Li et al. 2021 (Codimensional IPC): advance by no more than the distance that is left, divided by the speed bound, until
the distance falls to a fixed part of what it was. No polynomial is solved, so nothing goes wrong for parallel edges, flat
motions or zero thickness, and the answer is always on the safe side.
"""

from __future__ import annotations

from torch import Tensor

from diffcloud.sim.contact.distance import edge_edge_weights, point_face_weights
from diffcloud.sim.contact.pairs import Kind

_LEFT = 0.2
"""Part of the starting distance that the first advance leaves; later ones may go down to half of that."""
_ENOUGH = 2.0
"""An advance stops when the distance is less than this many times its goal."""
_ADVANCES = 100
"""Stopping earlier is safe, only short."""


def pair_distance(kind: Kind, corners: Tensor) -> Tensor:
    """[C, 4, 3] -> [C] distance between the primitives of each pair [m]."""
    weights = (point_face_weights if kind == "point_face" else edge_edge_weights)(corners)
    return (weights[:, None] @ corners).squeeze(1).norm(dim=-1)


def safe_fraction(
    kind: Kind, entry: Tensor, start: Tensor, end: Tensor, distance: Tensor, limit: Tensor, floor: float = 0.0
) -> Tensor:
    """The fraction of the motion of each batch entry that keeps at least a tenth of every pair's distance.

    Args:
        entry: [C] of each pair.
        start, end: [C, 4, 3] positions [m].
        distance: [C] at the start, or a lower bound [m].
        limit: [B] fractions beyond which nobody asks.
        floor: pairs as close as this may not come closer at all: below, rounding could put them on the wrong side [m].

    Returns:
        [B] in [0, 1], at most `limit`.
    """
    motion = end - start
    motion = motion - motion.mean(1, keepdim=True)
    speed = motion.norm(dim=-1)  # [C, 4]
    split = 1 if kind == "point_face" else 2
    bound = speed[:, :split].amax(1) + speed[:, split:].amax(1)
    # a pair that moves so little that it cannot touch needs no look
    near = (bound * limit[entry] > (1 - _LEFT) * distance).nonzero().flatten()
    if not len(near):
        return limit
    entry, start, motion, bound = entry[near], start[near], motion[near], bound[near]
    first = pair_distance(kind, start)
    goal = (0.5 * _LEFT * first).clamp(min=floor)
    fraction = (0.9 * (first - goal) / bound.clamp(min=1e-300)).clamp(0.0, 1.0)
    active = (fraction < limit[entry]).nonzero().flatten()
    for _ in range(_ADVANCES):
        if not len(active):
            break
        left = pair_distance(kind, start[active] + fraction[active][:, None, None] * motion[active])
        # near the goal each advance would be shorter than the last: enough
        stopped = (left < _ENOUGH * goal[active]) & (left <= first[active])
        limit = limit.scatter_reduce(0, entry[active[stopped]], fraction[active[stopped]], "amin")
        active, left = active[~stopped], left[~stopped]
        fraction[active] += 0.9 * (left - goal[active]) / bound[active]
        active = active[fraction[active] < limit[entry[active]]]
    return limit.scatter_reduce(0, entry[active], fraction[active], "amin")
