"""Impact zones as they are defined: roots of a polynomial, a quadratic programme, and passes over all pairs."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray
from scipy.optimize import nnls

from diffcloud.sim.contact.surface import Surface
from tests.arcsim.twins.meeting import EDGES, Floats, meeting, on_both, spans, square
from tests.sim.twins.broad_phase import listed, may_touch

NEVER = np.inf
_NEARLY_REAL = 1e-9


def volume(kind: int, corners: Floats) -> float:
    """(a × b)·d: six times the volume that four points span [m³]."""
    a, b, d = spans(kind, corners)
    return float(np.cross(a, b) @ d)


def volume_over_time(kind: int, start: Floats, end: Floats) -> Polynomial:
    """The same while the points go straight from start to end in the time from 0 to 1."""
    vectors = zip(spans(kind, start), spans(kind, end - start), strict=True)
    (ax, ay, az), (bx, by, bz), (dx, dy, dz) = (
        [Polynomial(line) for line in zip(first, change, strict=True)] for first, change in vectors
    )
    return (ay * bz - az * by) * dx + (az * bx - ax * bz) * dy + (ax * by - ay * bx) * dz


def real_roots(polynomial: Polynomial) -> list[float]:
    """Ascending; those of the zero polynomial are left to whoever knows where it comes from."""
    trimmed = polynomial.trim(1e-14 * np.abs(polynomial.coef).max())
    roots = trimmed.roots()
    return sorted(refined(polynomial, root) for root in roots[np.abs(roots.imag) < _NEARLY_REAL].real)


def refined(polynomial: Polynomial, root: complex) -> Any:
    """The root by a few more of Newton's steps; with complex coefficients they carry a complex step along."""
    slope = polynomial.deriv()
    for _ in range(4):
        if slope(root) != 0:
            root = root - polynomial(root) / slope(root)
    return root


def impact_time(kind: int, start: Floats, end: Floats, smallest: float = 0.0) -> float:
    """When a pair first meets, or `NEVER`."""
    polynomial = volume_over_time(kind, start, end)
    for time in real_roots(polynomial):
        at = start + time * (end - start)
        area = square(kind, at)
        if 0 <= time <= 1 and area > 0 and area >= smallest and on_both(kind, meeting(kind, at)[0]):
            return float(time)
    return NEVER


@dataclass
class Impact:
    """A row of constraints: normal · Σ weights_k x_k >= thickness."""

    kind: int
    points: list[int]
    weights: Floats
    normal: Floats

    def row(self, count: int) -> Floats:
        """[3 N]"""
        found = np.zeros((count, 3))
        np.add.at(found, self.points, self.weights[:, None] * self.normal)
        return found.ravel()


def least_move(rows: Floats, target: Floats, inverse_mass: Floats) -> Floats:
    """[3 N] Δ of min ½ Σ m Δ² subject to rows Δ >= target: the best of all sets of rows that may hold with equality.

    With y = √m Δ the rows become rows/√m, and the smallest y with some rows equal is theirs by the pseudo-inverse.
    """
    scale = np.repeat(np.sqrt(inverse_mass), 3)
    scaled = rows * scale
    best, found = np.inf, np.full(rows.shape[1], np.nan)
    tolerance = 1e-9 * np.abs(target).max()
    for size in range(len(rows) + 1):
        for active in itertools.combinations(range(len(rows)), size):
            chosen = list(active)
            y = np.linalg.pinv(scaled[chosen], rcond=1e-10) @ target[chosen] if size else np.zeros(len(scale))
            if (scaled @ y >= target - tolerance).all() and y @ y < best - tolerance**2:
                best, found = y @ y, scale * y
    return found


def least_move_of_many(rows: Floats, target: Floats, inverse_mass: Floats) -> Floats:
    """The same by the least distance programming of Lawson and Hanson, for more rows than sets can be tried of."""
    scale = np.repeat(np.sqrt(inverse_mass), 3)
    # units of rows and of targets change the condition of the problem, not its solution
    unit = 1 / np.maximum(np.linalg.norm(rows * scale, axis=1), 1e-300)
    size = np.abs(target * unit).max()
    stacked = np.vstack([(rows * scale).T * unit, target * unit / size])
    wanted = np.append(np.zeros(rows.shape[1]), 1.0)
    force, _ = nnls(stacked, wanted, maxiter=100 * len(rows))
    residual = stacked @ force - wanted
    return np.asarray(-residual[:-1] / residual[-1] * scale * size)


def resolve(
    surface: Surface, start: Floats, candidate: Floats, inverse_mass: Floats, thickness: float, smallest: float = 0.0
) -> tuple[Floats, list[list[Impact]]]:
    """(places after the impacts of a step, the impacts that each pass has found)."""
    count = len(start)
    pairs = [
        (kind, [*one, *other])
        for kind, all_pairs in enumerate(listed(surface))
        for (_, one), (_, other) in all_pairs
        if may_touch(surface, one, other)
    ]
    places, known, passes = candidate, [], []
    while fresh := _impacts(pairs, start, places, inverse_mass, smallest):
        known = [*known, *fresh]
        passes.append(fresh)
        rows = np.array([impact.row(count) for impact in known])
        target = thickness - rows @ candidate.ravel()
        places = candidate + least_move_of_many(rows, target, inverse_mass).reshape(-1, 3)
    return places, passes


def _impacts(
    pairs: list[tuple[int, list[int]]], start: Floats, places: Floats, inverse_mass: Floats, smallest: float
) -> list[Impact]:
    """In the order of time, to a ten-thousandth of the step, each that shares no movable point with one before."""
    hits: list[tuple[int, int, list[int], float]] = []
    for kind, points in pairs:
        if _apart(kind, start[points], places[points]):
            continue
        time = impact_time(kind, start[points], places[points], smallest)
        if time != NEVER:
            hits.append((int(np.floor(time / 1e-4)), kind, points, time))
    found, taken = [], set[int]()
    for _, kind, points, time in sorted(hits, key=lambda hit: hit[0]):  # stable
        free = {point for point in points if inverse_mass[point] > 0}
        if not free or free & taken:
            continue
        taken |= free
        weights, normal = meeting(kind, start[points] + time * (places[points] - start[points]))
        approaches = normal @ (weights @ (places[points] - start[points])) <= 0
        found.append(Impact(kind, points, weights, normal if approaches else -normal))
    return found


def _apart(kind: int, start: Floats, end: Floats) -> bool:
    """Whether the boxes of both paths do not touch, so that roots need not be looked for."""
    split = 2 if kind == EDGES else 1
    one, other = (np.concatenate([start[part], end[part]]) for part in (slice(split), slice(split, None)))
    gap = np.maximum(one.min(axis=0) - other.max(axis=0), other.min(axis=0) - one.max(axis=0))
    return bool((gap > 1e-5).any())


def momentum(change: NDArray[np.float64], inverse_mass: Floats) -> Floats:
    """[3] Σ m Δx."""
    return np.asarray((change / inverse_mass[:, None]).sum(axis=0))
