"""What wrinkles finer than the mesh take off the energy that `stretching` stores in compression.

    energy per face = (1 - c) a [W*(E) - W(E)],   W(E) = E:C:E / 2,   W*(E) = min over slack A ⪰ 0 of W(E + A)

with E the Green strain and C the stiffness as `stretching` has them, a the material-space area, and c in [0, 1] the part
of the stiffness that resists compression all the same (`Material.compression`). A is the slack that wrinkles take up. W*
is the relaxed energy of tension fields (Wagner 1929; Pipkin, The relaxed energy density for isotropic elastic membranes,
IMA J. Appl. Math. 36, 1986), for any C. Its stress is the one nearest to C:E, measured by C⁻¹, that has no compression in
it:

    taut        C:E ⪰ 0     W* = W
    slack       E ⪯ 0       W* = 0
    wrinkled    otherwise   W* = max over directions t with e > 0 of e²/2y,   stress (e/y) t tᵀ

with e = t·E·t the strain along t, and 1/y Young's modulus there: y = t tᵀ : C⁻¹ : t tᵀ. Cloth that is pulled in one
direction and free to narrow has no compression in its stress, and pulls as with `stretching` alone.

Where a face becomes slack, or begins to wrinkle, the second derivatives of W* jump, and Newton's method oscillates.
Two functions of the energies ease the jumps and keep the energy convex, so that the sum with `stretching` has a positive
matrix. For the sheet at rest to be taut, E is the strain plus `_BEGINS` in all directions: compression up to
that strain is resisted in full, and beyond it about 1.5 times the stress at that strain remains.

Together with `stretching`, damping has the stiffness c C, whatever state a face is in. With the second derivatives of the
energy, the damping forces themselves would jump where a face becomes slack or taut, and steps would often not converge.
"""

from __future__ import annotations

from collections.abc import Sequence

from diffcloud.sim.compiled.trace import Scalar, Vector, clamped, held, minimum, squareroot, where
from diffcloud.sim.terms import stretching
from diffcloud.sim.terms.stretching import (
    Symmetric,
    along_material,
    coefficients,
    on_corners,
    strain,
    strain_change,
    stress,
)
from diffcloud.sim.terms.term import Element, Elements, Setup, Term

_BEGINS = 5e-4
"""Compressive strain at which wrinkles begin."""
_COUPLED = 0.999
"""Part of √(k0 k2) that k1 counts for at most, so that C is positive."""
_LEAST = 1e-9
"""Part of k0 + k2 that is added to k0, k2 and k3, for the same reason."""
_STEPS = 6
"""Of Newton's method, to the direction of wrinkles from that of the largest strain. In 100,000 random strains of sheets
with k3 from 0.3 to 4000 % of √(k0 k2), and k0 and k2 apart by factors of up to thirty, they always arrived."""
_WIDEST = 1.0
"""Largest tangent of a step, in twice the direction's angle."""
_TINY = 1e-24


def force(face: Element) -> Sequence[Vector]:
    """-∂W/∂x - H d on the three corners, with C in the place of the second derivatives in H for what damps."""
    xu, xv = along_material(face, face.positions)
    ahead = strain_change(xu, xv, *along_material(face, [face.ahead * velocity for velocity in face.after]))
    whole = strain_change(xu, xv, *along_material(face, face.displacement))
    sheet, off = _Wrinkling(face, xu, xv), face.parameter("compression") - 1.0
    damped = stress(sheet.stiffness, _combined(1.0, whole, -1.0, ahead))
    changed = _combined(1.0, sheet.change(ahead), 1.0, damped)
    stress_u, stress_v, shear = _combined(off, sheet.stress(), off, changed)
    return on_corners(face, stress_u * xu + shear * xv, shear * xu + stress_v * xv)


def energy(face: Element) -> Scalar:
    """(1 - c) a (W* - W)"""
    sheet = _Wrinkling(face, *along_material(face, face.positions))
    return face.constant("area") * (face.parameter("compression") - 1.0) * sheet.energy()


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
    parameters={**stretching.TERM.parameters, "compression": "episode"},
)
"""Constants and tables: those of `stretching`."""


