"""Training data: clouds sampled on demand from a simulated set, with their parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor
from torch.utils.data import Dataset

from diffcloud.clouds.augmentation import Augmentation, CloudMaker, run_keys
from diffcloud.clouds.background import Background
from diffcloud.errors import ConfigError, unknown_name
from diffcloud.io.simulated import SimulatedSet

__all__ = ["Augmentation", "CloudDataset", "Frames", "SimulatedSet"]

Frames = Literal["loss", "all"]


class CloudDataset(Dataset[tuple[Tensor, Tensor]]):
    """Clouds and parameters of the runs of a simulated set. They depend on (seed, epoch, run) only, not on the batch.
    An item is (clouds float32 [T', points, 3], parameters float32 [k]). Parameters are scaled so that the bounds are 0
    and 1. `batch` returns whole batches directly, and a `DataLoader` fetches them too."""

    def __init__(
        self,
        simulated: SimulatedSet,
        augmentation: Augmentation | None = None,
        *,
        frames: Frames = "loss",
        points: int = 3500,
        background: Background | None = None,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        """Prepare the clouds of a simulated set.

        Args:
            augmentation: default: that of the paper; `Augmentation.none()` for noise-free whole surfaces.
            frames: "loss": the frame of the scenario's loss, T' = 1; "all": those of a recorded episode.
            points: number of points per cloud.
            background: body whose points are removed from the clouds.
            device: device on which clouds are computed.

        Raises:
            ConfigError: there are no points, or the choice of frames is unknown.
        """
        if frames not in ("loss", "all"):
            raise ConfigError(unknown_name("choice of frames", frames, ("loss", "all")))
        self.simulated, self.seed, self.epoch = simulated, seed, 0
        chosen = (
            slice(simulated.first_frame, None) if frames == "all" else slice(simulated.loss_frame, simulated.loss_frame + 1)
        )
        self.times = torch.as_tensor(simulated.times[chosen])
        """[T'] times of the clouds since the start [s]."""
        augmentation = Augmentation() if augmentation is None else augmentation
        self._maker = CloudMaker.build(simulated, augmentation, points=points, background=background, device=device)
        self._nodes = torch.as_tensor(simulated.nodes[:, chosen], device=device)
        self._seen = self._maker.seen(self._nodes)
        low, high = torch.as_tensor(simulated.bounds).T
        scaled = (torch.as_tensor(simulated.parameters) - low) / (high - low)
        self._parameters = scaled.to(device=device, dtype=torch.float32)

    def __len__(self) -> int:
        return len(self.simulated)

    def set_epoch(self, epoch: int) -> None:
        """Use new random numbers for every run. Persistent workers of a `DataLoader` keep their own copy."""
        self.epoch = epoch

    def batch(self, runs: Sequence[int] | Tensor) -> tuple[Tensor, Tensor]:
        """Return (clouds [B, T', points, 3], parameters [B, k]) of runs [B]."""
        index = torch.as_tensor(runs, dtype=torch.int64, device=self._nodes.device)
        seen = None if self._seen is None else self._seen[index]
        return self._maker.clouds(self._nodes[index], run_keys(self.seed, self.epoch, index), seen), self._parameters[index]

    def __getitem__(self, run: int) -> tuple[Tensor, Tensor]:
        clouds, parameters = self.batch([run])
        return clouds[0], parameters[0]

    def __getitems__(self, runs: list[int]) -> list[tuple[Tensor, Tensor]]:
        """Return the items of a batch; a `DataLoader` calls this."""
        return list(zip(*self.batch(runs), strict=True))
