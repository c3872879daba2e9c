"""Reduction of the compression energy of `stretching` by wrinkles that are finer than the mesh.

    energy per face = (1 - c) a [W*(E) - W(E)],   W(E) = E:C:E / 2,   W*(E) = min over slack A ⪰ 0 of W(E + A)

E is the Green strain and C the stiffness, as in `stretching`. a is the area in material space. c in [0, 1] is the fraction
of the stiffness that still resists compression (`Material.compression`). A is the slack that wrinkles absorb. W* is the
relaxed energy of tension fields, for any C (Wagner 1929; Pipkin, The relaxed energy density for isotropic elastic
membranes, IMA J. Appl. Math. 36, 1986). Its stress is the closest one to C:E, in the norm of C⁻¹, without compression:

    taut        C:E ⪰ 0     W* = W
    slack       E ⪯ 0       W* = 0
    wrinkled    otherwise   W* = max over directions t with e > 0 of e²/2y,   stress (e/y) t tᵀ

where e = t·E·t is the strain along t, and 1/y is Young's modulus there: y = t tᵀ : C⁻¹ : t tᵀ. Cloth that is pulled in one
direction and free to narrow has no compressive stress. Its force is that of `stretching` alone.

The second derivatives of W* jump where a face becomes slack or begins to wrinkle, so Newton's method would oscillate. Two
functions of the energies smooth these jumps. They keep the energy convex, so the sum with `stretching` has a positive
matrix. The sheet at rest must be taut, so E is the strain plus `_BEGINS` in all directions. Compression up to this strain
meets full resistance. Beyond it, about 1.5 times the stress at this strain remains.

Together with `stretching`, damping always has the stiffness c C. With the second derivatives of the energy, the damping
forces themselves would jump where a face becomes slack or taut, and steps would often not converge.
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
"""Upper bound of k1 as a fraction of √(k0 k2), so that C is positive."""
_LEAST = 1e-9
"""Fraction of k0 + k2 that is added to k0, k2 and k3, so that C is positive."""
_STEPS = 6
"""Iterations of Newton's method from the direction of the largest strain to that of the wrinkles. They converged for
100,000 random strains of sheets with k3 from 0.3 to 4000 % of √(k0 k2), and ratios k0/k2 up to thirty."""
_WIDEST = 1.0
"""Upper bound of a Newton step: tangent of the change of twice the direction's angle."""
_TINY = 1e-24


def force(face: Element) -> Sequence[Vector]:
    """Forces -∂W/∂x - H d on the three corners [N]. For damping, H has C in place of the second derivatives."""
    xu, xv = along_material(face, face.positions)
    ahead = strain_change(xu, xv, *along_material(face, [face.ahead * velocity for velocity in face.after]))
    whole = strain_change(xu, xv, *along_material(face, face.displacement))
    sheet, off = _Wrinkling(face, xu, xv), face.parameter("compression") - 1.0
    damped = stress(sheet.stiffness, _combined(1.0, whole, -1.0, ahead))
    changed = _combined(1.0, sheet.change(ahead), 1.0, damped)
    stress_u, stress_v, shear = _combined(off, sheet.stress(), off, changed)
    return on_corners(face, stress_u * xu + shear * xv, shear * xu + stress_v * xv)


def energy(face: Element) -> Scalar:
    """Energy (1 - c) a (W* - W) [J]."""
    sheet = _Wrinkling(face, *along_material(face, face.positions))
    return face.constant("area") * (face.parameter("compression") - 1.0) * sheet.energy()


def build(setup: Setup) -> Elements | None:
    """Elements: all faces, if the material wrinkles."""
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
"""Constants and tables as in `stretching`."""


class _Wrinkling:
    """Smoothed energy W - W* that a face loses by wrinkling, and its derivatives with respect to the strain."""

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
        given_up = 0.5 * _double(lost, stress(compliance, lost))  # energy - kept, computed without cancellation
        self._scale = 0.25 * _BEGINS * _BEGINS * (k0 + k2) + _TINY
        self._slackening = _Slackening(squareroot(kept / self._scale + _TINY))
        self._loss = _Loss(squareroot(given_up / self._scale + _TINY))

    def energy(self) -> Scalar:
        return self._scale * (self._slackening.energy + self._loss.energy)

    def stress(self) -> Symmetric:
        return _combined(self._slackening.share, self._kept, self._loss.share, self._lost)

    def change(self, by: Symmetric) -> Symmetric:
        """Change of the stress for a change of the strain `by`."""
        whole = stress(self.stiffness, by)
        kept = self._relaxed(whole, self._pulled.change(by))
        shares = _combined(self._slackening.share, kept, self._loss.share, _combined(1.0, whole, -1.0, kept))
        slackens, loses = (
            one.rate * _double(stress, by) / (2.0 * self._scale)
            for one, stress in ((self._slackening, self._kept), (self._loss, self._lost))
        )
        return _combined(1.0, shares, 1.0, _combined(slackens, self._kept, loses, self._lost))

    def _relaxed(self, whole: Symmetric, pulled: Symmetric) -> Symmetric:
        """Select the stress of a taut, slack or wrinkled face."""
        first, second, third = (
            where(self._taut, one, where(self._slack, 0.0, other)) for one, other in zip(whole, pulled, strict=True)
        )
        return first, second, third