class _Wrinkling:
    """What a face gives up by wrinkling, W - W* as it is eased, and its derivatives by the strain."""

    def __init__(self, face: Element, xu: Vector, xv: Vector) -> None:
        along_u, along_v, across = strain(xu, xv)
        k0, k1, k2, k3 = coefficients(face, along_u, along_v, across)
        k0, k2, k3 = (one + _LEAST * (k0 + k2) + _TINY for one in (k0, k2, k3))
        k1 = minimum(k1, _COUPLED * squareroot(k0 * k2))
        self.stiffness = k0, k1, k2, k3
        strained = e00, e11, e01 = along_u + _BEGINS, along_v + _BEGINS, across
        whole = s00, s11, s01 = stress(self.stiffness, strained)
        self._taut = (s00 * s11 >= s01 * s01) & (s00 + s11 >= 0.0)
        self._slack = (e00 * e11 >= e01 * e01) & (e00 + e11 <= 0.0)
        flat = k0 * k2 - k1 * k1
        compliance = k2 / flat, -k1 / flat, k0 / flat, 1.0 / k3
        self._pulled = _Pulled(strained, compliance)
        self._kept = self._relaxed(whole, self._pulled.stress())
        self._lost = lost = _combined(1.0, whole, -1.0, self._kept)
        energy = 0.5 * _double(strained, whole)
        kept = where(self._taut, energy, where(self._slack, 0.0, self._pulled.energy()))
        given_up = 0.5 * _double(lost, stress(compliance, lost))  # energy - kept, without what would cancel
        self._scale = 0.25 * _BEGINS * _BEGINS * (k0 + k2) + _TINY
        self._slackening = _Slackening(squareroot(kept / self._scale + _TINY))
        self._loss = _Loss(squareroot(given_up / self._scale + _TINY))

    def energy(self) -> Scalar:
        return self._scale * (self._slackening.energy + self._loss.energy)

    def stress(self) -> Symmetric:
        return _combined(self._slackening.share, self._kept, self._loss.share, self._lost)

    def change(self, by: Symmetric) -> Symmetric:
        """Of the stress by a change of the strain."""
        whole = stress(self.stiffness, by)
        kept = self._relaxed(whole, self._pulled.change(by))
        shares = _combined(self._slackening.share, kept, self._loss.share, _combined(1.0, whole, -1.0, kept))
        slackens, loses = (
            one.rate * _double(stress, by) / (2.0 * self._scale)
            for one, stress in ((self._slackening, self._kept), (self._loss, self._lost))
        )
        return _combined(1.0, shares, 1.0, _combined(slackens, self._kept, loses, self._lost))

    def _relaxed(self, whole: Symmetric, pulled: Symmetric) -> Symmetric:
        """By whether the face is taut, slack or wrinkled."""
        first, second, third = (
            where(self._taut, one, where(self._slack, 0.0, other)) for one, other in zip(whole, pulled, strict=True)
        )
        return first, second, third


class _Slackening:
    """r²(1 - r)³ below r = 1, taken from r², the energy that is kept: what is left rises from zero without a jump of its
    second derivative, is convex, and meets r² at 1 with two derivatives. `share` is the derivative by r², `rate` the
    derivative of `share` by r, divided by r."""

    def __init__(self, root: Scalar) -> None:
        r = where(root < 1.0, root, 1.0)
        rest = 1.0 - r
        self.energy = r * r * rest * rest * rest
        self.share = 0.5 * rest * rest * (2.0 - 5.0 * r)
        self.rate = -1.5 * rest * (3.0 - 5.0 * r) / r


class _Loss:
    """The part that is lost of q², the energy beyond what is kept: its second derivative by q grows from 0 to 2 up to
    q = 1. `share` and `rate` as of `_Slackening`."""

    def __init__(self, root: Scalar) -> None:
        q, eased = root, root < 1.0
        self.energy = where(eased, q * q * q / 3.0, q * q - q + 1.0 / 3.0)
        self.share = where(eased, 0.5 * q, 1.0 - 0.5 / q)
        self.rate = where(eased, 0.5, 0.5 / (q * q)) / q


