"""Training clouds from simulated meshes, made unlike perfect ones as the paper does it (section IV-B).

A cloud is drawn uniformly by area from a subset of the cloth's faces (occlusion) whose nodes are displaced by Gaussian
noise (the sensor), together with the whole, undisturbed obstacle where the scenario has one. All random numbers are
functions of a run's key (`keyed_random`): a cloud does not depend on the batch it is made in.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffcloud.clouds.background import Background
from diffcloud.clouds.keyed_random import normal, stream_keys, uniform
from diffcloud.clouds.sampling import points_on_faces, uniform_barycentric
from diffcloud.clouds.visibility import seen_places
from diffcloud.errors import ConfigError
from diffcloud.io.simulated import SimulatedSet
from diffcloud.mesh.topology import SurfaceMesh

_SETTINGS, _NODES, _FACES, _POINTS, _PLACE = range(5)
"""Streams of a run."""
_CAMERAS_M, _PLACE_M = 0.004, 0.01
"""Largest standard deviation of depth noise, and that of where a cloth lies [m]."""
_BEHIND_M = 0.01
"""What is nearer to the middle of a face does not hide it [m]: the face itself, a layer that it lies on."""
_SPARE = 1.5
"""Points drawn for each one needed where some may be the background's; where that is too few, points are repeated."""


@dataclass(frozen=True)
class Augmentation:
    """How clouds differ from a uniform sample of the whole cloth. The defaults are the paper's.

    Raises:
        ConfigError: a setting out of range.
    """

    keep: tuple[float, float] = (0.7, 1.0)
    """Range that each run's fraction of sampled faces is drawn from; which faces is random."""
    falling: bool = False
    """Whether the fraction falls linearly over time, from all faces in the first frame to what is drawn in the last."""
    jitter_m: float = 0.035 * 0.35
    """Each run's node noise has a standard deviation drawn from [0, this] along each axis [m]."""
    loss_faces_only: bool = True
    """Whether only the faces of the loss are sampled where a scenario names them (the upper half of the fold)."""
    viewpoints: tuple[tuple[float, float, float], ...] = ()
    """Of cameras, in the scene: only faces whose middle at least one of them sees are sampled; nothing but the cloth hides
    it. Without, all may be."""
    shift_m: float = 0.0
    """Standard deviation of each run's offset along x and along y [m]."""

    def __post_init__(self) -> None:
        low, high = self.keep
        if not 0 < low <= high <= 1:
            raise ConfigError(f"keep must be two fractions in order (0 < low <= high <= 1), got {list(self.keep)}.")
        if not 0 <= self.jitter_m < float("inf"):
            raise ConfigError(f"jitter_m must be a length of zero or more, got {self.jitter_m}.")
        if self.viewpoints and self.loss_faces_only:
            raise ConfigError("Cameras see more than the faces of the loss: viewpoints need loss_faces_only=False.")
        if not 0 <= self.shift_m < float("inf"):
            raise ConfigError(f"shift_m must be a length of zero or more, got {self.shift_m}.")

    @staticmethod
    def none() -> Augmentation:
        """Whole surfaces without noise, but for the choice of the loss's faces."""
        return Augmentation(keep=(1.0, 1.0), jitter_m=0.0)

    @staticmethod
    def recorded(viewpoints: tuple[tuple[float, float, float], ...]) -> Augmentation:
        """What depth cameras see together of a cloth that was put down by hand."""
        return Augmentation((1.0, 1.0), jitter_m=_CAMERAS_M, loss_faces_only=False, viewpoints=viewpoints, shift_m=_PLACE_M)


