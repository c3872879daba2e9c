"""Pairs of points of the simulated surface and recorded points, in both directions, and their loss.

In the direction "forth", each point sampled on the cloth is paired with the nearest recorded point. In the direction
"back", each recorded point is paired with the nearest point on the cloth or on another body. With r = x - y of a pair,
the loss is the weighted mean of |r|². Distances are capped, so outliers and unobserved parts of the cloth have no
gradient.

Half the gradient is the mean of r · ∂x. The Gauss–Newton Hessian would be |∂x|², as if x were bound to y. But the pair
may slide along the surface that both points sample. With the surface normal n, and the direction t of r's tangential
part,

    curvature = (n · ∂x)² + w (t · ∂x)²,      w = |r_t|² / (|r_t|² + s²),

where s is the distance between recorded points. So w is small inside the surface, and close to one where r points
beyond its rim. (Point-to-plane registration, Chen and Medioni 1992, has the first term only.)

Each camera may have its own clock. A motion then holds its V nodes C times, once at the times of each clock, one block
after the other. The node indices of a surface point therefore identify its clock. A recorded point has the clock of its
camera. A sampled point is paired with the nearest recorded point of all clocks, each compared at the time of that
clock.
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
from diffcloud.estimation.targets import Crop, Target


@dataclass(frozen=True)
class Pairs:
    """N pairs of a surface point and a recorded point, for B motions and L frames."""

    places: SurfacePoints
    """[B, L, N] points on the surface."""
    partners: Tensor
    """[B, L, N, 3] recorded points, in the recording's frame."""
    normals: Tensor | None
    """[B, L, N, 3] normals of the recorded surface, along which a pair may slide. None: the face normals."""
    spacing: Tensor
    """[L] distance between neighbouring recorded points."""
    weights: Tensor
    """[B, L, N] weights; zero if a pair is excluded."""
    share: float
    """Sum of the weights in a frame that has any included pair."""

    def losses(self, moved: Tensor, cap: float) -> Tensor:
        """Return the losses [B, L] of these pairs, differentiable. `estimation.curvature` has gradient and Hessian.

        Args:
            moved: [B, L, N, 3] the surface points in the recording's frame.
            cap: distances are capped at this value.
        """
        return self.squares(moved, cap)

    def squares(self, moved: Tensor, cap: float) -> Tensor:
        """Return weighted sums [B, L] of the capped squared distances; `rms_mm` is the root of their mean.

        A frame without included pairs gets the maximum, since a motion that is out of view does not fit the recording.

        Args:
            moved, cap: see `losses`.
        """
        found = (self.weights * (moved - self.partners).square().sum(-1).clamp(max=cap**2)).sum(-1)
        return torch.where(self.weights.sum(-1) > 0, found, self.share * cap**2)


