"""Repulsion and lagged friction of one pair in torch, line by line as defined, and the nearest pairs by loops."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffcloud.sim.contact.surface import Surface
from tests.arcsim.twins.meeting import EDGES, Floats, meeting, on_both, square


@dataclass
class Pair:
    """One pair and all that its force depends on."""

    kind: int
    positions: Tensor
    """[4, 3] at the start of the step [m]."""
    before: Tensor
    """[4, 3] velocities then [m/s]."""
    after: Tensor
    """[4, 3] velocities at its end [m/s]."""
    inverse_mass: Tensor
    """[4] [1/kg]"""
    friction: Tensor
    """μ"""
    sign: float
    """Turns the normal towards the first primitive."""
    count: float
    stiffness: float
    """K = k_c times the area [N/m]."""
    thickness: float
    """τ [m]"""
    time_step: float
    """[s]"""

    def at(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """(weights [4], normal [3], normal force, stiffness, friction factor γ) at the start of the step."""
        x = self.positions
        if self.kind == EDGES:
            a, b, d = x[1] - x[0], x[3] - x[2], x[2] - x[0]
            c = torch.linalg.cross(a, b)
            normal = c / c.norm()
            alpha, beta, _ = torch.linalg.solve(torch.stack([a, -b, -normal], dim=1), d)
            weights = torch.stack([1 - alpha, alpha, beta - 1, -beta])
        else:
            a, b, d = x[2] - x[1], x[3] - x[1], x[0] - x[1]
            c = torch.linalg.cross(a, b)
            normal = c / c.norm()
            alpha, beta, _ = torch.linalg.solve(torch.stack([a, b, normal], dim=1), d)
            weights = torch.stack([torch.ones_like(alpha), alpha + beta - 1, -alpha, -beta])
        normal = self.sign * normal
        violation = (self.thickness - normal @ (weights @ x)).clamp(min=0)  # c = max(τ - h, 0)
        force = self.stiffness * violation**2 / (2 * self.thickness)
        stiffness = self.stiffness * violation / self.thickness
        velocity = weights @ self.before
        sliding = velocity - (normal @ velocity) * normal
        speed = (sliding @ sliding).clamp(min=1e-30).sqrt()  # no derivative at rest
        inverse = (weights**2 * self.inverse_mass).sum()
        # γ = min(μ f/|P v|, 1/(Δt Σ w²/m))
        gamma = self.friction * force / torch.maximum(speed, self.friction * force * self.time_step * inverse + 1e-12)
        return weights, normal, force, stiffness, gamma

    def forces(self) -> Tensor:
        """[4, 3] [N]"""
        weights, normal, force, stiffness, gamma = self.at()
        velocity = weights @ self.after
        repulsion = (force - stiffness * (normal @ (self.time_step * velocity))) * normal
        friction = -gamma * (velocity - (normal @ velocity) * normal)
        return self.count * weights[:, None] * (repulsion + friction)

    def step_matrix(self) -> Tensor:
        """[4, 4, 3, 3] count · w_a w_b (Δt² K c/τ n nᵀ + Δt γ (I - n nᵀ)): -Δt times the derivative by velocities."""
        weights, normal, _, stiffness, gamma = self.at()
        along = torch.outer(normal, normal)
        across = torch.eye(3, dtype=torch.float64) - along
        core = self.count * (self.time_step**2 * stiffness * along + self.time_step * gamma * across)
        return torch.einsum("a,b,ij->abij", weights, weights, core)


def nearest_pairs(
    surface: Surface, points: Floats, thickness: float, smallest: float = 0.0
) -> dict[tuple[int, ...], tuple[int, float]]:
    """(kind and points of a pair) -> (how many slots it holds, its signed height), by loops over everything."""
    faces, edges, owner = surface.faces, surface.edges, surface.owner
    corner = points[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    node_normal = np.zeros_like(points)
    for face in faces:
        for k in range(3):
            e1, e2 = points[face[(k + 1) % 3]] - points[face[k]], points[face[(k + 2) % 3]] - points[face[k]]
            node_normal[face[k]] += np.cross(e1, e2) / (e1 @ e1 * (e2 @ e2))
    node_normal /= np.linalg.norm(node_normal, axis=1, keepdims=True)
    slots: dict[tuple, tuple[float, tuple[int, ...], float]] = {}

    def offer(primitive: tuple, side: bool, pair: tuple[int, ...], height: float) -> None:
        key = (*primitive, bool(side))
        if key not in slots or abs(height) < slots[key][0]:
            slots[key] = (abs(height), pair, height)

    def look(kind: int, corners: tuple[int, ...]) -> tuple[Floats, Floats, float] | None:
        """(weights, normal, height) of what may touch; beyond the thickness a pair holds slots, but without force."""
        x = points[list(corners)]
        if square(kind, x) == 0 or square(kind, x) < smallest:
            return None
        weights, n = meeting(kind, x)
        height = n @ (weights @ x)
        return (weights, n, height) if abs(height) <= 2 * thickness and on_both(kind, weights) else None

    def meets(a: int, b: int) -> bool:  # not within one obstacle
        return bool(owner[a] != owner[b] or owner[a] == 0)

    def outside(place: Floats, edge: int) -> bool:
        for s in (0, 1):
            face = surface.edge_faces[edge, s]
            q, other = points[edges[edge][s]], points[edges[edge][1 - s]]
            if face >= 0 and (other - q) @ np.cross(normal[face], place - q) < 0:
                return False
        return True

    for node, (index, face) in itertools.product(surface.points, enumerate(faces)):
        if node in face or not meets(node, face[0]):
            continue
        if (found := look(0, (node, *face))) is not None:
            _, n, height = found
            pair = (0, node, *face)
            offer(("point", node), n @ node_normal[node] < 0, pair, height)
            offer(("face", index), -n @ normal[index] < 0, pair, height)
    for first, second in itertools.combinations(range(len(edges)), 2):
        p, q = edges[first], edges[second]
        if set(p) & set(q) or not meets(p[0], q[0]):
            continue
        if (found := look(EDGES, (*p, *q))) is None:
            continue
        weights, n, height = found
        if outside(weights[:2] @ points[p], second) and outside(-weights[2:] @ points[q], first):
            pair = (EDGES, *p, *q)
            offer(("edge", first), n @ (node_normal[p[0]] + node_normal[p[1]]) < 0, pair, height)
            offer(("edge", second), -n @ (node_normal[q[0]] + node_normal[q[1]]) < 0, pair, height)
    held: dict[tuple[int, ...], tuple[int, float]] = {}
    for distance, pair, height in slots.values():
        if distance < thickness and min(pair[1:]) < surface.cloth_points:  # only those push, and obstacles do not move
            key = tuple(int(number) for number in pair)
            held[key] = (held.get(key, (0, 0.0))[0] + 1, float(height))
    return held