@dataclass(frozen=True)
class CloudMaker:
    """Clouds of one scenario's meshes."""

    faces: Tensor
    """[F, 3] the cloth's faces that may be sampled, then the obstacle's [O, 3]."""
    cloth_faces: int
    """F"""
    obstacle: Tensor
    """[W, 3] the obstacle's points, numbered after the cloth's nodes."""
    points: int
    augmentation: Augmentation
    length_unit_m: float
    background: Background | None
    """Left out of the clouds; then the obstacle is not sampled at all."""

    @staticmethod
    def build(
        simulated: SimulatedSet,
        augmentation: Augmentation,
        *,
        points: int,
        background: Background | None = None,
        device: torch.device | str = "cpu",
    ) -> CloudMaker:
        """
        Args:
            points: of each cloud.
            background: the set's obstacle, if it is to be left out, together with the cloth that touches it.

        Raises:
            ConfigError: no points.
        """
        if points < 1:
            raise ConfigError(f"At least one point must be sampled, got {points}.")
        cloth = simulated.faces
        if simulated.loss_faces is not None and augmentation.loss_faces_only:
            cloth = cloth[simulated.loss_faces]
        nothing = SurfaceMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
        body = simulated.obstacle if simulated.obstacle is not None and background is None else nothing
        faces = np.concatenate([cloth, body.faces + simulated.nodes.shape[2]])
        return CloudMaker(
            torch.as_tensor(faces, device=device),
            len(cloth),
            torch.as_tensor(body.nodes, dtype=torch.float32, device=device),
            points,
            augmentation,
            simulated.length_unit_m,
            background,
        )

    def seen(self, nodes: Tensor) -> Tensor | None:
        """bool [B, T, F] which of the cloth's faces the viewpoints of the augmentation see of motions [B, T, V, 3]; None
        without viewpoints."""
        if not self.augmentation.viewpoints:
            return None
        eyes = torch.tensor(self.augmentation.viewpoints, dtype=torch.float64)[None]
        cloth, positions = self.faces[: self.cloth_faces].cpu(), nodes.double().cpu()
        middles = positions[:, :, cloth].mean(-2)
        found = seen_places(positions, cloth, middles, eyes.expand(len(nodes), -1, -1), near=_BEHIND_M / self.length_unit_m)
        return found.to(nodes.device)

    def clouds(self, nodes: Tensor, keys: Tensor, seen: Tensor | None = None) -> Tensor:
        """Clouds of a batch of motions.

        Args:
            nodes: float32 [B, T, V, 3].
            keys: int64 [B], one for each run (and epoch).
            seen: what `seen` gives of them, where that is known already.

        Returns:
            [B, T, points, 3], the points in random order.
        """
        batch, frames, count, _ = nodes.shape
        seen = self.seen(nodes) if seen is None else seen
        deviation, fraction, _ = uniform(stream_keys(_SETTINGS, keys), 1).unbind(-1)  # [B, 1]
        if jitter := self.augmentation.jitter_m / self.length_unit_m:
            noise = normal(stream_keys(_NODES, keys), frames * count).view_as(nodes)
            nodes = nodes + (jitter * deviation)[..., None, None] * noise
        body = self.obstacle.expand(batch, frames, -1, -1)
        shown = torch.cat([nodes, body], dim=2)
        if self.augmentation.shift_m:
            offset = normal(stream_keys(_PLACE, keys), 1).view(batch, 1, 1, 3) * shown.new_tensor([1.0, 1.0, 0.0])
            shown = shown + self.augmentation.shift_m / self.length_unit_m * offset
        flat = shown.flatten(0, 1)
        drawn = self.points if self.background is None else math.ceil(_SPARE * self.points)
        face_number, first, second = uniform(stream_keys(_POINTS, keys), frames * drawn).unbind(-1)
        place = uniform_barycentric(first, second).view(batch * frames, drawn, 3)
        choice = face_number.view(batch * frames, drawn)
        weights = self._sampled_faces(fraction, keys, frames)
        if seen is not None:
            kept = weights[..., : self.cloth_faces] * seen
            weights[..., : self.cloth_faces] = torch.where(kept.any(-1, keepdim=True), kept, 1.0)  # something must be
        found = points_on_faces(flat, self.faces, choice, place, weights=weights.flatten(0, 1))
        if self.background is not None:
            found = self.background.first_free(found, self.points)
        return found.view(batch, frames, self.points, 3)

    def _sampled_faces(self, fraction: Tensor, keys: Tensor, frames: int) -> Tensor:
        """float32 [B, T, F + O]: 1 for the faces that are sampled, 0 for the others.

        A run's faces have one random order; each frame takes the first of it, so that what is hidden stays hidden.
        """
        low, high = self.augmentation.keep
        keep = low + (high - low) * fraction  # [B, 1]
        if self.augmentation.falling and frames > 1:
            keep = 1 + (keep - 1) * torch.linspace(0, 1, frames, device=keys.device)
        kept = (keep * self.cloth_faces).round().clamp(min=1).expand(-1, frames)
        order = uniform(stream_keys(_FACES, keys), self.cloth_faces)[..., 0].argsort(dim=1, stable=True)
        rank = order.argsort(dim=1)
        cloth = rank[:, None] < kept[..., None]  # [B, T, F]
        body = cloth.new_ones(len(keys), frames, len(self.faces) - self.cloth_faces)
        return torch.cat([cloth, body], dim=2).to(torch.float32)


def run_keys(seed: int, epoch: int, runs: Tensor) -> Tensor:
    """[B] keys for `CloudMaker.clouds` of runs (int64 [B]) in an epoch."""
    return stream_keys(seed, epoch, runs)
