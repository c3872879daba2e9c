"""Augmented training clouds from simulated meshes, as in the paper (section IV-B).

A cloud is sampled uniformly by area from a subset of the cloth's faces (occlusion). Their nodes are displaced by Gaussian
noise (sensor noise). If the scenario has an obstacle, the whole undisturbed obstacle is sampled too. All random numbers are
functions of a run's key (`keyed_random`), so a cloud does not depend on its batch.
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
"""Numbers of the random streams of a run."""
_CAMERAS_M, _PLACE_M = 0.004, 0.01
"""Largest standard deviation of the depth noise, and standard deviation of the cloth's position [m]."""
_BEHIND_M = 0.01
"""Surfaces closer than this to the centre of a face do not occlude it [m]: the face itself, or an adjacent layer."""
_SPARE = 1.5
"""Sampled points per required point if background points are removed. If too few remain, points are repeated."""


@dataclass(frozen=True)
class Augmentation:
    """How clouds differ from a uniform sample of the whole cloth. The defaults are those of the paper.

    Raises:
        ConfigError: a setting is out of range.
    """

    keep: tuple[float, float] = (0.7, 1.0)
    """Each run samples a random fraction of the faces, uniform in this range. The choice of faces is random."""
    falling: bool = False
    """Whether the fraction decreases linearly over time, from all faces in the first frame to the sampled fraction in the
    last."""
    jitter_m: float = 0.035 * 0.35
    """Upper bound of each run's standard deviation of the node noise along each axis [m]. The lower bound is zero."""
    loss_faces_only: bool = True
    """If the scenario names faces of the loss (the upper half of the fold), sample only these."""
    viewpoints: tuple[tuple[float, float, float], ...] = ()
    """Camera positions in the scene. Sample only faces whose centre at least one camera sees. Only the cloth occludes.
    Empty: sample all faces."""
    shift_m: float = 0.0
    """Standard deviation of each run's offset along x and y [m]."""

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
        """Return settings without augmentation. Only the faces of the loss are sampled."""
        return Augmentation(keep=(1.0, 1.0), jitter_m=0.0)

    @staticmethod
    def recorded(viewpoints: tuple[tuple[float, float, float], ...]) -> Augmentation:
        """Return settings for the clouds of several depth cameras that see a cloth placed by hand."""
        return Augmentation((1.0, 1.0), jitter_m=_CAMERAS_M, loss_faces_only=False, viewpoints=viewpoints, shift_m=_PLACE_M)


@dataclass(frozen=True)
class CloudMaker:
    """Makes clouds from the meshes of one scenario."""

    faces: Tensor
    """[F + O, 3] faces of the cloth that may be sampled, then those of the obstacle."""
    cloth_faces: int
    """Number F of faces of the cloth."""
    obstacle: Tensor
    """[W, 3] points of the obstacle, numbered after the cloth's nodes."""
    points: int
    augmentation: Augmentation
    length_unit_m: float
    background: Background | None
    """Body whose points are removed from the clouds. The obstacle is then not sampled."""

    @staticmethod
    def build(
        simulated: SimulatedSet,
        augmentation: Augmentation,
        *,
        points: int,
        background: Background | None = None,
        device: torch.device | str = "cpu",
    ) -> CloudMaker:
        """Prepare the clouds of a simulated data set.

        Args:
            points: number of points of each cloud.
            background: obstacle of the data set, to remove its points and the cloth points that touch it.

        Raises:
            ConfigError: `points` is less than 1.
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
        """Visibility of the cloth's faces from the augmentation's viewpoints, bool [B, T, F], for motions [B, T, V, 3].
        None without viewpoints."""
        if not self.augmentation.viewpoints:
            return None
        eyes = torch.tensor(self.augmentation.viewpoints, dtype=torch.float64)[None]
        cloth, positions = self.faces[: self.cloth_faces].cpu(), nodes.double().cpu()
        middles = positions[:, :, cloth].mean(-2)
        found = seen_places(positions, cloth, middles, eyes.expand(len(nodes), -1, -1), near=_BEHIND_M / self.length_unit_m)
        return found.to(nodes.device)

    def clouds(self, nodes: Tensor, keys: Tensor, seen: Tensor | None = None) -> Tensor:
        """Sample the clouds of a batch of motions.

        Args:
            nodes: float32 [B, T, V, 3].
            keys: int64 [B], one for each run (and epoch).
            seen: result of `seen` for these motions, if already computed.

        Returns:
            [B, T, points, 3], points in random order.
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
            weights[..., : self.cloth_faces] = torch.where(kept.any(-1, keepdim=True), kept, 1.0)  # none seen: all
        found = points_on_faces(flat, self.faces, choice, place, weights=weights.flatten(0, 1))
        if self.background is not None:
            found = self.background.first_free(found, self.points)
        return found.view(batch, frames, self.points, 3)

    def _sampled_faces(self, fraction: Tensor, keys: Tensor, frames: int) -> Tensor:
        """Weight of each face, float32 [B, T, F + O]: 1 if the face is sampled, else 0. Each run orders its faces at
        random, and each frame uses the first ones. So hidden faces remain hidden."""
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
    """Keys [B] for `CloudMaker.clouds`, from runs (int64 [B]) and an epoch."""
    return stream_keys(seed, epoch, runs)
