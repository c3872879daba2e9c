"""Repulsion and lagged friction between meshes, as terms of the linearised step (ARCSim).

A pair at distance h, with n turned so that h > 0, violates the thickness τ by c = max(τ - h, 0). Energy K c³/(6 τ) with
K = k_c times the smaller area; force K c²/(2 τ) along n, stiffness K c/τ, shared over the four points by the weights w.
Friction is γ = min(μ f_n/|P v|, 1/(Δt Σ w_k²/m_k)) times the sliding velocity P v, P = I - n nᵀ. In γ the force f_n and
the velocity v = Σ w_k v_k are those of the start of the step; the sliding velocity itself is implicit.

Which pairs. Each point, edge and face has a slot on each of its two sides that keeps only the nearest pair. A pair that
holds two slots counts twice in the original (`count_once` off).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffcloud.sim.contact.frames import MeetingPairs, along
from diffcloud.sim.contact.pairs import candidates
from diffcloud.sim.contact.surface import ContactSurface
from diffcloud.sim.elements import safe_norm
from diffcloud.sim.linear_solve import Couplings

_OUTSIDE = 1e-6
_TINY = 1e-12


@dataclass(frozen=True)
class ProximitySettings:
    """Numbers of the repulsion."""

    stiffness: float
    """k_c [N/m³]: times the smaller area of a pair gives its stiffness per length."""
    thickness: float
    """τ [m]"""
    smallest: float = 0.0
    """[m⁴] Pairs with |a × b|² below are no contacts (ARCSim: 1e-6)."""
    count_once: bool = True
    """Whether a pair that holds the slots of both its primitives counts once (ARCSim: twice)."""


@dataclass(frozen=True)
class Slots:
    """Two slots for each point, face and edge of a surface, and what obstacles alone put there."""

    point_count: int
    face_count: int
    held: Tensor
    """[2 (P + F + E)] distance of the nearest pair of two obstacles, infinite where none [m]."""

    @staticmethod
    def build(surface: ContactSurface, settings: ProximitySettings, points: Tensor) -> Slots:
        """Fill the slots with the pairs of different obstacles, which keep cloth pairs out.

        Args:
            points: [1, N, 3] at the start; obstacles do not move.
        """
        empty = points.new_full((2 * (len(surface.points) + len(surface.faces) + len(surface.edges)),), torch.inf)
        slots = Slots(len(surface.points), len(surface.faces), empty)
        pairs = MeetingPairs.join(candidates(surface, (points,), settings.thickness, among_fixed=True))
        owner = surface.owner[pairs.points]
        pairs = pairs.where((owner > 0).all(1) & (owner[:, 0] != owner[:, 3]))
        pairs, distance, _ = _near(surface, settings, pairs, points)
        if not len(pairs):
            return slots
        index = slots.index(surface, pairs, points).flatten()
        return replace(slots, held=empty.scatter_reduce(0, index, distance.repeat_interleave(2), "amin"))

    def index(self, surface: ContactSurface, pairs: MeetingPairs, points: Tensor) -> Tensor:
        """[C, 2] the slot, within its entry, that a pair takes of each of its primitives."""
        corners = pairs.gather(points)
        normal = pairs.frames(corners).normals
        around = pairs.gather(point_normals(surface, points))
        is_edge = pairs.edge_edge == 1
        own = torch.where(is_edge[:, None], around[:, 0] + around[:, 1], around[:, 0])
        # a face's own normal is the pair's normal: the first side of faces stays empty
        other = torch.where(is_edge[:, None], around[:, 2] + around[:, 3], normal)
        side = torch.stack([(normal * own).sum(-1) < 0, (normal * other).sum(-1) > 0], dim=-1)
        edges = self.point_count + self.face_count
        offset = torch.stack([is_edge * edges, torch.where(is_edge, edges, self.point_count)], dim=-1)
        return 2 * (pairs.primitives + offset) + side


@dataclass(frozen=True)
class Proximity:
    """The pairs of one step that repel, C in all entries. Chosen without gradients."""

    settings: ProximitySettings
    cloth_points: int
    pairs: MeetingPairs
    sign: Tensor
    """[C] that turns the normal towards the first primitive."""
    count: Tensor
    """[C] how often the pair counts."""
    with_obstacle: Tensor
    """bool [C]"""
    batch: int

    def at(
        self,
        points: Tensor,
        velocities: Tensor,
        inverse_mass: Tensor,
        friction: tuple[Tensor, Tensor],
        time_step: float,
    ) -> ProximityContact:
        """Forces linearised at the start of the step.

        Args:
            points, velocities: [B, N, 3] of cloth and obstacles.
            inverse_mass: [B, N], zero for obstacles [1/kg].
            friction: Coulomb coefficients [B] with obstacles and among cloth.
        """
        copies = len(points) // self.batch
        pairs = self.pairs.repeated(copies, self.batch)
        sign, count, mixed = self.sign.repeat(copies), self.count.repeat(copies), self.with_obstacle.repeat(copies)
        corners = pairs.gather(points)
        frames = pairs.frames(corners)
        normals = sign[:, None] * frames.normals
        height = (normals * along(frames.weights, corners)).sum(-1)
        thickness = self.settings.thickness
        violation = (thickness - height).clamp(min=0)
        stiffness = violation * (self.settings.stiffness / thickness * pairs.area)
        normal_force = 0.5 * stiffness * violation
        velocity = along(frames.weights, pairs.gather(velocities))
        sliding = velocity - (normals * velocity).sum(-1, keepdim=True) * normals
        coefficient = torch.where(mixed, friction[0][pairs.entry], friction[1][pairs.entry])
        limit = coefficient * normal_force
        inverse = (frames.weights.square() * pairs.gather(inverse_mass)).sum(-1)
        gamma = limit / torch.maximum(safe_norm(sliding), limit * time_step * inverse + _TINY)
        return ProximityContact(
            self, pairs, frames.weights, normals, count * normal_force, count * stiffness, count * gamma
        )


@dataclass(frozen=True)
class ProximityContact:
    """Repulsion and friction at one configuration; already counted as often as each pair counts."""

    of: Proximity
    pairs: MeetingPairs
    weights: Tensor
    """[C, 4]"""
    normals: Tensor
    """[C, 3]"""
    normal_force: Tensor
    """[C] [N]"""
    stiffness: Tensor
    """[C] [N/m]"""
    gamma: Tensor
    """[C] [N·s/m]"""

    def forces(self, displacement: Tensor, sliding: Tensor) -> Tensor:
        """[B, V, 3] repulsion after a `displacement` [m] and friction of the velocity `sliding` [m/s], both [B, V, 3]."""
        batch, nodes, _ = sliding.shape
        cloth = self.pairs.points < nodes
        weights = self.weights * cloth  # obstacles rest
        index = self.pairs.entry[:, None] * nodes + self.pairs.points.clamp(max=nodes - 1)
        both = torch.cat([displacement, sliding], dim=-1).flatten(0, 1)[index.flatten()].view(*index.shape, 6)
        moved, slid = along(weights, both).split(3, dim=-1)
        normals = self.normals
        pressure = self.normal_force - self.stiffness * (normals * moved).sum(-1) + self.gamma * (normals * slid).sum(-1)
        total = pressure[:, None] * normals - self.gamma[:, None] * slid
        shares = (weights[..., None] * total[:, None]).flatten(0, 1)
        return shares.new_zeros(batch * nodes, 3).index_add(0, index.flatten(), shares).view(batch, nodes, 3)

    def couplings(self, time_step: float) -> Couplings:
        """Δt² (repulsion stiffness) + Δt (friction) of all pairs of cloth nodes, the contact's part of the step matrix."""
        outer = self.normals[:, :, None] * self.normals[:, None, :]
        identity = torch.eye(3, dtype=outer.dtype, device=outer.device)
        friction = (time_step * self.gamma)[:, None, None]
        core = (time_step**2 * self.stiffness)[:, None, None] * outer + friction * (identity - outer)  # [C, 3, 3]
        blocks = (self.weights[:, :, None] * self.weights[:, None, :])[..., None, None] * core[:, None, None]
        points = self.pairs.points
        rows, columns = points[:, :, None].expand(-1, -1, 4), points[:, None, :].expand(-1, 4, -1)
        cloth = (rows < self.of.cloth_points) & (columns < self.of.cloth_points)
        entry = self.pairs.entry[:, None, None].expand_as(rows)
        return Couplings(entry[cloth], rows[cloth], columns[cloth], blocks[cloth])


