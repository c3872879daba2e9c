"""How far points can move along straight lines before a pair touches: additive continuous collision detection.

Li et al. 2021 (Codimensional IPC): advance by no more than the distance that is left, divided by the speed bound, until
the distance falls to a fixed part of what it was. No polynomial is solved, so nothing goes wrong for parallel edges, flat
motions or zero thickness, and the answer is always on the safe side.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
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


def safe_fraction(kind: Kind, start: Tensor, end: Tensor, distance: Tensor) -> Tensor:
    """The fraction of each pair's motion that keeps at least a tenth of its distance.

    Args:
        start, end: [C, 4, 3] positions [m].
        distance: [C] at the start, or a lower bound.

    Returns:
        [C] in (0, 1].
    """
    motion = end - start
    motion = motion - motion.mean(1, keepdim=True)
    speed = motion.norm(dim=-1)  # [C, 4]
    split = 1 if kind == "point_face" else 2
    bound = speed[:, :split].amax(1) + speed[:, split:].amax(1)
    fraction = torch.ones_like(distance)
    near = (bound > (1 - _LEFT) * distance).nonzero().flatten()
    if len(near):
        fraction[near] = _advance(lambda corners: pair_distance(kind, corners), start[near], motion[near], bound[near])
    return fraction


def _advance(measure: Callable[[Tensor], Tensor], start: Tensor, motion: Tensor, bound: Tensor) -> Tensor:
    first = measure(start)
    goal = 0.5 * _LEFT * first
    fraction = torch.zeros_like(first)
    ahead = (1 - _LEFT) * first / bound
    active = torch.arange(len(first), device=first.device)
    for _ in range(_ADVANCES):
        tried = fraction[active] + ahead[active]
        left = measure(start[active] + tried[:, None, None] * motion[active])
        over = tried >= 1
        fraction[active] = tried.clamp(max=1.0)
        # near the goal each advance would be shorter than the last: enough
        keep = ~(over | (left < _ENOUGH * goal[active]))
        ahead[active] = 0.9 * (left - goal[active]).clamp(min=0) / bound[active]
        active = active[keep]
        if not len(active):
            break
    return fraction
