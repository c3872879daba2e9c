"""Continuous detection: when and where linearly moving primitives first meet (Provot 1997; Bridson et al. 2002).

Four points are coplanar where a cubic in the time vanishes; a static partner makes it quadratic or linear. The roots are
bracketed between the cubic's critical points, where it is monotone, and found by Newton's method kept inside the bracket.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffcloud.sim.contact.frames import MeetingPairs, along

_ITERATIONS = 80
_TIME = 1e-15
_COPLANAR = 1e-6
"""[m] Distance at a root above which the root is an artefact of rounding."""
_OUTSIDE = 1e-6
"""Weights this far outside of a primitive still count as on it."""


def coplanarity(pairs: MeetingPairs, corners: Tensor) -> Tensor:
    """[C] (a × b)·d: six times the volume the four points span [m³]."""
    a, b, d = pairs.spans(corners)
    return (torch.linalg.cross(a, b) * d).sum(-1)


def coplanarity_cubic(pairs: MeetingPairs, start: Tensor, end: Tensor) -> Tensor:
    """[C, 4] coefficients (constant first) of the coplanarity over the time in [0, 1]."""
    a, b, d = pairs.spans(start)
    da, db, dd = pairs.spans(end - start)
    still, turning = torch.linalg.cross(a, b), torch.linalg.cross(da, db)
    mixed = torch.linalg.cross(a, db) + torch.linalg.cross(da, b)
    zero = torch.zeros_like(d)
    left = torch.stack([still, mixed, turning, zero], 1)
    right = torch.stack([zero, still, mixed, turning], 1)
    return (left @ d[..., None] + right @ dd[..., None]).squeeze(-1)


def unit_roots(cubic: Tensor) -> Tensor:
    """Real roots of cubics (or quadratics, or lines) between 0 and 1.

    Args:
        cubic: [C, 4] coefficients, constant first.

    Returns:
        [C, 3] ascending, infinite where there is none.
    """
    c0, c1, c2, c3 = cubic.unbind(-1)
    # critical points 3 c3 t² + 2 c2 t + c1 = 0 in the form without cancellation; those outside fall on 0 or 1
    root = (c2 * c2 - 3 * c3 * c1).clamp(min=0).sqrt()
    q = -(c2 + torch.where(c2 < 0, -root, root))
    critical = torch.stack([q / (3 * c3), c1 / q], dim=-1).nan_to_num(0.0, 1.0, 0.0).clamp(0, 1)
    zero = torch.zeros_like(c0)[:, None]
    knots = torch.cat([zero, critical.sort(-1).values, zero + 1], dim=-1)  # [C, 4]
    values = ((c3[:, None] * knots + c2[:, None]) * knots + c1[:, None]) * knots + c0[:, None]
    low, high = knots[:, :-1], knots[:, 1:]
    at_low, at_high = values[:, :-1], values[:, 1:]
    crossing = (at_low.sign() * at_high.sign() <= 0) & ((high > low) | (at_low == 0))
    roots = torch.full_like(low, torch.inf)
    place = crossing.nonzero(as_tuple=True)
    if len(place[0]):
        roots[place] = _bracketed_root(cubic[place[0]], low[place], high[place], at_low[place], at_high[place])
    return roots.sort(-1).values


def _bracketed_root(cubic: Tensor, low: Tensor, high: Tensor, at_low: Tensor, at_high: Tensor) -> Tensor:
    """[K] the root in each bracket, where the cubic is monotone."""
    c0, c1, c2, c3 = cubic.unbind(-1)
    rising = at_high > at_low
    change = at_high - at_low
    time = torch.where(change == 0, low, low - at_low * (high - low) / torch.where(change == 0, 1.0, change))
    for _ in range(_ITERATIONS):
        value = ((c3 * time + c2) * time + c1) * time + c0
        above = (value > 0) == rising
        high = torch.where(above | (value == 0), time, high)
        low = torch.where(above & (value != 0), low, time)
        step = value / ((3 * c3 * time + 2 * c2) * time + c1)
        newton = time - step
        inside = (newton >= low) & (newton <= high)  # false for NaN
        following = torch.where(inside, newton, 0.5 * (low + high))
        done = bool(((following - time).abs() <= _TIME).all())
        time = following
        if done:
            break
    return time


def first_impacts(pairs: MeetingPairs, start: Tensor, end: Tensor, smallest: float) -> tuple[Tensor, Tensor]:
    """The first time at which each pair meets during a linear motion.

    Args:
        start, end: [C, 4, 3] corners.
        smallest: [m⁴] pairs with |a × b|² below never meet.

    Returns:
        (index [K] of the pairs that meet, time [K] in [0, 1]).
    """
    roots = unit_roots(coplanarity_cubic(pairs, start, end))
    pair, order = torch.isfinite(roots).nonzero(as_tuple=True)  # ascending in time within a pair
    time = roots[pair, order]
    at = start[pair] + time[:, None, None] * (end - start)[pair]
    chosen = pairs.where(pair)
    frames = chosen.frames(at)
    meet = (frames.square > 0) & (frames.square >= smallest)
    meet &= (frames.normals * along(frames.weights, at)).sum(-1).abs() <= _COPLANAR
    meet &= chosen.covers(frames.weights, _OUTSIDE)
    pair, time = pair[meet], time[meet]
    first = torch.ones_like(pair, dtype=torch.bool)
    first[1:] = pair[1:] != pair[:-1]
    return pair[first], time[first]


def meeting_time(pairs: MeetingPairs, time: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """The impact times [C], differentiable in start and end by the implicit function theorem."""
    corners = start + time[:, None, None] * (end - start)
    a, b, d = pairs.spans(corners.detach())
    da, db, dd = pairs.spans((end - start).detach())
    rate = (torch.linalg.cross(a, b) * dd).sum(-1)
    rate = rate + ((torch.linalg.cross(da, b) + torch.linalg.cross(a, db)) * d).sum(-1)
    volume = coplanarity(pairs, corners)
    # a grazing pair has no derivative of its time: call it constant
    size = corners.detach().diff(dim=1).abs().amax((1, 2)) ** 3
    slope = torch.where(rate.abs() > 1e-9 * size, rate, torch.inf)
    return time - (volume - volume.detach()) / slope
