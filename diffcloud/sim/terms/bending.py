"""Hinge bending (Bridson et al. 2003, Grinspun et al. 2003) with the measured table of Wang et al. 2011.

    energy per hinge = K θ²/2,   K = k_b l² / (4 (a0 + a1)),   k_b = min over both sides of the table

θ is the dihedral angle minus the rest angle. The rest angle is zero as in ARCSim, even for meshes that start curved. If
`shaped` is set, it is the initial angle. l is the edge length in material space, and a0 and a1 are the areas of the two
faces. The table is evaluated at the edge's direction in material space and at the signed curvature 0.05 θ l/(a0+a1).
Negative angles use the first column. The direction is constant, so each side has five precomputed numbers, and the look-up
is one-dimensional. Force and stiffness treat k_b as constant, as in `stretching`. The stiffness is K ∇θ ∇θᵀ, without the
second derivative of θ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from diffcloud.mesh.topology import ClothMesh
from diffcloud.sim.compiled.trace import (
    Scalar,
    Vector,
    absolute,
    arctangent,
    clamped,
    cross,
    dot,
    floor,
    held,
    larger,
    maximum,
    minimum,
    norm,
    squareroot,
    where,
)
from diffcloud.sim.terms.term import Element, Elements, Setup, Term

_SMALLEST_HEIGHT = 1e-3
"""Lower bound of the heights of a hinge's triangles, as a fraction of the edge length (as in ARCSim)."""
_CURVATURE_SCALE = 0.05
_TINY = 1e-30
_COLUMNS = 5


def force(hinge: Element) -> Sequence[Vector]:
    """Forces -K (θ + ∇θ · d) ∇θ on the two nodes of the edge and the two opposite nodes [N]."""
    start, _, first, second = hinge.positions
    edge, length, normals, angle = _bent(hinge)
    squared = length * length
    along = [dot(arm, edge) / squared for arm in (first - start, second - start)]
    tilts = []
    for normal in normals:  # unit normal over height; the height has a lower bound
        area = norm(normal)
        tilts.append(normal / (area * larger(area / length, _SMALLEST_HEIGHT * length)))
    gradient = [
        (along[0] - 1) * tilts[0] + (along[1] - 1) * tilts[1],
        -(along[0] * tilts[0] + along[1] * tilts[1]),
        *tilts,
    ]
    moved = angle
    for part, shift in zip(gradient, hinge.displacement, strict=True):
        moved = moved + dot(part, shift)
    stiffness = _table_value(hinge, angle) * hinge.constant("stiffness") * hinge.parameter("bending")
    return [(-stiffness * moved) * part for part in gradient]


def energy(hinge: Element) -> Scalar:
    """Energy K θ²/2 [J]."""
    angle = _bent(hinge)[3]
    stiffness = _table_value(hinge, angle) * hinge.constant("stiffness") * hinge.parameter("bending")
    return 0.5 * stiffness * angle * angle


def build(setup: Setup) -> Elements:
    """Elements: all hinges, with their table rows."""
    mesh, hinges = setup.mesh, setup.mesh.hinges
    area = mesh.face_area[hinges.faces].sum(axis=1)
    return Elements(
        nodes=hinges.nodes,
        constants={
            "stiffness": hinges.length**2 / (4 * area),
            "curvature": 2.5 * _CURVATURE_SCALE * hinges.length / area,
            "rest_angle": dihedral_angles(mesh) if setup.shaped else np.zeros(len(hinges.length)),
            "rows": _rows_at(setup.material.bending, hinges.angle),
        },
    )


TERM = Term(
    "bending",
    corners=4,
    force=force,
    energy=energy,
    build=build,
    constants={"stiffness": (), "curvature": (), "rest_angle": (), "rows": (2, _COLUMNS)},
    parameters={"bending": "element"},
)
"""Nodes: edge n0, n1, then the two opposite nodes. Constants: stiffness l² / (4 (a0 + a1)) [-], which times k_b [N·m] gives
K; table columns per radian; rest angle [rad]; table row at the direction of each side, k_b over the curvature columns
[N·m]."""


def dihedral_angles(mesh: ClothMesh) -> NDArray[np.float64]:
    """Dihedral angles [H] of the hinges in the initial shape [rad]."""
    corner = mesh.nodes[mesh.hinges.nodes]  # [H, 4, 3]
    edge = corner[:, 1] - corner[:, 0]
    first, second = np.cross(edge, corner[:, 2] - corner[:, 0]), np.cross(corner[:, 3] - corner[:, 0], edge)
    sine = -(edge * np.cross(first, second)).sum(-1) / np.linalg.norm(edge, axis=-1)
    return np.asarray(np.arctan2(sine, (first * second).sum(-1)))


def _bent(hinge: Element) -> tuple[Vector, Scalar, tuple[Vector, Vector], Scalar]:
    """Edge vector, its length, the normals on both sides, and θ wrapped to [-π, π]."""
    start, end, first, second = hinge.positions
    edge = end - start
    length = squareroot(maximum(dot(edge, edge), _TINY))
    normals = (cross(edge, first - start), cross(second - start, edge))
    angle = _dihedral(edge, length, *normals) - hinge.constant("rest_angle")
    return edge, length, normals, angle - held(2 * math.pi * floor(angle / (2 * math.pi) + 0.5))  # wrap to [-π, π]


def _dihedral(edge: Vector, length: Scalar, first: Vector, second: Vector) -> Scalar:
    """Angle between the two face normals at an edge [rad]. The normals can have any length."""
    sine, cosine = -dot(edge, cross(first, second)) / length, dot(first, second)
    # A hinge with a collapsed face gives atan2(0, 0), which has no derivative. It is treated as flat.
    return arctangent(sine, cosine + where(absolute(sine) + absolute(cosine) < _TINY, 1.0, 0.0))


def _table_value(hinge: Element, angle: Scalar) -> Scalar:
    """Table value k_b at an angle, the smaller one of both sides [N·m]."""
    column = clamped(hinge.constant("curvature") * angle - 0.5, 0.0, _COLUMNS - 1.0)
    low = held(where(floor(column) < _COLUMNS - 2.0, floor(column), _COLUMNS - 2.0))
    sides = []
    for side in (0, 1):
        left, right = (hinge.pick("rows", side, low + step) for step in (0.0, 1.0))
        sides.append(maximum(left + (right - left) * (column - low), 0.0))
    return minimum(*sides)


def _rows_at(bending: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Table rows [H, 2, 5] at edge directions [H, 2], interpolated from the table [3, 5]. As in ARCSim, rows are at
    half-pixel positions, reflected at -0.5 and 2.5, then clamped."""
    row = (6 * angle / np.pi) % 6.0  # reflection at -0.5 and 2.5 makes the direction periodic with π
    row = np.clip(np.where(row > 3.0, 6.0 - row, row) - 0.5, 0.0, 2.0)
    low = np.minimum(row.astype(int), 1)
    fraction = (row - low)[..., None]
    return bending[low] * (1 - fraction) + bending[low + 1] * fraction