class _Pulled:
    """A face that pulls along its wrinkles alone, in the direction t of the largest e²/2y.

    Args:
        compliance: of C⁻¹, as k0, k1, k2, k3 are of C.
    """

    def __init__(self, strained: Symmetric, compliance: Sequence[Scalar]) -> None:
        found = [held(one) for one in strained], [held(one) for one in compliance]
        turn = _of_the_largest(*found[0])
        for _ in range(_STEPS):
            at = _Along(*turn, *found)
            rises = at.bend < 0.0
            step = where(rises, at.slope / where(rises, -at.bend, 1.0), where(at.slope > 0.0, _WIDEST, -_WIDEST))
            turn = _turned(*turn, clamped(step, -_WIDEST, _WIDEST))
        bend = _Along(*turn, *found).bend  # one step more, by which the direction follows the strain
        step = _Along(*turn, strained, compliance).slope / where(bend < 0.0, -bend, 1.0)
        self._at = _Along(*_turned(*turn, step), strained, compliance)

    def energy(self) -> Scalar:
        """e²/2y"""
        return 0.5 * self._at.strain * self._at.strain / self._at.compliance

    def stress(self) -> Symmetric:
        """(e/y) t tᵀ"""
        pull = self._at.strain / self._at.compliance
        along_u, along_v, between = self._at.tensor
        return pull * along_u, pull * along_v, pull * between

    def change(self, by: Symmetric) -> Symmetric:
        """Of the stress by a change of the strain: t pulls more, and turns."""
        at = self._at
        slopes = [at.compliance * one - 0.5 * at.softer * other for one, other in zip(at.turning, at.tensor, strict=True)]
        bend = at.compliance * at.compliance * where(at.bend < 0.0, -at.bend, 1.0)
        pull, turn = _double(at.tensor, by) / at.compliance, _double(slopes, by) * at.strain / bend
        first, second, third = (pull * one + turn * other for one, other in zip(at.tensor, slopes, strict=True))
        return first, second, third


class _Along:
    """A direction t = (cos φ, sin φ) in the sheet, by the cosine and sine of 2φ, in which t tᵀ is linear.

    Derivatives are by 2φ. That of e²/2y is (e/y²) `slope`, and `slope`'s is `bend`.
    """

    def __init__(self, cosine: Scalar, sine: Scalar, strained: Sequence[Scalar], compliance: Sequence[Scalar]) -> None:
        along_u, along_v, between = 0.5 + 0.5 * cosine, 0.5 - 0.5 * cosine, 0.5 * sine
        first, coupled, second, shear = compliance
        shared = 2.0 * (coupled + shear)
        self.tensor = along_u, along_v, between
        self.turning = -between, between, 0.5 * cosine
        self.strain = _double(self.tensor, strained)
        turned = _double(self.turning, strained)
        self.compliance = _double(self.tensor, stress(compliance, self.tensor))
        rate = second * along_v - first * along_u + 0.5 * shared * cosine
        self.softer = sine * rate
        softest = cosine * rate + 0.5 * sine * sine * (first + second - shared)
        self.slope = turned * self.compliance - 0.5 * self.strain * self.softer
        back = 0.5 * (strained[0] + strained[1]) - self.strain
        self.bend = back * self.compliance + 0.5 * turned * self.softer - 0.5 * self.strain * softest


def _of_the_largest(along_u: Scalar, along_v: Scalar, across: Scalar) -> tuple[Scalar, Scalar]:
    """Cosine and sine of twice the angle of the largest strain."""
    difference = 0.5 * (along_u - along_v)
    radius = squareroot(difference * difference + across * across)
    directed = radius > 0.0
    divisor = where(directed, radius, 1.0)
    return where(directed, difference / divisor, 1.0), across / divisor


def _turned(cosine: Scalar, sine: Scalar, tangent: Scalar) -> tuple[Scalar, Scalar]:
    length = squareroot(1.0 + tangent * tangent)
    return (cosine - tangent * sine) / length, (sine + tangent * cosine) / length


def _double(one: Sequence[Scalar], other: Sequence[Scalar]) -> Scalar:
    """one : other"""
    return one[0] * other[0] + one[1] * other[1] + 2.0 * one[2] * other[2]


def _combined(a: Scalar | float, one: Symmetric, b: Scalar | float, other: Symmetric) -> Symmetric:
    """a one + b other"""
    first, second, third = (a * p + b * q for p, q in zip(one, other, strict=True))
    return first, second, third
