"""Pairs of a point of the simulated surface and a recorded one, in both directions, and what they say of a motion.

Forth, points sampled on the cloth look for the nearest recorded ones; back, recorded points look for the nearest place on
the cloth, or on a body beside it. With r = x - y of such a pair, the loss is the weighted mean of |r|², each capped:
a recorded point of something else, or a part of the cloth that no camera saw, then draws at nothing.

Half of its slope is the mean of r · ∂x. For its curvature, Gauss and Newton would take |∂x|², as if x were bound to y. But
either is a sample of a surface, along which it may slide: with the surface's normal n, and r's own direction t along it,

    curvature = (n · ∂x)² + w (t · ∂x)²,      w = |r_t|² / (|r_t|² + s²),

where s is the distance between recorded points. So w is small inside of the surface and near one where r leads beyond its
rim. (Chen and Medioni 1992 minimise the first part alone.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from diffcloud.clouds.neighbours import NeighbourIndex
from diffcloud.clouds.sampling import SurfacePoints
from diffcloud.clouds.visibility import seen_places
from diffcloud.fit.pose import PoseSpace
from diffcloud.fit.targets import Target


@dataclass(frozen=True)
class Pairs:
    """B motions, L frames, N pairs in each."""

    places: SurfacePoints
    """[B, L, N] on the surface."""
    partners: Tensor
    """[B, L, N, 3] recorded points, in the recording's frame."""
    normals: Tensor | None
    """[B, L, N, 3] of the surface along which a pair may slide, there too; None: those of the faces on which places lie."""
    spacing: Tensor
    """[L] between recorded points."""
    weights: Tensor
    """[B, L, N]"""
    share: float
    """Of all weights in a frame; where no place counts, they are missing."""

    def losses(self, moved: Tensor, cap: float) -> Tensor:
        """[B, L] what fits minimise of these pairs, differentiable; its slope and curvature are in `fit.curvature`.

        Args:
            moved: [B, L, N, 3] the places in the recording's frame.
            cap: largest distance that counts as itself.
        """
        return self.squares(moved, cap)

    def squares(self, moved: Tensor, cap: float) -> Tensor:
        """[B, L] sums of the weighted squared distances, each capped: what `rms_mm` is the root of, whatever the loss. A
        frame in which no place counts has the largest sum: a motion that hides from the recording explains nothing.

        Args:
            moved, cap: as of `losses`.
        """
        found = (self.weights * (moved - self.partners).square().sum(-1).clamp(max=cap**2)).sum(-1)
        return torch.where(self.weights.sum(-1) > 0, found, self.share * cap**2)

    def scores(self, moved: Tensor, rates: Tensor, cap: float) -> Tensor:
        """[k, B, L, N] what each pair adds to half of the slope.

        Args:
            rates: [k, B, L, N, 3] of the places.
        """
        away = moved - self.partners
        weights = torch.where(away.square().sum(-1) < cap**2, self.weights, 0.0)
        return weights * (rates * away).sum(-1)


@dataclass(frozen=True)
class Motion:
    """B simulated motions at L frames, and how they lie in the recording."""

    nodes: Tensor
    """[B, L, V, 3] of the cloth and of the bodies beside it, in the scene."""
    velocities: Tensor | None
    """[B, L, V, 3], where the lag is free."""
    pose: Tensor
    """[B, d]"""
    pairs: tuple[Pairs, ...]
    """Forth; in the default measure, back too."""

    def shown(self, space: PoseSpace) -> Tensor:
        """[B, L, V, 3] where the nodes are when the recording looks at them."""
        return _shown(self.nodes, self.velocities, self.pose, space)

    def terms(self, space: PoseSpace, rates: Tensor | None, cap: float) -> tuple[Tensor, Tensor, Tensor]:
        """Loss [B], half of its slope [B, k + d] and of its curvature [B, k + d, k + d], by k variables and the pose.

        Args:
            rates: [k, B, L, V', 3] of the first V' nodes, the cloth's; None: k is 0.
            cap: largest distance that counts as itself.
        """
        from diffcloud.fit.curvature import Partners, Placements, Surfaces, sum_terms  # numba takes a moment to import

        nodes, none = self.nodes, self.nodes.new_zeros(0, 1, 1, 3)
        moving = none if self.velocities is None else self.velocities
        changes = nodes.new_zeros(0, 1, nodes.shape[1], 1, 3) if rates is None else rates
        self._check(space, rates)
        surfaces = Surfaces(_array(nodes), _array(moving, 0, 1), _array(changes, 1))
        placements = Placements(*map(_array, space.placements(self.pose)))
        count = len(surfaces.rates) + self.pose.shape[1]
        loss, slope, curvature = (nodes.new_zeros(len(nodes), *[count] * order) for order in range(3))
        sums = loss.numpy(), slope.numpy(), curvature.numpy()
        for one in self.pairs:
            normals = none if one.normals is None else one.normals
            parts = one.places.nodes, one.places.barycentric, one.partners, normals, one.weights
            corners, barycentric, points, normal, weights = (_array(part, 0, 1) for part in parts)
            partners = Partners(corners, barycentric, points, normal, weights, _array(one.spacing))
            sum_terms(surfaces, placements, partners, cap, one.share * cap**2, *sums)
        return loss, slope, curvature

    def _check(self, space: PoseSpace, rates: Tensor | None) -> None:
        """Assert the shapes on which the kernel, which checks no bounds, relies."""
        batch, frames = self.nodes.shape[:2]
        assert self.pose.shape == (batch, len(space.names))
        assert "lag" not in space.names or self.velocities is not None
        assert self.velocities is None or self.velocities.shape == self.nodes.shape
        assert rates is None or rates.shape[1:3] == (batch, frames)
        for one in self.pairs:
            shape = (batch, frames, one.weights.shape[2])
            each = [one.places.nodes, one.places.barycentric, one.partners, *([] if one.normals is None else [one.normals])]
            assert one.weights.shape == shape
            assert len(one.spacing) == frames
            assert all(part.shape == (*shape, 3) for part in each)


