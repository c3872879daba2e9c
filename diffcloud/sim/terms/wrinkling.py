"""Energy that a sheet does not store in compression because it wrinkles finer than its mesh.

    energy per face = -(1 - c) a [Φ(λ₁) + Φ(λ₂)],   Φ(λ) = λ²/2 where λ < 0, else 0

with λ the principal values of the symmetric tensor T = √C : E, a the material-space area and c in [0, 1] the part of the
compressive stiffness that stays (`Material.compression`). E is the Green strain and C the stiffness as `stretching` has
them, whose energy is a |T|²/2 = a (λ₁² + λ₂²)/2: what a principal value below zero adds to it is scaled by c. Where C is
isotropic and without coupling, T has the principal directions of the strain.

A sheet hardly resists bending: compressed in its plane it buckles, and carries tension only (the tension field of Wagner
1929; Pipkin, The relaxed energy density for isotropic elastic membranes, IMA J. Appl. Math. 36, 1986). Wrinkles shorter
than an edge are not in the mesh. Without this term its faces resist compression as a plate would, and a coarse mesh locks.

The split by √C keeps the energy a convex function of the strain for any positive C (k1² ≤ k0 k2), so that the sum with
`stretching` keeps its positive matrix. But a sheet under tension in one direction alone has a negative λ where C couples
the axes, or on the bias where k3 is not k0 - k1: there the term softens tension too, the more, the smaller c. A material
with k3 half of k0, as the knits have, keeps 80 % of its stiffness on the bias at c = 0.1, and 26 % at 0.01. Exact is what
minimises the energy over all slack that wrinkles can take up.

To make forces differentiable, Φ'' grows from zero to one over strains of `_WIDTH`; half of that is always resisted.
"""

from __future__ import annotations

from collections.abc import Sequence

from diffcloud.sim.compiled.trace import Scalar, Vector, clamped, maximum, squareroot
from diffcloud.sim.terms import stretching
from diffcloud.sim.terms.stretching import (
    Symmetric,
    along_material,
    coefficients,
    on_corners,
    strain,
    strain_change,
)
from diffcloud.sim.terms.term import Element, Elements, Setup, Term

_WIDTH = 1e-3
"""Strain over which compression begins to be relieved."""
_TINY = 1e-24
"""Under square roots, so that they have derivatives at zero."""


def force(face: Element) -> Sequence[Vector]:
    """-∂W/∂x - H d on the three corners."""
    xu, xv = along_material(face, face.positions)
    du, dv = along_material(face, face.displacement)
    root = _Root(face, xu, xv)
    compressed = _Compressed(root.times(root.strain), root.width)
    held, more = compressed.part(), compressed.change(root.times(strain_change(xu, xv, du, dv)))
    off = face.parameter("compression") - 1.0
    stress_u, stress_v, shear = (off * one for one in root.times((held[0] + more[0], held[1] + more[1], held[2] + more[2])))
    return on_corners(face, stress_u * xu + shear * xv, shear * xu + stress_v * xv)


def energy(face: Element) -> Scalar:
    """W"""
    root = _Root(face, *along_material(face, face.positions))
    compressed = _Compressed(root.times(root.strain), root.width)
    return face.constant("area") * (face.parameter("compression") - 1.0) * compressed.energy()


def build(setup: Setup) -> Elements | None:
    """The faces, where compression is not resisted in full."""
    return stretching.build(setup) if setup.material.wrinkles else None


TERM = Term(
    "wrinkling",
    corners=3,
    force=force,
    energy=energy,
    build=build,
    constants=stretching.TERM.constants,
    tables=stretching.TERM.tables,
    parameters={"stretching": "element", "compression": "episode"},
)
"""Constants and tables: those of `stretching`."""


class _Root:
    """√C at a strain: of [[k0, k1], [k1, k2]] in closed form, and of the shear k3 E01² per area."""

    def __init__(self, face: Element, xu: Vector, xv: Vector) -> None:
        self.strain = strain(xu, xv)
        k0, k1, k2, k3 = coefficients(face, *self.strain)
        between = squareroot(maximum(k0 * k2 - k1 * k1, 0.0) + _TINY)
        trace = squareroot(k0 + k2 + 2.0 * between + _TINY)
        self._u, self._uv, self._v, self._shear = (
            (k0 + between) / trace, k1 / trace, (k2 + between) / trace, squareroot(k3 + _TINY),
        )  # fmt: skip
        self.width = _WIDTH * squareroot(0.5 * (k0 + k2) + _TINY)

    def times(self, tensor: Symmetric) -> Symmetric:
        along_u, along_v, across = tensor
        return (
            self._u * along_u + self._uv * along_v,
            self._uv * along_u + self._v * along_v,
            self._shear * across,
        )


class _Compressed:
    """The compressive part of a symmetric tensor, by its principal values. Where these are equal, `change` leaves out what
    would tell them apart."""

    def __init__(self, tensor: Symmetric, width: Scalar) -> None:
        self._width = width
        mean, self._difference, self._shear = 0.5 * (tensor[0] + tensor[1]), 0.5 * (tensor[0] - tensor[1]), tensor[2]
        self._radius = squareroot(self._difference * self._difference + self._shear * self._shear + _TINY)
        self._values = mean + self._radius, mean - self._radius
        first, second = (self._slope(value) for value in self._values)
        self._mean, self._turn = 0.5 * (first + second), 0.5 * (first - second) / self._radius

    def part(self) -> Symmetric:
        """Φ'(T)"""
        along, across = self._turn * self._difference, self._turn * self._shear
        return self._mean + along, self._mean - along, across

    def change(self, by: Symmetric) -> Symmetric:
        """Φ''(T) : by"""
        cosine, sine = self._difference / self._radius, self._shear / self._radius
        mean, difference, shear = 0.5 * (by[0] + by[1]), 0.5 * (by[0] - by[1]), by[2]
        along, turned = cosine * difference + sine * shear, cosine * shear - sine * difference
        first, second = self._bend(self._values[0]) * (mean + along), self._bend(self._values[1]) * (mean - along)
        mean, along, turned = 0.5 * (first + second), 0.5 * (first - second), self._turn * turned
        difference, shear = cosine * along - sine * turned, sine * along + cosine * turned
        return mean + difference, mean - difference, shear

    def energy(self) -> Scalar:
        """Φ(λ₁) + Φ(λ₂)"""
        first, second = (self._store(value) for value in self._values)
        return first + second

    def _bend(self, value: Scalar) -> Scalar:
        """Φ''"""
        return clamped(-value / self._width, 0.0, 1.0)

    def _slope(self, value: Scalar) -> Scalar:
        """Φ'"""
        bend = self._bend(value)
        return -0.5 * self._width * bend * bend - maximum(-value - self._width, 0.0)

    def _store(self, value: Scalar) -> Scalar:
        """Φ"""
        bend, beyond, width = self._bend(value), maximum(-value - self._width, 0.0), self._width
        return width * width * bend * bend * bend / 6.0 + 0.5 * beyond * (width + beyond)
