"""Smooth contact of all points of a scene: which places count, their forces, their Jacobian, and how far a step may go.

All functions take positions of *points* [B, N, 3] (cloth nodes, then points of obstacles, then of bodies), not degrees of
freedom: what moves the points is the integrator's business.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffcloud.sim.contact.additive_ccd import pair_distance, safe_fraction
from diffcloud.sim.contact.barrier import Barrier, edge_edge_places, point_face_places
from diffcloud.sim.contact.pairs import Pairs, candidates
from diffcloud.sim.contact.surface import ContactSurface
from diffcloud.sim.jacobian import element_jacobian

_CLOSEST = 1e-6
"""Part of the thickness below which nothing may come closer."""
_LEFT = 0.2
"""Part of the distance to a half-space that a step leaves."""


@dataclass(frozen=True)
class PlaneContacts:
    """Points that half-spaces n · x >= offset repel."""

    normals: Tensor
    """[P, 3] unit."""
    offsets: Tensor
    """[P] [m]"""
    points: Tensor
    """[Q] points that meet them."""
    area: Tensor
    """[Q] [m²]"""

    def gap(self, points: Tensor) -> Tensor:
        """[B, Q, P] [m]."""
        return points[:, self.points] @ self.normals.T - self.offsets


@dataclass(frozen=True)
class Near:
    """Pairs that may touch during a step."""

    lists: tuple[Pairs, ...]
    held: Tensor | None
    """bool [N] points whose motion is prescribed; None: none."""
    reference: Tensor
    """[B, N, 3] a configuration at which distances are known [m]."""
    distances: tuple[Tensor, ...]
    """Of each list at the reference [m]."""

    def repeated(self, copies: int, batch: int) -> Near:
        if copies == 1:
            return self
        return Near(
            tuple(pairs.repeated(copies, batch) for pairs in self.lists),
            self.held,
            self.reference.repeat(copies, 1, 1),
            tuple(distance.repeat(copies) for distance in self.distances),
        )


@dataclass(frozen=True)
class Measured:
    """Pairs near each other at one configuration."""

    near: Near
    distances: tuple[Tensor, ...]
    """Of each list of `near`, or a lower bound where that is beyond the thickness [m]."""
    touching: tuple[Pairs, ...]
    """Those closer than the thickness."""


@dataclass(frozen=True)
class ContactBlocks:
    """d forces / d positions of end-of-step points, as 3 x 3 blocks."""

    entry: Tensor
    """[K] batch entry."""
    row: Tensor
    """[K] point that feels the force."""
    column: Tensor
    """[K] point that moves."""
    values: Tensor
    """[K, 3, 3] [N/m]"""


@dataclass(frozen=True)
class SmoothContact:
    """Contact of everything with everything."""

    barrier: Barrier
    surface: ContactSurface
    planes: PlaneContacts | None

    def near(self, places: tuple[Tensor, ...], margin: float, held: Tensor | None) -> Near:
        """Pairs that come within `margin` and the thickness while points stay near `places`, each [B, N, 3].

        Args:
            held: bool [N] points whose motion is prescribed; what only such points could resolve is left out.
        """
        lists = []
        for pairs in candidates(self.surface, places, margin + self.barrier.thickness):
            if held is not None and len(pairs):
                pairs = pairs.where(~held[pairs.points].all(-1))
            if len(pairs):
                lists.append(pairs)
        reference = places[0].detach()
        return Near(tuple(lists), held, reference, tuple(pair_distance(p.kind, p.gather(reference)) for p in lists))

    def measure(self, near: Near, points: Tensor) -> Measured:
        """Distances of all pairs at `points` [B, N, 3]; they are not differentiable, forces are."""
        points = points.detach()
        moved = (points - near.reference).norm(dim=-1).flatten()
        distances, touching = [], []
        for pairs, reference in zip(near.lists, near.distances, strict=True):
            # a pair cannot have come closer than its points have moved: most need no look at their geometry
            reach = moved[pairs.entry[:, None] * points.shape[1] + pairs.points]
            split = 1 if pairs.kind == "point_face" else 2
            distance = reference - reach[:, :split].amax(1) - reach[:, split:].amax(1)
            maybe = (distance < self.barrier.thickness).nonzero().flatten()
            chosen = pairs.where(maybe)
            exact = pair_distance(pairs.kind, chosen.gather(points))
            distances.append(distance.index_copy(0, maybe, exact))
            close = (exact < self.barrier.thickness).nonzero().flatten()
            if len(close):
                touching.append(chosen.where(close))
        return Measured(near, tuple(distances), tuple(touching))

    def forces(
        self,
        measured: Measured,
        start: Tensor,
        end: Tensor,
        friction_obstacle: Tensor,
        friction_cloth: Tensor,
        time_step: float,
    ) -> Tensor:
        """[B, N, 3] on the points [N].

        Args:
            start, end: [B, N, 3] at both ends of the step [m].
            friction_obstacle, friction_cloth: [B] [-].
        """
        total = torch.zeros_like(end)
        if self.planes is not None:
            planes = self.planes
            pushed = self._plane_forces(start[:, planes.points], end[:, planes.points], friction_obstacle, time_step)
            total = total.index_add(1, planes.points, pushed)
        for pairs in measured.touching:
            coefficient = self._coefficient(pairs, friction_obstacle, friction_cloth)
            forces = self._pair_forces(pairs, pairs.gather(start), pairs.gather(end), coefficient, time_step)
            index = (pairs.entry[:, None] * end.shape[1] + pairs.points).flatten()
            total = total.flatten(0, 1).index_add(0, index, forces.flatten(0, 1)).view_as(end)
        return total

    def blocks(
        self,
        measured: Measured,
        start: Tensor,
        end: Tensor,
        friction_obstacle: Tensor,
        friction_cloth: Tensor,
        time_step: float,
        *,
        caution: Tensor | None = None,
    ) -> list[ContactBlocks]:
        """d forces / d end, arguments as for `forces`.

        Args:
            caution: [B] in [0, 1], so much of a negative semidefinite matrix near it instead.
        """
        found = []
        if self.planes is not None:
            planes = self.planes
            chosen, at = start[:, planes.points], end[:, planes.points]
            close = (planes.gap(end) < self.barrier.thickness).any(-1)
            if bool(close.any()):

                def push(moved: Tensor, copies: int) -> Tensor:
                    return self._plane_forces(
                        chosen.repeat(copies, 1, 1), moved, friction_obstacle.repeat(copies), time_step
                    )

                entry, point = close.nonzero(as_tuple=True)
                values = element_jacobian(push, at, 3)[entry, point]
                if caution is not None:
                    values = values + caution[entry][:, None, None] * (_resisting(values) - values)
                found.append(ContactBlocks(entry, planes.points[point], planes.points[point], values))
        for pairs in measured.touching:
            coefficient = self._coefficient(pairs, friction_obstacle, friction_cloth)
            first, last = pairs.gather(start), pairs.gather(end)

            def pair_push(
                moved: Tensor, copies: int, pairs: Pairs = pairs, first: Tensor = first, mu: Tensor = coefficient
            ) -> Tensor:
                corners = moved.view(-1, 4, 3)
                forces = self._pair_forces(
                    pairs.repeated(copies, 0), first.repeat(copies, 1, 1), corners, mu.repeat(copies), time_step
                )
                return forces.flatten(1)

            if caution is not None:
                weights, share = self._places(pairs, last)
                values = -self.barrier.place_stiffness(weights, share, first, last, coefficient, time_step)
            if caution is None or bool((caution < 1).any()):
                exact = element_jacobian(pair_push, last.flatten(1), 12)
                values = exact if caution is None else exact + caution[pairs.entry][:, None, None] * (values - exact)
            values = values.view(-1, 4, 3, 4, 3).transpose(2, 3)
            found.append(
                ContactBlocks(
                    pairs.entry[:, None].expand(-1, 16).flatten(),
                    pairs.points[:, :, None].expand(-1, 4, 4).flatten(),
                    pairs.points[:, None, :].expand(-1, 4, 4).flatten(),
                    values.reshape(-1, 3, 3),
                )
            )
        return found

    def safe_fraction(self, measured: Measured, start: Tensor, end: Tensor) -> Tensor:
        """[B] in [0, 1]: how far all points of an entry may go straight from `start` to `end` without touching.

        Args:
            measured: at `start`.
            start, end: [B, N, 3] [m].
        """
        near, floor = measured.near, _CLOSEST * self.barrier.thickness
        allowed = start.new_ones(len(start))
        if self.planes is not None:
            before, after = self.planes.gap(start), self.planes.gap(end)
            through = after < 0.5 * _LEFT * before
            if near.held is not None:
                through &= ~near.held[self.planes.points][:, None]
            closing = (before - after).clamp(min=1e-300)
            allowed = torch.where(through, (1 - _LEFT) * before / closing, 1.0).flatten(1).amin(1)
        for pairs, distance in zip(near.lists, measured.distances, strict=True):
            first, last = pairs.gather(start), pairs.gather(end)
            allowed = safe_fraction(pairs.kind, pairs.entry, first, last, distance, allowed, floor)
        return allowed

    def closest(self, measured: Measured, positions: Tensor) -> tuple[Tensor, list[str]]:
        """([B] smallest distance of the batch's entries [m], what it is between), infinite where nothing is near."""
        smallest = positions.new_full((len(positions),), torch.inf)
        names = ["nothing"] * len(positions)
        if self.planes is not None:
            gap = self.planes.gap(positions).flatten(1)
            smallest, where = gap.min(1)
            count = len(self.planes.offsets)
            names = [f"point {int(self.planes.points[w // count])} and half-space {int(w % count)}" for w in where]
        for pairs in measured.near.lists:
            distance = pair_distance(pairs.kind, pairs.gather(positions))
            for entry in range(len(positions)):  # for reports and errors only
                own = (pairs.entry == entry).nonzero().flatten()
                if len(own) and float(distance[own].min()) < float(smallest[entry]):
                    least = own[distance[own].argmin()]
                    smallest[entry] = distance[least]
                    names[entry] = f"{pairs.kind.replace('_', '-')} pair of points {pairs.points[least].tolist()}"
        return smallest, names

    def _plane_forces(self, start: Tensor, end: Tensor, coefficient: Tensor, time_step: float) -> Tensor:
        """[B, Q, 3] on the planes' points."""
        planes = self.planes
        assert planes is not None
        gap = end @ planes.normals.T - planes.offsets  # [B, Q, P]
        force = planes.area[:, None] * self.barrier.pressure(gap)
        velocity = ((end - start) / time_step)[:, :, None]
        sliding = velocity - (velocity * planes.normals).sum(-1, keepdim=True) * planes.normals
        rubbing = self.barrier.friction(force, coefficient[:, None, None], sliding)
        return force @ planes.normals + rubbing.sum(2)

    def _pair_forces(self, pairs: Pairs, start: Tensor, end: Tensor, coefficient: Tensor, time_step: float) -> Tensor:
        weights, share = self._places(pairs, end)
        return self.barrier.place_forces(weights, share, start, end, coefficient, time_step)

    def _places(self, pairs: Pairs, corners: Tensor) -> tuple[Tensor, Tensor]:
        """Weights [C, S, 4] of the places of each pair and the area [C, S] that counts for each [m²]."""
        surface = self.surface
        if pairs.kind == "edge_edge":
            weights, share = edge_edge_places(corners)
            return weights, share * pairs.area[:, None]
        point, face = pairs.primitives.unbind(1)
        weights, share = point_face_places(corners, surface.edge_share[face], surface.corner_share[face])
        # one area for all faces of an owner: what is counted twice is then taken off exactly
        area = torch.minimum(surface.point_area[point], surface.typical_face_area[surface.owner[pairs.points[:, 1]]])
        return weights, share * area[:, None]

    def _coefficient(self, pairs: Pairs, obstacle: Tensor, cloth: Tensor) -> Tensor:
        """[C] friction of each pair: the cloth's own, or that of anything with an obstacle."""
        second = 1 if pairs.kind == "point_face" else 2
        owner = self.surface.owner[pairs.points[:, [0, second]]]
        return torch.where((owner == 0).all(-1), cloth[pairs.entry], obstacle[pairs.entry])


def _resisting(blocks: Tensor) -> Tensor:
    """[K, 3, 3] -> the negative semidefinite part of the symmetric part."""
    values, vectors = torch.linalg.eigh(0.5 * (blocks + blocks.mT))
    return (vectors * values.clamp(max=0)[..., None, :]) @ vectors.mT
