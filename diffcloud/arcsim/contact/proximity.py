"""Repulsion and lagged friction between meshes, as forces of ARCSim's step.

A pair at distance h, with the normal n oriented so that h > 0, violates the thickness τ by c = max(τ - h, 0). The energy is
K c³/(6 τ) with K = k_c times the smaller area. The force is K c²/(2 τ) along n, the stiffness K c/τ. Weights w distribute
both over the four points.

Friction is γ = min(μ f_n/|P v|, 1/(Δt Σ w_k²/m_k)) times the sliding velocity P v, with P = I - n nᵀ. In γ, the normal
force f_n and the velocity v = Σ w_k v_k are those at the start of the step. The sliding velocity itself is implicit.

`nearest` selects the pairs: each point, edge and face has one slot per side, which keeps the nearest pair only. In ARCSim,
a pair with two slots counts twice (`count_once` off).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from diffcloud.arcsim.contact.frames import Kind, frame
from diffcloud.sim.compiled.trace import Vector, dot, larger, maximum, norm, total, where
from diffcloud.sim.terms.term import Element, Term

_TINY = 1e-12


def force(kind: Kind, pair: Element) -> Sequence[Vector]:
    """Repulsion, to first order in the motion of the step, and friction with the velocity at the end of the step [N]."""
    weights, normal = frame(kind, pair.positions)
    normal = pair.constant("sign") * normal

    def along(field: Sequence[Vector]) -> Vector:
        return total(weight * one for weight, one in zip(weights, field, strict=True))

    thickness = pair.constant("thickness")
    violation = maximum(thickness - dot(normal, along(pair.positions)), 0.0)
    stiffness = violation * (pair.constant("stiffness") / thickness)
    pushing = 0.5 * stiffness * violation
    before, after = along(pair.before), along(pair.after)
    mobility = sum((w * w * pair.parameter("inverse_mass", k) for k, w in enumerate(weights)), weights[0].of(0.0))
    with_obstacle = pair.constant("with_obstacle") > 0.0
    limit = where(with_obstacle, pair.parameter("friction"), pair.parameter("self_friction")) * pushing
    speed = norm(before - dot(normal, before) * normal)
    gamma = limit / larger(speed, limit * pair.time_step * mobility + _TINY)
    pressure = pushing - stiffness * dot(normal, pair.ahead * after) + gamma * dot(normal, after)
    push = pair.constant("count") * (pressure * normal - gamma * after)
    return [weight * push for weight in weights]


def _term(kind: Kind) -> Term:
    return Term(
        f"proximity_{kind}",
        corners=4,
        force=partial(force, kind),
        constants=dict.fromkeys(("sign", "count", "stiffness", "with_obstacle", "thickness"), ()),
        parameters={"inverse_mass": "corner", "friction": "episode", "self_friction": "episode"},
    )


PROXIMITY_POINT_FACE = _term("point_face")
PROXIMITY_EDGE_EDGE = _term("edge_edge")
"""Constants: sign that turns the normal towards the first primitive; how often the pair counts; k_c times the area [N/m]; 1
if an obstacle takes part; τ [m]."""
