"""Contact of the linearised step with meshes and of the cloth with itself: proximity, then impact zones (ARCSim)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from diffcloud.mesh.topology import ClothMesh, SurfaceMesh
from diffcloud.sim.contact.halfspace import ContactSettings
from diffcloud.sim.contact.impact_zones import ImpactSettings, resolve
from diffcloud.sim.contact.proximity import Proximity, ProximitySettings, Slots, find_proximity
from diffcloud.sim.contact.surface import ContactSurface

_ARCSIM_SMALLEST = 1e-6


@dataclass(frozen=True)
class ReferenceContact:
    """Choices in which the reference simulator differs from what one would write today.

    The defaults are the correct variant; `as_published` has the reference's quirks.
    """

    smallest: float = 0.0
    """[m⁴] Pairs whose |a × b|² (cross product of two edges) is below never touch."""
    count_once: bool = True
    """Whether a pair that is nearest for both its primitives repels once, not twice."""
    residue: float = 0.0
    """Part of each impact correction that is left out; decides ties in the next step."""
    differentiate_normals: bool = True
    """Whether derivatives include how times, weights and normals of impacts move."""
    impact_friction: bool = False
    """Whether impacts rub too; in the original only proximity does."""

    @staticmethod
    def as_published() -> ReferenceContact:
        """What the published trajectories were made with; derivatives stay exact, which the original's are not."""
        return ReferenceContact(_ARCSIM_SMALLEST, count_once=False, residue=1e-9)


@dataclass(frozen=True)
class MeshContact:
    """The meshes of a run and how they touch."""

    surface: ContactSurface
    obstacle_points: Tensor
    """[1, N - V, 3]"""
    impacts: ImpactSettings
    proximity: ProximitySettings | None
    """None: no repulsion and no friction, only impacts."""
    slots: Slots | None

    @staticmethod
    def build(
        cloth: ClothMesh,
        obstacles: Sequence[SurfaceMesh],
        numbers: ContactSettings,
        choices: ReferenceContact,
        *,
        proximity: bool,
        dtype: torch.dtype,
        device: torch.device,
    ) -> MeshContact:
        surface = ContactSurface.build(cloth, obstacles, all_edges=True, dtype=dtype, device=device)
        rigid = [torch.as_tensor(mesh.nodes, dtype=dtype, device=device) for mesh in obstacles]
        points = torch.cat(rigid)[None] if rigid else torch.zeros(1, 0, 3, dtype=dtype, device=device)
        repulsion, slots = None, None
        if proximity:
            repulsion = ProximitySettings(
                numbers.stiffness, numbers.repulsion_thickness, choices.smallest, choices.count_once
            )
            start = torch.cat([torch.as_tensor(cloth.nodes, dtype=dtype, device=device)[None], points], dim=1)
            slots = Slots.build(surface, repulsion, start)
        impacts = ImpactSettings(
            numbers.projection_thickness,
            choices.smallest,
            choices.residue,
            choices.differentiate_normals,
            choices.impact_friction,
        )
        return MeshContact(surface, points, impacts, repulsion, slots)

    def all_points(self, cloth: Tensor) -> Tensor:
        """[B, V, 3] -> [B, N, 3] with the obstacles' points."""
        return torch.cat([cloth, self.obstacle_points.expand(len(cloth), -1, -1)], dim=1)

    def with_rest(self, cloth: Tensor) -> Tensor:
        """[B, V, ...] -> [B, N, ...] with zeros for the obstacles."""
        fill = cloth.new_zeros(len(cloth), self.obstacle_points.shape[1], *cloth.shape[2:])
        return torch.cat([cloth, fill], dim=1)

    def near(self, positions: Tensor) -> Proximity | None:
        """The pairs that repel at positions [B, V, 3]."""
        if self.proximity is None or self.slots is None:
            return None
        return find_proximity(self.surface, self.proximity, self.slots, self.all_points(positions))

    def resolve(
        self,
        start: Tensor,
        candidate: Tensor,
        inverse_mass: Tensor,
        friction: tuple[Tensor, Tensor],
        *,
        step: int,
        copies: int = 1,
    ) -> Tensor:
        """[B, V, 3] candidate positions with all impacts since `start` resolved; see `impact_zones.resolve`.

        Raises:
            UnresolvedContactError: names step, batch entries and a pair.
        """
        found = resolve(
            self.surface,
            self.impacts,
            self.all_points(start),
            self.all_points(candidate),
            self.with_rest(inverse_mass),
            friction,
            step=step,
            copies=copies,
        )
        return found[:, : candidate.shape[1]]
