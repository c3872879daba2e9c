"""Pairs of a point of the simulated surface and a recorded one, in both directions, and what they say of a motion.

Forth, points sampled on the cloth look for the nearest recorded ones; back, recorded points look for the nearest place on
the cloth, or on a body beside it. With r = x - y of such a pair, the loss is the weighted mean of |r|², each capped:
a recorded point of something else, or a part of the cloth that no camera saw, then draws at nothing.

Half of its slope is the mean of r · ∂x. For its curvature, Gauss and Newton would take |∂x|², as if x were bound to y. But
either is a sample of a surface, along which it may slide: with the surface's normal n, and r's own direction t along it,

    curvature = (n · ∂x)² + w (t · ∂x)²,      w = |r_t|² / (|r_t|² + s²),

where s is the distance between recorded points. So w is small inside of the surface and near one where r leads beyond its
rim. (Chen and Medioni 1992 minimise the first part alone.)

Each camera may have a clock of its own. A motion holds its V nodes once for each of the C clocks, at the times of that
clock, one set after the other. The nodes on which a place lies therefore name its clock. A recorded point belongs to its
camera's clock. A sampled point is compared with the points of each clock, from its place at the time of that clock. Its
partner is the nearest of all.
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
from diffcloud.estimation.pose import PoseSpace
from diffcloud.estimation.targets import Target


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
        """[B, L] what fits minimise of these pairs, differentiable; its slope and curvature are in `estimation.curvature`.

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


@dataclass(frozen=True)
class Motion:
    """B simulated motions at L frames, and how they lie in the recording."""

    nodes: Tensor
    """[B, L, C · V, 3] of the cloth and of the bodies beside it, for each clock, in the scene."""
    velocities: Tensor | None
    """[B, L, C · V, 3], where a lag is free."""
    pose: Tensor
    """[B, d]"""
    pairs: tuple[Pairs, ...]
    """Forth; in the default measure, back too."""

    def shown(self, space: PoseSpace) -> Tensor:
        """[B, L, C · V, 3] where the nodes are when the recording looks at them."""
        return _shown(self.nodes, self.velocities, self.pose, space)

    def terms(self, space: PoseSpace, cap: float) -> tuple[Tensor, Tensor, Tensor]:
        """Loss [B], half of its slope [B, d] and of its curvature [B, d, d], by the pose.

        Args:
            cap: largest distance that counts as itself.
        """
        from diffcloud.estimation.curvature import (  # numba takes a moment to import
            Partners,
            Placements,
            Surfaces,
            sum_terms,
        )

        nodes, none = self.nodes, self.nodes.new_zeros(0, 1, 1, 3)
        moving = none if self.velocities is None else self.velocities
        self._check(space)
        surfaces = Surfaces(_array(nodes), _array(moving, 0, 1))
        placements = Placements(*map(_array, space.placements(self.pose)))
        count = self.pose.shape[1]
        loss, slope, curvature = (nodes.new_zeros(len(nodes), *[count] * order) for order in range(3))
        sums = loss.numpy(), slope.numpy(), curvature.numpy()
        for one in self.pairs:
            normals = none if one.normals is None else one.normals
            parts = one.places.nodes, one.places.barycentric, one.partners, normals, one.weights
            corners, barycentric, points, normal, weights = (_array(part, 0, 1) for part in parts)
            partners = Partners(corners, barycentric, points, normal, weights, _array(one.spacing))
            sum_terms(surfaces, placements, partners, cap, one.share * cap**2, *sums)
        return loss, slope, curvature

    def _check(self, space: PoseSpace) -> None:
        """Assert the shapes on which the kernel, which checks no bounds, relies."""
        batch, frames = self.nodes.shape[:2]
        assert self.pose.shape == (batch, len(space.names))
        assert not space.moves_clocks or self.velocities is not None
        assert self.nodes.shape[2] % len(space.clocks) == 0
        assert self.velocities is None or self.velocities.shape == self.nodes.shape
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


@dataclass(frozen=True)
class Recorded:
    """Q recorded points of each of L frames that look for the cloth, those of one clock after those of another."""

    points: Tensor
    """[L, Q, 3]"""
    sure: Tensor
    """[L, Q] how much each counts."""
    counts: tuple[int, ...]
    """[C] how many of them are of each clock."""