@dataclass(frozen=True)
class Motion:
    """B simulated motions at L frames, with their poses and pairs."""

    nodes: Tensor
    """[B, L, C · V, 3] nodes of the cloth and the other bodies for each clock, in the scene's frame."""
    velocities: Tensor | None
    """[B, L, C · V, 3] node velocities, if a lag is free."""
    pose: Tensor
    """[B, d] pose values."""
    pairs: tuple[Pairs, ...]
    """Pairs from cloth to cloud; in the default loss also those from cloud to cloth."""

    def shown(self, space: PoseSpace) -> Tensor:
        """Return the nodes [B, L, C · V, 3] at the times of the recorded frames, i.e. with the fitted lags."""
        return _shown(self.nodes, self.velocities, self.pose, space)

    def terms(self, space: PoseSpace, cap: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return the loss [B], half its gradient [B, d] and half its Hessian approximation [B, d, d] in the pose.

        Args:
            cap: distances are capped at this value.
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
        """Assert the shapes that the kernel requires, since the kernel checks no bounds."""
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
    """Return a tensor as an array, which shares its memory if the tensor is contiguous.

    Args:
        axes: these axes get length one where the tensor was expanded.
    """
    for axis in axes:
        if tensor.stride(axis) == 0 and tensor.shape[axis] > 1:
            tensor = tensor.narrow(axis, 0, 1)
    return tensor.detach().contiguous().numpy()


@dataclass(frozen=True)
class Recorded:
    """Q recorded points per frame that are paired with the cloth, for L frames, ordered by clock."""

    points: Tensor
    """[L, Q, 3] points in the recording's frame."""
    sure: Tensor
    """[L, Q] weight of each point."""
    counts: tuple[int, ...]
    """[C] number of points of each clock."""


class Matcher:
    """Finds the pairs of B motions at a sequence of poses. The previous result speeds up each search."""

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
        """Store the motions and the recorded points.

        Args:
            target: the recording, at L frames.
            nodes: [B, L, C · V, 3] nodes.
            velocities: [B, L, C · V, 3] velocities; needed if a lag is free.
            places: [B, L, N] points sampled on the cloth.
            recorded: points to pair with the cloth; None for a one-sided loss.
            near: surfaces closer to a point than this do not occlude it.
        """
        self._target, self._faces, self._near = target, faces, near
        self._nodes, self._velocities, self._places = nodes, velocities, places
        self._recorded = recorded
        self._seen: Tensor | None = None
        self._found: list[Tensor | None] = [None, None]

    def __call__(self, pose: Tensor, entries: Tensor | None = None) -> Motion:
        """Return the motions at poses [b, d] with their pairs.

        Args:
            pose: [b, d] poses.
            entries: [b] indices of the motions. None: all motions, as required in the first call.
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
            places, moved, target.views, nodes=views[0].shape[-2], crop=target.crop, share=share, seen=seen, guesses=last[0]
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
        """Return which points [B, L, N, 3] at least one camera sees at the time of its clock, bool [B, L, N]."""
        target = self._target
        assert target.viewpoints is not None
        eyes, seen = target.space.back(target.viewpoints, pose), torch.zeros_like(points[0][..., 0], dtype=torch.bool)
        for view, at, there, cameras in zip(views, points, moved, target.watching, strict=True):
            if cameras:
                blind = target.blind(cameras, there)
                seen |= seen_places(view, self._faces, at, eyes[:, cameras], near=self._near, blind=blind)
        return seen

    def look_anew(self) -> None:
        """Recompute visibility at the next pose. A pose search keeps the visibility of its first pose, since it hardly
        changes. The final loss needs that of its own pose."""
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
    """Split nodes [B, L, C · V, 3] into those of each clock, C tensors [B, L, V, 3]."""
    return nodes.chunk(len(space.clocks), dim=2)


@torch.no_grad()
def pairs_forth(
    places: SurfacePoints,
    moved: Sequence[Tensor],
    clouds: Sequence[Sequence[NeighbourIndex]],
    *,
    nodes: int = 0,
    crop: Crop | None,
    share: float,
    seen: Tensor | None = None,
    guesses: Tensor | None = None,
) -> tuple[Pairs, Tensor]:
    """Pair each surface point with the nearest recorded point of its frame.

    Args:
        moved: [C] their positions [B, L, N, 3] in the recording's frame at the time of each clock.
        clouds: [C][L] recorded points of each clock.
        nodes: number of nodes per clock; the node indices of later clocks are offset by multiples of it.
        crop: crop of the recording, which gives the weights of surface points.
        share: sum of the weights over all frames.
        seen: bool [B, L, N] visible points; None for all.
        guesses: [B, L, N, C] indices of points that are probably near; they only save time.

    Returns:
        The pairs, and the indices [B, L, N, C] of the nearest recorded points of each clock.
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
    counted = torch.ones_like(here[..., 0]) if crop is None else crop.weights(here[..., 2])
    if seen is not None:
        counted = counted * seen
    weights = share / frames * counted / counted.sum(-1, keepdim=True).clamp(min=torch.finfo(counted.dtype).tiny)
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
    """Pair each recorded point with the nearest point of the surface.

    Args:
        views: [C] surface nodes [B, L, V, 3] at the time of each clock.
        recorded: the recorded points.
        pose: [B, d] poses.
        share: sum of the weights over all frames.
        guesses: [B, L, Q] indices of faces that are probably near; they only save time.

    Returns:
        The pairs, and the face indices [B, L, Q].
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
    """Return the surface points nearest to queries [B, L, Q, 3], and their face indices [B, L, Q]. If a node position
    is NaN, the result is the first corner of a face.

    Args:
        positions: [B, L, V, 3] nodes of the mesh.
        faces: [F, 3] faces.
        queries: [B, L, Q, 3] query points.
        guesses: [B, L, Q] indices of faces that are probably near; they only save time.
    """
    from diffcloud.clouds.surface import NO_GUESS, find_on_surface  # numba takes a moment to import

    states, shape = positions.shape[0] * positions.shape[1], queries.shape[:-1]
    nodes, points = (part.detach().reshape(states, -1, 3).contiguous().numpy() for part in (positions, queries))
    near = NO_GUESS if guesses is None else guesses.reshape(states, -1).contiguous().numpy()
    found, places = (torch.from_numpy(part) for part in find_on_surface(points, near, nodes, faces.numpy()))
    found = found.reshape(shape)
    return SurfacePoints(faces[found], places.reshape(*shape, 3)), found
