"""Hinge bending (Bridson et al. 2003, Grinspun et al. 2003) with the measured table of Wang et al. 2011.

    energy per hinge = K θ²/2,   K = k_b l² / (4 (a0 + a1)),   k_b = min over both sides of the table

θ is the dihedral angle less its rest angle: zero everywhere, as in ARCSim, also for meshes that start curved; or the angle
at the start, for what keeps its shape (`shaped`). l is the material-space length of the edge. The table is looked up
at the edge's direction in material space, which is constant, and at the curvature 0.05 θ l/(a0+a1), signed: negative
angles take the first column. So each side is reduced to five numbers beforehand, and the look-up is one-dimensional. As
with stretching, k_b counts as constant in force and stiffness, and the stiffness is K ∇θ ∇θᵀ (no second derivative of θ).
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
"""Heights of a hinge's triangles are kept above this part of the edge (ARCSim)."""
_CURVATURE_SCALE = 0.05
_TINY = 1e-30
_COLUMNS = 5


def force(hinge: Element) -> Sequence[Vector]:
    """-K (θ + ∇θ · d) ∇θ on the nodes of the edge and the two opposite ones."""
    start, _, first, second = hinge.positions
    edge, length, normals, angle = _bent(hinge)
    squared = length * length
    along = [dot(arm, edge) / squared for arm in (first - start, second - start)]
    tilts = []
    for normal in normals:  # unit normal over height, with the height kept above a part of the edge
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
    """K θ²/2"""
    angle = _bent(hinge)[3]
    stiffness = _table_value(hinge, angle) * hinge.constant("stiffness") * hinge.parameter("bending")
    return 0.5 * stiffness * angle * angle


def build(setup: Setup) -> Elements:
    """The hinges, with their table rows."""
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
"""Nodes: edge n0, n1, then the opposite ones. Constants: stiffness l² / (4 (a0 + a1)) [-], times k_b [N·m] gives K; table
columns per radian; rest angle [rad]; k_b over curvature columns at the direction of each side [N·m]."""


def dihedral_angles(mesh: ClothMesh) -> NDArray[np.float64]:
    """[H] as the mesh stands [rad]."""
    corner = mesh.nodes[mesh.hinges.nodes]  # [H, 4, 3]
    edge = corner[:, 1] - corner[:, 0]
    first, second = np.cross(edge, corner[:, 2] - corner[:, 0]), np.cross(corner[:, 3] - corner[:, 0], edge)
    sine = -(edge * np.cross(first, second)).sum(-1) / np.linalg.norm(edge, axis=-1)
    return np.asarray(np.arctan2(sine, (first * second).sum(-1)))


def _bent(hinge: Element) -> tuple[Vector, Scalar, tuple[Vector, Vector], Scalar]:
    """(edge, its length, normals on both sides, θ)."""
    start, end, first, second = hinge.positions
    edge = end - start
    length = squareroot(maximum(dot(edge, edge), _TINY))
    normals = (cross(edge, first - start), cross(second - start, edge))
    angle = _dihedral(edge, length, *normals) - hinge.constant("rest_angle")
    return edge, length, normals, angle - held(2 * math.pi * floor(angle / (2 * math.pi) + 0.5))  # the short way round


def _dihedral(edge: Vector, length: Scalar, first: Vector, second: Vector) -> Scalar:
    """Angle of the normals (of any length) on both sides of an edge [rad]."""
    sine, cosine = -dot(edge, cross(first, second)) / length, dot(first, second)
    # atan2(0, 0), a hinge with a collapsed face, has no derivative: call it flat
    return arctangent(sine, cosine + where(absolute(sine) + absolute(cosine) < _TINY, 1.0, 0.0))


def _table_value(hinge: Element, angle: Scalar) -> Scalar:
    """k_b [N·m]."""
    column = clamped(hinge.constant("curvature") * angle - 0.5, 0.0, _COLUMNS - 1.0)
    low = held(where(floor(column) < _COLUMNS - 2.0, floor(column), _COLUMNS - 2.0))
    sides = []
    for side in (0, 1):
        left, right = (hinge.pick("rows", side, low + step) for step in (0.0, 1.0))
        sides.append(maximum(left + (right - left) * (column - low), 0.0))
    return minimum(*sides)


def _rows_at(bending: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3, 5] table, [H, 2] directions -> [H, 2, 5]; half-pixel rows, reflected at -0.5 and 2.5, then clamped."""
    row = (6 * angle / np.pi) % 6.0  # reflection about -0.5 and 2.5 folds the direction into a period of pi
    row = np.clip(np.where(row > 3.0, 6.0 - row, row) - 0.5, 0.0, 2.0)
    low = np.minimum(row.astype(int), 1)
    fraction = (row - low)[..., None]
    return bending[low] * (1 - fraction) + bending[low + 1] * fraction