class Matcher:
    """Finds the pairs of B motions at one pose after the other: what was found last helps to find what is next."""

    def __init__(
        self,
        target: Target,
        nodes: Tensor,
        velocities: Tensor | None,
        places: SurfacePoints,
        faces: Tensor,
        recorded: Recorded | None,
        *,
        near: float,
    ) -> None:
        """
        Args:
            target: of L frames.
            nodes: [B, L, C · V, 3]; velocities likewise, where a lag is free.
            places: [B, L, N] sampled on the cloth.
            faces: [F, 3] of the cloth, and of bodies beside it.
            recorded: points that look for the cloth; None where none do.
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
        views = _by_clock(_shown(nodes, velocities, pose, target.space), target.space)
        points = [places.of(view) for view in views]
        moved = [target.space.moved(one, pose) for one in points]
        if self._seen is None and target.viewpoints is not None:
            self._seen = self._look(views, points, moved, pose)
        share, seen = 1.0 if self._recorded is None else 0.5, self._of(self._seen, entries)
        last = [self._of(found, entries) for found in self._found]
        forth, found = pairs_forth(
            places, moved, target.views, nodes=views[0].shape[-2], cut=target.cut, share=share, seen=seen, guesses=last[0]
        )
        self._keep(0, found, entries)
        pairs = [forth]
        if self._recorded is not None:
            back, found = pairs_back(
                views,
                self._faces,
                self._recorded,
                forth.spacing,
                space=target.space,
                pose=pose,
                share=share,
                guesses=last[1],
            )
            self._keep(1, found, entries)
            pairs.append(back)
        return Motion(nodes, velocities, pose, tuple(pairs))

    def _look(self, views: Sequence[Tensor], points: Sequence[Tensor], moved: Sequence[Tensor], pose: Tensor) -> Tensor:
        """bool [B, L, N] which points [B, L, N, 3] any camera sees, each when its clock looks."""
        target = self._target
        assert target.viewpoints is not None
        eyes, seen = target.space.back(target.viewpoints, pose), torch.zeros_like(points[0][..., 0], dtype=torch.bool)
        for view, at, there, cameras in zip(views, points, moved, target.watching, strict=True):
            if cameras:
                blind = target.blind(cameras, there)
                seen |= seen_places(view, self._faces, at, eyes[:, cameras], near=self._near, blind=blind)
        return seen

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
    if velocities is None:
        return nodes
    lags = space.lags(pose)
    return nodes + lags.repeat_interleave(nodes.shape[2] // lags.shape[1], dim=1)[:, None, :, None] * velocities


def _by_clock(nodes: Tensor, space: PoseSpace) -> tuple[Tensor, ...]:
    """[C] the nodes [B, L, V, 3] of each clock, of [B, L, C · V, 3]."""
    return nodes.chunk(len(space.clocks), dim=2)


@torch.no_grad()
def pairs_forth(
    places: SurfacePoints,
    moved: Sequence[Tensor],
    clouds: Sequence[Sequence[NeighbourIndex]],
    *,
    nodes: int = 0,
    cut: float | None,
    share: float,
    seen: Tensor | None = None,
    guesses: Tensor | None = None,
) -> tuple[Pairs, Tensor]:
    """Each place with the nearest recorded point of its frame, and the numbers of the nearest ones of each clock
    [B, L, N, C].

    Args:
        moved: [C] where the places are in the recording's frame when each clock looks [B, L, N, 3].
        clouds: [C][L] what was recorded by each clock.
        nodes: of one clock; numbers of a later one's begin after those.
        cut: places below this height do not count: the recording ends there.
        share: of all weights.
        seen: bool [B, L, N] which places a camera could see; None for all.
        guesses: [B, L, N, C] points that may be near; they save time.
    """
    every, frames = [], len(clouds[0])
    here, nearest = moved[0], None
    for clock, (own, at) in enumerate(zip(clouds, moved, strict=True)):
        near = [None] * frames if guesses is None else guesses[..., clock].unbind(1)
        found = [cloud.nearest_index(at[:, frame], near[frame]) for frame, cloud in enumerate(own)]
        points = torch.stack([cloud.points[index] for cloud, index in zip(own, found, strict=True)], dim=1)
        across = torch.stack([cloud.normals[index] for cloud, index in zip(own, found, strict=True)], dim=1)
        every.append(torch.stack(found, dim=1))
        if clock == 0:
            partners, normals = points, across
            continue
        nearest = (here - partners).square().sum(-1) if nearest is None else nearest
        away = (at - points).square().sum(-1)
        nearer = away < nearest
        nearest, which = torch.where(nearer, away, nearest), nearer[..., None]
        partners, normals, here = (
            torch.where(which, *pair) for pair in ((points, partners), (across, normals), (at, here))
        )
        own_nodes = places.nodes % nodes + clock * nodes
        places = SurfacePoints(torch.where(which, own_nodes, places.nodes), places.barycentric)
    counted = torch.ones_like(here[..., 0]) if cut is None else (here[..., 2] >= cut).to(here)
    if seen is not None:
        counted = counted * seen
    weights = share / frames * counted / counted.sum(-1, keepdim=True).clamp(min=1.0)
    spacing = here.new_tensor([max(cloud.spacing for cloud in of_frame) for of_frame in zip(*clouds, strict=True)])
    return Pairs(places, partners, normals, spacing, weights, share / frames), torch.stack(every, dim=-1)


@torch.no_grad()
def pairs_back(
    views: Sequence[Tensor],
    faces: Tensor,
    recorded: Recorded,
    spacing: Tensor,
    *,
    space: PoseSpace,
    pose: Tensor,
    share: float,
    guesses: Tensor | None = None,
) -> tuple[Pairs, Tensor]:
    """Each recorded point with the nearest place on the surface, and the numbers of the faces there [B, L, Q].

    Args:
        views: [C] nodes of the surface when each clock looks [B, L, V, 3].
        faces: [F, 3] of the cloth, and of bodies beside it.
        pose: [B, d]
        guesses: [B, L, Q] faces that may be near; they save time.
    """
    points, sure, counts = recorded.points, recorded.sure, recorded.counts
    queries = space.back(points, pose).split(counts, dim=2)
    near = [None] * len(counts) if guesses is None else guesses.split(counts, dim=2)
    every = [nearest_places(view, faces, query, guess) for view, query, guess in zip(views, queries, near, strict=True)]
    nodes = [places.nodes + clock * views[0].shape[2] for clock, (places, _) in enumerate(every)]
    places = SurfacePoints(torch.cat(nodes, dim=2), torch.cat([places.barycentric for places, _ in every], dim=2))
    weights = share * sure / sure.sum(-1, keepdim=True) / len(points)
    batch = len(views[0])
    pairs = Pairs(
        places, points.expand(batch, -1, -1, -1), None, spacing, weights.expand(batch, -1, -1), share / len(points)
    )
    return pairs, torch.cat([found for _, found in every], dim=2)


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
