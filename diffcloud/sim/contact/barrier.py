"""Smooth contact: a barrier against touching, and Coulomb friction, both at the end of the step.

The potential of one place at distance d below the thickness d̂ is

    φ(d) = -(K/6) (d - d̂)² ln(d / d̂),      K = k_c A,

twice continuously differentiable at d̂, infinite at d = 0 (Li et al. 2020, Incremental Potential Contact), weighted by area
(Li et al. 2023, Convergent IPC) and scaled so that near d̂ it equals ARCSim's K (d̂ - d)³ / (6 d̂).

A point near a mesh feels every face within d̂. Where faces meet, the sum would count a place twice; so the shared edge is
taken off once and an interior point added back once (inclusion and exclusion, as in Convergent IPC), which leaves
exactly one contact over a flat surface however it is cut into triangles, and is smooth over all features.

Two edges that become parallel have no unique closest places; their force fades out with the squared sine of the angle
(as IPC's mollifier; the fading itself adds no force).

Friction: -μ λ f(|v_t|) v_t/|v_t| with λ = -φ'(d), v_t the sliding velocity of the step and f = 2y - y², y = |v_t|/v_s, up
to the sticking speed v_s and 1 beyond: a resting contact creeps slower than v_s. Normal force, normal and sliding all
belong to the end of the step (nothing is lagged), so forces are smooth in all inputs.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffcloud.sim.contact.distance import edge_edge_weights, point_face_weights
from diffcloud.sim.elements import safe_norm

_PARALLEL = 1e-3
"""Squared sine of the angle between two edges below which their force fades."""
_TINY = 1e-300


@dataclass(frozen=True)
class Barrier:
    """Numbers of the contact law."""

    scale: float
    """k_c [N/m³]"""
    thickness: float
    """d̂ [m]"""
    sticking_speed: float
    """v_s [m/s]"""

    def energy(self, distance: Tensor) -> Tensor:
        """φ per area [J/m²] at distances [...] > 0."""
        ratio = distance / self.thickness
        inside = self.thickness**2 * (ratio - 1).square() * ratio.clamp(min=_TINY).log()
        return torch.where(ratio < 1, -self.scale / 6 * inside, 0.0)

    def pressure(self, distance: Tensor) -> Tensor:
        """-dφ/dd per area [Pa]."""
        ratio = distance / self.thickness
        below = ratio < 1
        safe = torch.where(below, ratio, 0.5)
        slope = 2 * (safe - 1) * safe.log() + (safe - 1).square() / safe
        return torch.where(below, self.scale / 6 * self.thickness * slope, 0.0)

    def stiffness(self, distance: Tensor) -> Tensor:
        """d²φ/dd² per area [N/m³]."""
        ratio = distance / self.thickness
        below = ratio < 1
        safe = torch.where(below, ratio, 0.5)
        curvature = -2 * safe.log() - 4 * (safe - 1) / safe + ((safe - 1) / safe).square()
        return torch.where(below, self.scale / 6 * curvature, 0.0)

    def friction(self, normal_force: Tensor, coefficient: Tensor, sliding: Tensor) -> Tensor:
        """[..., 3] force against the tangential velocity `sliding` [..., 3] [m/s]."""
        speed = safe_norm(sliding)
        return -(coefficient * normal_force * self._per_speed(speed))[..., None] * sliding

    def _per_speed(self, speed: Tensor) -> Tensor:
        """f(|v|)/|v|, finite at rest [s/m]."""
        sticking = (2 - speed / self.sticking_speed) / self.sticking_speed
        return torch.where(speed < self.sticking_speed, sticking, 1 / speed)

    def place_forces(
        self,
        weights: Tensor,
        share: Tensor,
        start: Tensor,
        end: Tensor,
        coefficient: Tensor,
        time_step: float,
    ) -> Tensor:
        """Forces on the four points of pairs, summed over the places where each pair may touch.

        Args:
            weights: [C, S, 4] signed weights of S places.
            share: [C, S] area that counts for each place, negative where it is taken off [m²].
            start, end: [C, 4, 3] positions at both ends of the step [m].
            coefficient: [C] of friction.

        Returns:
            [C, 4, 3] [N].
        """
        distance, normal, sliding = _meeting(weights, start, end, time_step)
        force = share * self.pressure(distance)
        push = force[..., None] * normal + self.friction(force, coefficient[:, None], sliding)
        return weights.mT @ push

    def place_stiffness(
        self,
        weights: Tensor,
        share: Tensor,
        start: Tensor,
        end: Tensor,
        coefficient: Tensor,
        time_step: float,
    ) -> Tensor:
        """What of -d forces / d end resists motion, with places and normals held: positive semidefinite.

        Arguments as for `place_forces`.

        Returns:
            [C, 12, 12] [N/m].
        """
        distance, normal, sliding = _meeting(weights, start, end, time_step)
        counted = share.clamp(min=0)
        along = counted * self.stiffness(distance)
        rubbing = counted * self.pressure(distance) * coefficient[:, None] * self._per_speed(safe_norm(sliding)) / time_step
        identity = torch.eye(3, dtype=end.dtype, device=end.device)
        both = (along - rubbing)[..., None, None] * normal[..., :, None] * normal[..., None, :]
        local = both + rubbing[..., None, None] * identity  # [C, S, 3, 3]
        return torch.einsum("csi,csj,csab->ciajb", weights, weights, local).reshape(len(end), 12, 12)


def _meeting(weights: Tensor, start: Tensor, end: Tensor, time_step: float) -> tuple[Tensor, Tensor, Tensor]:
    """(distance [C, S], unit normal [C, S, 3], sliding velocity [C, S, 3]) at the end of the step."""
    gap = weights @ end
    distance = safe_norm(gap)
    normal = gap / distance[..., None]
    velocity = weights @ ((end - start) / time_step)
    return distance, normal, velocity - (velocity * normal).sum(-1, keepdim=True) * normal


def point_face_places(corners: Tensor, edge_share: Tensor, point_share: Tensor) -> tuple[Tensor, Tensor]:
    """The seven places of a point and a face: the face, its three edges, its three corners.

    Args:
        corners: [C, 4, 3] [m].
        edge_share, point_share: [C, 3] what the face takes off for each edge and adds for each corner.

    Returns:
        Weights [C, 7, 4] and the share of each place [C, 7].
    """
    face = point_face_weights(corners)
    point, a, b, c = corners.unbind(1)
    zero, one = torch.zeros_like(face[:, 0]), torch.ones_like(face[:, 0])
    fractions = []
    for first, second in ((a, b), (b, c), (c, a)):
        along = second - first
        fractions.append((((point - first) * along).sum(-1) / along.square().sum(-1).clamp(min=_TINY)).clamp(0, 1))
    s, t, u = fractions
    rows = [
        [one, s - 1, -s, zero],
        [one, zero, t - 1, -t],
        [one, -u, zero, u - 1],
        [one, -one, zero, zero],
        [one, zero, -one, zero],
        [one, zero, zero, -one],
    ]
    others = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=1)
    share = torch.cat([torch.ones_like(edge_share[:, :1]), -edge_share, point_share], dim=1)
    return torch.cat([face[:, None], others], dim=1), share


def edge_edge_places(corners: Tensor) -> tuple[Tensor, Tensor]:
    """The one place of two edges: weights [C, 1, 4], and its share [C, 1], which fades as the edges become parallel."""
    u, v = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 2]
    cross = torch.linalg.cross(u, v).square().sum(-1)
    ratio = cross / (_PARALLEL * u.square().sum(-1) * v.square().sum(-1)).clamp(min=_TINY)
    share = torch.where(ratio < 1, ratio * (2 - ratio), 1.0)
    return edge_edge_weights(corners)[:, None], share[:, None]