def _array(tensor: Tensor, *axes: int) -> Any:
    """The numbers of a tensor as an array; where it is contiguous, they share its memory. Of these axes, those along which
    it was expanded have length one."""
    for axis in axes:
        if tensor.stride(axis) == 0 and tensor.shape[axis] > 1:
            tensor = tensor.narrow(axis, 0, 1)
    return tensor.detach().contiguous().numpy()


class Matcher:
    """Finds the pairs of B motions at one pose after the other: what was found last helps to find what is next."""

    def __init__(
        self,
        target: Target,
        nodes: Tensor,
        velocities: Tensor | None,
        places: SurfacePoints,
        faces: Tensor,
        recorded: tuple[Tensor, Tensor] | None,
        *,
        near: float,
    ) -> None:
        """
        Args:
            target: of L frames.
            nodes: [B, L, V, 3]; velocities likewise, where the lag is free.
            places: [B, L, N] sampled on the cloth.
            faces: [F, 3] of the cloth, and of bodies beside it.
            recorded: [L, Q, 3] points that look for the cloth, and [L, Q] how much each counts; None where none do.
            near: what is nearer to a point hides nothing.
        """
        self._target, self._faces, self._near = target, faces, near
        self._nodes, self._velocities, self._places = nodes, velocities, places
        self._recorded = recorded
        self._seen: Tensor | None = None
        self._found: list[Tensor | None] = [None, None]

    def __call__(self, pose: Tensor, entries: Tensor | None = None) -> Motion:
        """The motions at poses [b, d], with their pairs.

        Args:
            entries: [b] of the motions; None for all, as the first time.
        """
        target = self._target
        nodes, places = self._nodes, self._places
        if entries is not None:
            nodes = nodes[entries]
            places = SurfacePoints(places.nodes[entries], places.barycentric[entries])
        velocities = self._of(self._velocities, entries)
        shown = _shown(nodes, velocities, pose, target.space)
        points = places.of(shown)
        moved = target.space.moved(points, pose)
        if self._seen is None and target.viewpoints is not None:
            eyes = target.space.back(target.viewpoints, pose)
            blind = torch.stack([one.blind(moved) for one in target.lost], dim=-1) if target.lost else None
            self._seen = seen_places(shown, self._faces, points, eyes, near=self._near, blind=blind)
        share, seen = 1.0 if self._recorded is None else 0.5, self._of(self._seen, entries)
        last = [self._of(found, entries) for found in self._found]
        forth, found = pairs_forth(places, moved, target.clouds, cut=target.cut, share=share, seen=seen, guesses=last[0])
        self._keep(0, found, entries)
        pairs = [forth]
        if self._recorded is not None:
            back, found = pairs_back(
                shown,
                self._faces,
                *self._recorded,
                forth.spacing,
                space=target.space,
                pose=pose,
                share=share,
                guesses=last[1],
            )
            self._keep(1, found, entries)
            pairs.append(back)
        return Motion(nodes, velocities, pose, tuple(pairs))

    def look_anew(self) -> None:
        """Forget what the cameras saw at the first pose: so far away that the steps of a search change nothing of it, but a
        loss at its end is that of its own pose."""
        self._seen = None

    def _keep(self, way: int, found: Tensor, entries: Tensor | None) -> None:
        kept = self._found[way]
        if kept is None or entries is None:
            self._found[way] = found
        else:
            kept[entries] = found

    @staticmethod
    def _of(whole: Tensor | None, entries: Tensor | None) -> Tensor | None:
        return whole if whole is None or entries is None else whole[entries]


