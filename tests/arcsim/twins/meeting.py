"""Where two primitives meet: the common normal and the places on it, from one linear system each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
EDGES = 1
"""The kind of a pair of two edges; a point and a face have 0."""


def spans(kind: int, corners: Floats) -> tuple[Floats, Floats, Floats]:
    """Two vectors along a pair's primitives and one between them, of corners [4, 3]."""
    if kind == EDGES:
        return corners[1] - corners[0], corners[3] - corners[2], corners[2] - corners[0]
    return corners[2] - corners[1], corners[3] - corners[1], corners[0] - corners[1]


def square(kind: int, corners: Floats) -> float:
    """|a × b|² [m⁴]"""
    a, b, _ = spans(kind, corners)
    return float((np.cross(a, b) ** 2).sum())


def meeting(kind: int, corners: Floats) -> tuple[Floats, Floats]:
    """(weights [4], unit normal [3]) with Σ w_k x_k = h n: one place on each primitive, joined by the normal."""
    a, b, d = spans(kind, corners)
    normal = np.cross(a, b)
    normal = normal / np.sqrt(normal @ normal)  # not the norm, which has no complex step
    if kind == EDGES:  # p0 + α a = q0 + β b + h n
        alpha, beta, _ = np.linalg.solve(np.stack([a, -b, -normal], axis=1), d)
        return np.array([1 - alpha, alpha, beta - 1, -beta]), normal
    alpha, beta, _ = np.linalg.solve(np.stack([a, b, normal], axis=1), d)  # x = y0 + α a + β b + h n
    return np.array([1, alpha + beta - 1, -alpha, -beta]), normal


def on_both(kind: int, weights: Floats, tolerance: float = 1e-6) -> bool:
    """Whether the places lie on both primitives, or this far outside."""
    signs = np.array([1, 1, -1, -1] if kind == EDGES else [1, -1, -1, -1])
    return bool((signs * weights >= -tolerance).all())