@torch.no_grad()
def find_proximity(surface: ContactSurface, settings: ProximitySettings, slots: Slots, points: Tensor) -> Proximity | None:
    """The pairs that repel at points [B, N, 3], none if there are none."""
    points = points.detach()
    pairs = MeetingPairs.join(candidates(surface, (points,), settings.thickness))
    if not len(pairs):
        return None
    pairs, distance, sign = _near(surface, settings, pairs, points)
    if not len(pairs):
        return None
    batch = len(points)
    index = slots.index(surface, pairs, points) + pairs.entry[:, None] * len(slots.held)
    nearest = slots.held.repeat(batch).scatter_reduce(0, index.flatten(), distance.repeat_interleave(2), "amin")
    wins = distance[:, None] <= nearest[index]
    # of several equally near pairs the first of the list has the slot
    number = torch.arange(len(pairs), device=index.device)[:, None].expand_as(index)
    none = torch.full_like(nearest, len(pairs), dtype=torch.long)
    first = none.scatter_reduce(0, index[wins], number[wins], "amin")
    count = (wins & (first[index] == number)).sum(1)
    if settings.count_once:
        count = count.clamp(max=1)
    kept = count > 0
    if not bool(kept.any()):
        return None
    pairs, sign, count = pairs.where(kept), sign[kept], count[kept].to(points.dtype)
    with_obstacle = (pairs.points >= surface.cloth_points).any(1)
    return Proximity(settings, surface.cloth_points, pairs, sign, count, with_obstacle, batch)