def _shown(nodes: Tensor, velocities: Tensor | None, pose: Tensor, space: PoseSpace) -> Tensor:
    lag = space.lag(pose)
    if lag is None or velocities is None:
        return nodes
    return nodes + lag[:, None, None, None] * velocities


@torch.no_grad()
def pairs_forth(
    places: SurfacePoints,
    moved: Tensor,
    clouds: Sequence[NeighbourIndex],
    *,
    cut: float | None,
    share: float,
    seen: Tensor | None = None,
    guesses: Tensor | None = None,
) -> tuple[Pairs, Tensor]:
    """Each place with the nearest recorded point of its frame, and the numbers of these points [B, L, N].

    Args:
        moved: [B, L, N, 3] the places in the recording's frame.
        cut: places below this height do not count: the recording ends there.
        share: of all weights.
        seen: bool [B, L, N] which places a camera could see; None for all.
        guesses: [B, L, N] points that may be near; they save time.
    """
    near = [None] * len(clouds) if guesses is None else guesses.unbind(1)
    found = [cloud.nearest_index(moved[:, frame], near[frame]) for frame, cloud in enumerate(clouds)]
    partners = torch.stack([cloud.points[index] for cloud, index in zip(clouds, found, strict=True)], dim=1)
    normals = torch.stack([cloud.normals[index] for cloud, index in zip(clouds, found, strict=True)], dim=1)
    counted = torch.ones_like(moved[..., 0]) if cut is None else (moved[..., 2] >= cut).to(moved)
    if seen is not None:
        counted = counted * seen
    weights = share / len(clouds) * counted / counted.sum(-1, keepdim=True).clamp(min=1.0)
    spacing = moved.new_tensor([cloud.spacing for cloud in clouds])
    return Pairs(places, partners, normals, spacing, weights, share / len(clouds)), torch.stack(found, dim=1)


@torch.no_grad()
def pairs_back(
    positions: Tensor,
    faces: Tensor,
    recorded: Tensor,
    sure: Tensor,
    spacing: Tensor,
    *,
    space: PoseSpace,
    pose: Tensor,
    share: float,
    guesses: Tensor | None = None,
) -> tuple[Pairs, Tensor]:
    """Each recorded point with the nearest place on the surface, and the numbers of the faces there [B, L, Q].

    Args:
        positions: [B, L, V, 3] nodes of the surface.
        faces: [F, 3] of the cloth, and of bodies beside it.
        recorded: [L, Q, 3].
        sure: [L, Q] how much each counts.
        pose: [B, d]
        guesses: [B, L, Q] faces that may be near; they save time.
    """
    places, found = nearest_places(positions, faces, space.back(recorded, pose), guesses)
    weights = share * sure / sure.sum(-1, keepdim=True) / len(recorded)
    batch = len(positions)
    shares = weights.expand(batch, -1, -1)
    return Pairs(places, recorded.expand(batch, -1, -1, -1), None, spacing, shares, share / len(recorded)), found


def nearest_places(
    positions: Tensor, faces: Tensor, queries: Tensor, guesses: Tensor | None = None
) -> tuple[SurfacePoints, Tensor]:
    """The places on faces [F, 3] of meshes at node positions [B, L, V, 3] nearest to queries [B, L, Q, 3], and the numbers
    of their faces [B, L, Q].

    Where a position is no number, the place is the first corner.

    Args:
        guesses: [B, L, Q] faces that may be near; they save time.
    """
    from diffcloud.clouds.surface import NO_GUESS, find_on_surface  # numba takes a moment to import

    states, shape = positions.shape[0] * positions.shape[1], queries.shape[:-1]
    nodes, points = (part.detach().reshape(states, -1, 3).contiguous().numpy() for part in (positions, queries))
    near = NO_GUESS if guesses is None else guesses.reshape(states, -1).contiguous().numpy()
    found, places = (torch.from_numpy(part) for part in find_on_surface(points, near, nodes, faces.numpy()))
    found = found.reshape(shape)
    return SurfacePoints(faces[found], places.reshape(*shape, 3)), found
