"""The sums over all pairs that a fit's step needs, in a kernel. What they mean: `fit.matching`."""

from __future__ import annotations

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats


@kernel
def sum_terms(
    moved: Floats,
    partners: Floats,
    normals: Floats,
    spacing: Floats,
    weights: Floats,
    rates: Floats,
    cap: float,
    hidden: float,
    loss: Floats,
    slope: Floats,
    curvature: Floats,
) -> None:
    """Add up the loss [B], half of its slope [B, k] and of its curvature [B, k, k].

    Args:
        moved, partners, normals: [B, L, N, 3] places, recorded points, and normals of what is slid along.
        spacing: [L] between recorded points.
        weights: [B, L, N]
        rates: [k, B, L, N, 3] of the places.
        cap: largest distance that counts as itself.
        hidden: loss of a frame in which no place counts.
    """
    count = len(rates)
    along, beside = np.empty(count), np.empty(count)
    for b in range(moved.shape[0]):
        for f in range(moved.shape[1]):
            total = found = 0.0
            for i in range(moved.shape[2]):
                weight = weights[b, f, i]
                if weight == 0.0:
                    continue
                total += weight
                x = moved[b, f, i, 0] - partners[b, f, i, 0]
                y = moved[b, f, i, 1] - partners[b, f, i, 1]
                z = moved[b, f, i, 2] - partners[b, f, i, 2]
                squared = x * x + y * y + z * z
                if not squared < cap * cap:
                    found += weight * (cap * cap if squared == squared else squared)
                    continue
                found += weight * squared
                n0, n1, n2 = normals[b, f, i, 0], normals[b, f, i, 1], normals[b, f, i, 2]
                height = x * n0 + y * n1 + z * n2
                t0, t1, t2 = x - height * n0, y - height * n1, z - height * n2  # sqrt(w) t, once it is divided
                size = np.sqrt(t0 * t0 + t1 * t1 + t2 * t2 + spacing[f] * spacing[f])
                if size > 0.0:
                    t0, t1, t2 = t0 / size, t1 / size, t2 / size
                for j in range(count):
                    r0, r1, r2 = rates[j, b, f, i, 0], rates[j, b, f, i, 1], rates[j, b, f, i, 2]
                    slope[b, j] += weight * (r0 * x + r1 * y + r2 * z)
                    along[j], beside[j] = r0 * n0 + r1 * n1 + r2 * n2, r0 * t0 + r1 * t1 + r2 * t2
                    for k in range(j + 1):
                        curvature[b, j, k] += weight * (along[j] * along[k] + beside[j] * beside[k])
            loss[b] += found if total > 0.0 else hidden
        for j in range(count):
            for k in range(j):
                curvature[b, k, j] = curvature[b, j, k]


def compile_terms() -> None:
    """Compile what a fit's step needs."""
    points = np.zeros((1, 1, 1, 3))
    sums = np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1, 1))
    sum_terms(points, points, points, np.ones(1), np.ones((1, 1, 1)), points[None], 1.0, 1.0, *sums)
