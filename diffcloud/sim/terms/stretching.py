"""In-plane elasticity with the measured tables of Wang et al. 2011, sampled as in ARCSim.

    energy per face = a [k0 E00²/2 + k1 E00 E11 + k2 E11²/2 + k3 E01²],   E = (FᵀF - I)/2,   k = k(E)

F [3, 2] is the deformation gradient, and a the area in material space. The coefficients are interpolated trilinearly in a
30³ grid over (E00, E11, |E01|). ARCSim samples with half-pixel centres and border padding (`grid_sample` with
align_corners = False). Zero padding would halve the stiffness at rest. Force and stiffness treat the coefficients as
constants. Derivatives with respect to the state include their dependence on the strain.

The stiffness H includes the geometric term of tension, but not that of shear, as in ARCSim. This keeps H positive. In a
damped step the displacement is d = (Δt + β) v. The geometric term uses Δt v only, because β v would damp rotations.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from diffcloud.sim.compiled.trace import Scalar, Vector, absolute, clamped, dot, floor, held, maximum, where
from diffcloud.sim.materials import TABLE_ENTRY_TO_STRETCHING
from diffcloud.sim.terms.term import Element, Elements, Setup, Term

_SAMPLES = 30
_SCALE = 900.0 / 29.0
"""Grid cells per unit of strain. In `grid_sample` coordinates the range factor is 60/29."""

Symmetric = tuple[Scalar, Scalar, Scalar]
"""Components 00, 11 and 01 of a symmetric tensor."""


def force(face: Element) -> Sequence[Vector]:
    """Forces -∂W/∂x - H d on the three corners [N]."""
    xu, xv = along_material(face, face.positions)
    du, dv = along_material(face, face.displacement)
    along_u, along_v = along_material(face, [face.ahead * velocity for velocity in face.after])
    e00, e11, e01 = strain(xu, xv)
    stiffness = k0, k1, k2, _ = coefficients(face, e00, e11, e01)
    d00, d11, d01 = strain_change(xu, xv, du, dv)
    stress_u, stress_v, shear = stress(stiffness, (e00 + d00, e11 + d11, e01 + d01))
    stretched_u, stretched_v = maximum(e00, 0.0), maximum(e11, 0.0)
    tension_u, tension_v = k0 * stretched_u + k1 * stretched_v, k1 * stretched_u + k2 * stretched_v
    row_u = stress_u * xu + shear * xv + tension_u * along_u
    row_v = shear * xu + stress_v * xv + tension_v * along_v
    return on_corners(face, row_u, row_v)


def energy(face: Element) -> Scalar:
    """Energy W of the face [J]."""
    e00, e11, e01 = strain(*along_material(face, face.positions))
    k0, k1, k2, k3 = coefficients(face, e00, e11, e01)
    axial = 0.5 * (k0 * e00 * e00 + k2 * e11 * e11) + k1 * e00 * e11
    return face.constant("area") * (axial + k3 * e01 * e01)


def build(setup: Setup) -> Elements:
    """Elements: all faces, with their rest shapes and the sampled table."""
    mesh = setup.mesh
    return Elements(
        nodes=mesh.faces,
        constants={"area": mesh.face_area, "inverse_rest": np.linalg.inv(mesh.material_edges).astype(np.float64)},
        tables={"cells": _cell_polynomials(_sampled(setup.material.stretching))},
    )


TERM = Term(
    "stretching",
    corners=3,
    force=force,
    energy=energy,
    build=build,
    constants={"area": (), "inverse_rest": (2, 2)},
    tables={"cells": 3},
    parameters={"stretching": "element", "shear": "episode"},
)
"""Constants: area in material space [m²]; inverse of the edge matrix [1/m], with a row per edge and a column per direction
(u, v).