def _near(
    surface: ContactSurface, settings: ProximitySettings, pairs: MeetingPairs, points: Tensor
) -> tuple[MeetingPairs, Tensor, Tensor]:
    """(pairs nearer than the thickness, their distance [C], the sign [C] that turns their normals)."""
    corners = pairs.gather(points)
    frames = pairs.frames(corners)
    height = (frames.normals * along(frames.weights, corners)).sum(-1)
    # pairs between one and two thicknesses hold slots in the original, but without force, and never against a nearer one
    keep = (frames.square > 0) & (frames.square >= settings.smallest) & (height.abs() < settings.thickness)
    keep &= pairs.covers(frames.weights, _OUTSIDE)
    pairs, corners, weights, height = pairs.where(keep), corners[keep], frames.weights[keep], height[keep]
    outside = torch.ones_like(height, dtype=torch.bool)
    is_edge = (pairs.edge_edge == 1).nonzero().flatten()
    if len(is_edge):
        edges = pairs.where(is_edge)
        ends, shares = corners[is_edge].view(-1, 2, 2, 3), weights[is_edge].view(-1, 2, 2).abs()
        places = (shares[..., None] * ends).sum(2)  # [C, 2, 3] on each edge
        normals = face_normals(surface, points)
        outside[is_edge] = _on_outer_side(surface, edges.entry, edges.primitives[:, 1], ends[:, 1], places[:, 0], normals)
        outside[is_edge] &= _on_outer_side(surface, edges.entry, edges.primitives[:, 0], ends[:, 0], places[:, 1], normals)
    sign = torch.where(height < 0, -1.0, 1.0).to(height.dtype)
    return pairs.where(outside), height[outside].abs(), sign[outside]


def _on_outer_side(
    surface: ContactSurface, entry: Tensor, edge: Tensor, ends: Tensor, place: Tensor, normals: Tensor
) -> Tensor:
    """[C] whether a place lies beyond the edge for each face at it; a missing face does not object."""
    faces = surface.edge_faces[edge]  # [C, 2]
    along_edge = torch.stack([ends[:, 1] - ends[:, 0], ends[:, 0] - ends[:, 1]], dim=1)
    outward = torch.linalg.cross(along_edge, normals[entry[:, None], faces.clamp(min=0)])
    beyond = (outward * (place[:, None] - ends)).sum(-1) >= 0
    return (beyond | (faces < 0)).all(1)


def face_normals(surface: ContactSurface, points: Tensor) -> Tensor:
    """[B, F, 3] unit normals."""
    corner = points[:, surface.faces]
    normal = torch.linalg.cross(corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0])
    return normal / safe_norm(normal)[..., None]


def point_normals(surface: ContactSurface, points: Tensor) -> Tensor:
    """[B, N, 3] unit normals after Max 1999: along the sum over corners of (e1 × e2)/(|e1|² |e2|²)."""
    corner = points[:, surface.faces]  # [B, F, 3, 3]
    following, before = corner.roll(-1, 2) - corner, corner.roll(1, 2) - corner
    weight = (following.square().sum(-1) * before.square().sum(-1)).clamp(min=1e-300)
    share = torch.linalg.cross(following, before) / weight[..., None]
    total = torch.zeros_like(points).index_add(1, surface.faces.flatten(), share.flatten(1, 2))
    return total / safe_norm(total)[..., None]