class _Slackening:
    """r²(1 - r)³ for r < 1: the part of the kept energy r² that smoothing subtracts. The difference is convex, and its
    second derivative rises from zero without a jump. At r = 1 it joins r² with two continuous derivatives. `share` is the
    derivative with respect to r². `rate` is the derivative of `share` with respect to r, divided by r."""

    def __init__(self, root: Scalar) -> None:
        r = where(root < 1.0, root, 1.0)
        rest = 1.0 - r
        self.energy = r * r * rest * rest * rest
        self.share = 0.5 * rest * rest * (2.0 - 5.0 * r)
        self.rate = -1.5 * rest * (3.0 - 5.0 * r) / r


class _Loss:
    """Smoothed lost energy: the part of q² that is subtracted, where q² is the energy beyond the kept one. Its second
    derivative with respect to q grows from 0 to 2 up to q = 1. `share` and `rate` are as in `_Slackening`."""

    def __init__(self, root: Scalar) -> None:
        q, eased = root, root < 1.0
        self.energy = where(eased, q * q * q / 3.0, q * q - q + 1.0 / 3.0)
        self.share = where(eased, 0.5 * q, 1.0 - 0.5 / q)
        self.rate = where(eased, 0.5, 0.5 / (q * q)) / q


class _Pulled:
    """Energy and stress of a wrinkled face: tension only in the direction t of the largest e²/2y. `compliance` has the
    coefficients of C⁻¹, in the order of k0, k1, k2, k3."""

    def __init__(self, strained: Symmetric, compliance: Sequence[Scalar]) -> None:
        found = [held(one) for one in strained], [held(one) for one in compliance]
        turn = _of_the_largest(*found[0])
        for _ in range(_STEPS):
            at = _Along(*turn, *found)
            rises = at.bend < 0.0
            step = where(rises, at.slope / where(rises, -at.bend, 1.0), where(at.slope > 0.0, _WIDEST, -_WIDEST))
            turn = _turned(*turn, clamped(step, -_WIDEST, _WIDEST))
        bend = _Along(*turn, *found).bend  # one more step, through which the direction depends on the strain
        step = _Along(*turn, strained, compliance).slope / where(bend < 0.0, -bend, 1.0)
        self._at = _Along(*_turned(*turn, step), strained, compliance)

    def energy(self) -> Scalar:
        """Energy per area e²/2y."""
        return 0.5 * self._at.strain * self._at.strain / self._at.compliance

    def stress(self) -> Symmetric:
        """Stress (e/y) t tᵀ."""
        pull = self._at.strain / self._at.compliance
        along_u, along_v, between = self._at.tensor
        return pull * along_u, pull * along_v, pull * between

    def change(self, by: Symmetric) -> Symmetric:
        """Change of the stress for a change of the strain: the tension increases, and t rotates."""
        at = self._at
        slopes = [at.compliance * one - 0.5 * at.softer * other for one, other in zip(at.turning, at.tensor, strict=True)]
        bend = at.compliance * at.compliance * where(at.bend < 0.0, -at.bend, 1.0)
        pull, turn = _double(at.tensor, by) / at.compliance, _double(slopes, by) * at.strain / bend
        first, second, third = (pull * one + turn * other for one, other in zip(at.tensor, slopes, strict=True))
        return first, second, third


class _Along:
    """A direction t = (cos φ, sin φ) in the sheet, given by cos 2φ and sin 2φ, in which t tᵀ is linear. Derivatives are
    with respect to 2φ. The derivative of e²/2y is (e/y²) `slope`, and the derivative of `slope` is `bend`."""

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
    """Cosine and sine of twice the angle of the direction of the largest strain."""
    difference = 0.5 * (along_u - along_v)
    radius = squareroot(difference * difference + across * across)
    directed = radius > 0.0
    divisor = where(directed, radius, 1.0)
    return where(directed, difference / divisor, 1.0), across / divisor


def _turned(cosine: Scalar, sine: Scalar, tangent: Scalar) -> tuple[Scalar, Scalar]:
    length = squareroot(1.0 + tangent * tangent)
    return (cosine - tangent * sine) / length, (sine + tangent * cosine) / length


def _double(one: Sequence[Scalar], other: Sequence[Scalar]) -> Scalar:
    """Double contraction one : other."""
    return one[0] * other[0] + one[1] * other[1] + 2.0 * one[2] * other[2]


def _combined(a: Scalar | float, one: Symmetric, b: Scalar | float, other: Symmetric) -> Symmetric:
    """Linear combination a one + b other."""
    first, second, third = (a * p + b * q for p, q in zip(one, other, strict=True))
    return first, second, third