Tables: [29³, 8, 4] trilinear polynomial (x, y, z, xy, xz, yz, xyz, 1) of (k0, k1, k2, k3) in each cell [N/m].
"""


def along_material(face: Element, field: Sequence[Vector]) -> tuple[Vector, Vector]:
    """Derivatives along u and v of a field given at the three corners."""
    first, second = field[1] - field[0], field[2] - field[0]
    u, v = (
        face.constant("inverse_rest", 0, axis) * first + face.constant("inverse_rest", 1, axis) * second for axis in (0, 1)
    )
    return u, v


def strain(xu: Vector, xv: Vector) -> Symmetric:
    """Strain E of a face, from the derivatives of its positions along u and v."""
    return 0.5 * (dot(xu, xu) - 1), 0.5 * (dot(xv, xv) - 1), 0.5 * dot(xu, xv)


def strain_change(xu: Vector, xv: Vector, du: Vector, dv: Vector) -> Symmetric:
    """First-order change of the strain E caused by a displacement with derivatives du and dv along u and v."""
    return dot(xu, du), dot(xv, dv), 0.5 * (dot(xu, dv) + dot(xv, du))


def stress(stiffness: Sequence[Scalar], by: Symmetric) -> Symmetric:
    """Stress C : by [N/m] of a strain `by`, with the orthotropic stiffness C = (k0, k1, k2, k3) [N/m]."""
    (k0, k1, k2, k3), (along_u, along_v, across) = stiffness, by
    return k0 * along_u + k1 * along_v, k1 * along_u + k2 * along_v, k3 * across


def on_corners(face: Element, row_u: Vector, row_v: Vector) -> Sequence[Vector]:
    """Forces [N] on the three corners, from the stress vectors row_u and row_v [N/m] along u and v in the face."""
    area = face.constant("area")
    pulls = [
        -area * (face.constant("inverse_rest", side, 0) * row_u + face.constant("inverse_rest", side, 1) * row_v)
        for side in (0, 1)
    ]
    return [-(pulls[0] + pulls[1]), *pulls]


def coefficients(face: Element, e00: Scalar, e11: Scalar, e01: Scalar) -> list[Scalar]:
    """Coefficients k0, k1, k2, k3 at a strain [N/m], multiplied by the face's `stretching`, and k3 also by `shear`."""
    places = [clamped((e + 0.25) * _SCALE - 0.5, 0.0, _SAMPLES - 1.0) for e in (e00, e11)]
    places.append(clamped(absolute(e01) * _SCALE - 0.5, 0.0, _SAMPLES - 1.0))
    last = _SAMPLES - 2.0
    corners = [held(where(floor(place) < last, floor(place), last)) for place in places]
    x, y, z = (place - corner for place, corner in zip(places, corners, strict=True))
    cell = (corners[0] * (_SAMPLES - 1) + corners[1]) * (_SAMPLES - 1) + corners[2]
    monomials = [x, y, z, x * y, x * z, y * z, x * y * z]
    found = []
    for number in range(4):
        value = face.look_up("cells", cell, len(monomials), number)
        for power, monomial in enumerate(monomials):
            value = value + monomial * face.look_up("cells", cell, power, number)
        found.append(value)
    axial = [value * face.parameter("stretching") for value in found[:3]]
    return [*axial, found[3] * (face.parameter("stretching") * face.parameter("shear"))]


def _sampled(stretching: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sample the table [6, 4] to coefficients [4, 30, 30, 30] over (C00, C11, C01), where C = FᵀF."""
    index = np.arange(_SAMPLES)
    c00, c11, c01 = np.meshgrid(0.5 + index / 15, 0.5 + index / 15, index / 15, indexing="ij")
    largest = 0.5 * (c00 + c11 + np.sqrt(4 * c01**2 + (c00 - c11) ** 2))
    direction_u, direction_v = largest - c11, c01.copy()
    axis_aligned = c01 == 0
    direction_u[axis_aligned] = (c00 >= c11)[axis_aligned]
    direction_v[axis_aligned] = (c00 < c11)[axis_aligned]
    angle = 8 * np.abs(np.arctan2(direction_v, direction_u)) / np.pi
    strain = 6 * (np.sqrt(largest) - 1)
    p = np.clip(1.25 * angle - 0.5, 0, 4)
    q = np.clip(2 * strain - 0.5, 0, 1)
    low = np.minimum(p.astype(int), 3)
    fraction = p - low
    reference = stretching[1:].T  # [4, 5]
    at_reference = reference[:, low] * (1 - fraction) + reference[:, low + 1] * fraction
    at_rest = stretching[0][:, None, None, None]
    return np.maximum(0.0, TABLE_ENTRY_TO_STRETCHING * (at_rest * (1 - q) + at_reference * q))


def _cell_polynomials(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """Trilinear polynomial of each cell in its local coordinates: [K, n, n, n] -> [(n-1)³, 8, K]."""
    ends = (slice(None, -1), slice(1, None))
    c = {(x, y, z): table[:, ends[x], ends[y], ends[z]] for x in (0, 1) for y in (0, 1) for z in (0, 1)}
    polynomial = [
        c[1, 0, 0] - c[0, 0, 0],
        c[0, 1, 0] - c[0, 0, 0],
        c[0, 0, 1] - c[0, 0, 0],
        c[1, 1, 0] - c[1, 0, 0] - c[0, 1, 0] + c[0, 0, 0],
        c[1, 0, 1] - c[1, 0, 0] - c[0, 0, 1] + c[0, 0, 0],
        c[0, 1, 1] - c[0, 1, 0] - c[0, 0, 1] + c[0, 0, 0],
        c[1, 1, 1] - c[1, 1, 0] - c[1, 0, 1] - c[0, 1, 1] + c[1, 0, 0] + c[0, 1, 0] + c[0, 0, 1] - c[0, 0, 0],
        c[0, 0, 0],
    ]
    return np.stack(polynomial).transpose(2, 3, 4, 0, 1).reshape(-1, 8, len(table))
