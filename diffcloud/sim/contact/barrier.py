"""Smooth contact: a barrier potential and Coulomb friction, both evaluated at the end of the step.

The potential of one contact at distance d below the thickness d̂ is

    φ(d) = -(K/6) (d - d̂)² ln(d / d̂),      K = k_c A.

It is twice continuously differentiable at d̂ and infinite at d = 0 (Li et al. 2020, Incremental Potential Contact, IPC). It
is weighted by the area A (Li et al. 2023, Convergent IPC). Near d̂ it equals ARCSim's potential K (d̂ - d)³ / (6 d̂).

A point near a mesh is repelled by every face within d̂. Where faces meet, this sum would count a contact twice. So each
shared edge is subtracted once, and each interior point is added back once (inclusion and exclusion, as in Convergent IPC).
The result is exactly one contact over a flat surface, for any triangulation, and it is smooth across edges and points.
`places` merges the contacts with the same point, edge or face. Each one is an element with a share of the area, which can
be negative.

The closest points of two parallel edges are not unique. So their force fades with the squared sine of the angle, like IPC's
mollifier. The fading itself adds no force.

Friction is -μ λ f(|v_t|) v_t/|v_t| with λ = -φ'(d) and the sliding velocity v_t of the step. f = 2y - y² with y = |v_t|/v_s
up to the sticking speed v_s, and 1 above. So a contact at rest creeps slower than v_s. Normal force, normal and sliding
velocity are all those of the end of the step (no lagging), so forces are smooth in all inputs.

`resistance` has the positive semidefinite approximation of the stiffness.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from diffcloud.sim.compiled.trace import Scalar, Vector, cross, dot, logarithm, norm, total, where
from diffcloud.sim.terms.term import Element, Term

_PARALLEL = 1e-3
"""Squared sine of the angle between two edges below which their force fades."""

Place = Callable[[Element], tuple[list[Scalar], Vector, Scalar, Scalar]]
"""Function that returns the signed weights of the corners, the vector between the closest points [m], the area [m²] and the
coefficient of friction."""


def _force(place: Place, pair: Element) -> Sequence[Vector]:
    """Barrier force and friction on the corners [N]."""
    weights, gap, share, coefficient = place(pair)
    distance = norm(gap)
    normal = gap / distance
    sliding = _sliding(weights, normal, pair)
    pressing = share * _pressure(pair, distance)
    rubbing = coefficient * pressing * _per_speed(pair, norm(sliding))
    push = pressing * normal - rubbing * sliding
    return [weight * push for weight in weights]


def _velocity(weights: Sequence[Scalar], pair: Element) -> Vector:
    return total(weight * one for weight, one in zip(weights, pair.after, strict=True))


def _sliding(weights: Sequence[Scalar], normal: Vector, pair: Element) -> Vector:
    velocity = _velocity(weights, pair)
    return velocity - dot(velocity, normal) * normal


def _law(pair: Element, number: int) -> Scalar:
    """k_c [N/m³], d̂ [m] or v_s [m/s]: first row of the table, or second row for pairs that are close at rest."""
    row = pair.graph.constant(0.0) if "mixed" not in pair.constants else where(pair.constant("mixed") < 0.0, 1.0, 0.0)
    return pair.look_up("law", row, number)


def _pressure(pair: Element, distance: Scalar) -> Scalar:
    """Normal force per area, -dφ/dd [Pa]."""
    scale, thickness = _law(pair, 0), _law(pair, 1)
    ratio = distance / thickness
    below = ratio < 1.0
    safe = where(below, ratio, 0.5)
    slope = 2.0 * (safe - 1) * logarithm(safe) + (safe - 1) * (safe - 1) / safe
    return where(below, scale / 6.0 * thickness * slope, 0.0)


def _per_speed(pair: Element, speed: Scalar) -> Scalar:
    """f(|v|)/|v|, finite for v = 0 [s/m]."""
    sticking = _law(pair, 2)
    return where(speed < sticking, (2.0 - speed / sticking) / sticking, 1.0 / speed)


def _between(pair: Element, weights: list[Scalar], share: Scalar) -> tuple[list[Scalar], Vector, Scalar, Scalar]:
    """Result of `Place` for a contact between points of meshes."""
    gap = total(weight * corner for weight, corner in zip(weights, pair.positions, strict=True))
    mixed = pair.constant("mixed") > 0.0
    return weights, gap, share, where(mixed, pair.parameter("friction"), pair.parameter("self_friction"))


def _point_point(pair: Element) -> tuple[list[Scalar], Vector, Scalar, Scalar]:
    one = pair.graph.constant(1.0)
    return _between(pair, [one, -one], pair.constant("share"))


def _point_edge(pair: Element) -> tuple[list[Scalar], Vector, Scalar, Scalar]:
    point, start, end = pair.positions
    along = end - start
    fraction = dot(point - start, along) / dot(along, along)
    return _between(pair, [pair.graph.constant(1.0), fraction - 1, -fraction], pair.constant("share"))


def _point_face(pair: Element) -> tuple[list[Scalar], Vector, Scalar, Scalar]:
    point, a, b, c = pair.positions
    ab, ac, ap = b - a, c - a, point - a
    d00, d01, d11, d20, d21 = dot(ab, ab), dot(ab, ac), dot(ac, ac), dot(ap, ab), dot(ap, ac)
    determinant = d00 * d11 - d01 * d01
    v, w = (d11 * d20 - d01 * d21) / determinant, (d00 * d21 - d01 * d20) / determinant
    return _between(pair, [pair.graph.constant(1.0), v + w - 1, -v, -w], pair.constant("share"))


def _edge_edge(pair: Element) -> tuple[list[Scalar], Vector, Scalar, Scalar]:
    p0, p1, q0, q1 = pair.positions
    u, v, w = p1 - p0, q1 - q0, p0 - q0
    a, b, c, d, e = dot(u, u), dot(u, v), dot(v, v), dot(u, w), dot(v, w)
    s_given, t_given = pair.constant("s"), pair.constant("t")
    s_free, t_free = s_given < 0.0, t_given < 0.0
    inside = s_free & t_free
    determinant = where(inside, a * c - b * b, 1.0)
    s = where(inside, (b * e - c * d) / determinant, where(s_free, (t_given * b - d) / a, s_given))
    t = where(inside, (a * e - b * d) / determinant, where(t_free, (e + s_given * b) / c, t_given))
    across = cross(u, v)
    ratio = dot(across, across) / (_PARALLEL * a * c)
    share = pair.constant("share") * where(ratio < 1.0, ratio * (2.0 - ratio), 1.0)
    return _between(pair, [1 - s, s, t - 1, -t], share)


def _plane(node: Element) -> Sequence[Vector]:
    """Barrier force and friction of a half-space n · x >= offset [N]."""
    pressing, sliding = _at_plane(node)
    rubbing = node.parameter("friction") * pressing * _per_speed(node, norm(sliding))
    return [pressing * node.vector("normal") - rubbing * sliding]


def _at_plane(node: Element) -> tuple[Scalar, Vector]:
    """Normal force [N] and sliding velocity [m/s]."""
    normal, velocity = node.vector("normal"), node.after[0]
    distance = dot(node.positions[0], normal) - node.constant("offset")
    return node.constant("share") * _pressure(node, distance), velocity - dot(velocity, normal) * normal


def _term(name: str, corners: int, place: Place, *more: str) -> Term:
    return Term(
        f"barrier_{name}",
        corners=corners,
        force=lambda pair: _force(place, pair),
        constants=dict.fromkeys(("share", "mixed", *more), ()),
        tables={"law": 2},
        parameters={"friction": "episode", "self_friction": "episode"},
    )


BARRIER_POINT_POINT = _term("point_point", 2, _point_point)
BARRIER_POINT_EDGE = _term("point_edge", 3, _point_edge)
BARRIER_POINT_FACE = _term("point_face", 4, _point_face)
BARRIER_EDGE_EDGE = _term("edge_edge", 4, _edge_edge, "s", "t")
"""Constants: area [m²]; 1 if an obstacle takes part, -1 for a pair that is close at rest. For two edges also the fractions
along them of the closest points: 0 or 1, or negative for points between the ends.

Tables: [2, 3] for `_law`.
"""
BARRIER_PLANE = Term(
    "barrier_plane",
    corners=1,
    force=_plane,
    constants={"share": (), "normal": (3,), "offset": ()},
    tables={"law": 2},
    parameters={"friction": "episode"},
)
"""Constants: area [m²]; unit normal; offset [m]."""
