"""A trained regressor and its file: safetensors weights with a JSON description in the header.

Reading a file executes no code from it. The description has all that a prediction needs: frame times, scaling of the
clouds, and the meaning of the outputs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from diffcloud.clouds.background import Background
from diffcloud.errors import CheckpointError, ConfigError, EpisodeError
from diffcloud.io.files import write_bytes
from diffcloud.io.inputs import check_input
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.regressors.grouping import Order
from diffcloud.regressors.networks import ModelName, build_network
from diffcloud.regressors.posterior import Posterior
from diffcloud.regressors.settings import Target

_KEY = "diffcloud"
_WIDEST = 5.0
"""Bound on the logarithm of a predicted width, to exclude extreme outputs."""
SAMPLES = 1000
"""Number of samples from a posterior."""
_SEED = 0
"""Seed of these samples, so that the same clouds give the same prediction."""
Count = Annotated[int, Field(ge=1, le=10**6)]
_MOST_POINTS = 10**7
"""Maximum number of points in all frames together."""


class BackgroundBody(BaseModel):
    """Fixed body whose points are removed from the input clouds of the network."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    nodes: Annotated[tuple[tuple[float, float, float], ...], Field(min_length=3, max_length=10**5)]
    """Vertices of the body [length unit]."""
    faces: Annotated[tuple[tuple[int, int, int], ...], Field(min_length=1, max_length=10**5)]
    reach: Annotated[float, Field(gt=0)]
    """Points closer to the body than this are removed [length unit]."""

    @model_validator(mode="after")
    def _faces_exist(self) -> Self:
        if not all(0 <= node < len(self.nodes) for face in self.faces for node in face):
            raise ValueError(f"faces must name nodes 0 to {len(self.nodes) - 1}")
        return self

    @staticmethod
    def of(body: SurfaceMesh, reach: float) -> BackgroundBody:
        return BackgroundBody(nodes=body.nodes.tolist(), faces=body.faces.tolist(), reach=reach)

    def build(self, device: torch.device | str = "cpu") -> Background:
        return Background.build(SurfaceMesh(np.array(self.nodes), np.array(self.faces)), self.reach, device=device)


class Description(BaseModel):
    """Header of a checkpoint."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    version: Literal[1] = 1
    model: ModelName
    scenario: str
    names: Annotated[tuple[str, ...], Field(min_length=1, max_length=100)]
    """Names of the k parameters."""
    bounds: tuple[tuple[float, float], ...]
    target: Target = "linear"
    predict_variance: bool = False
    times: Annotated[tuple[float, ...], Field(min_length=1, max_length=10**4)]
    """Times of the input frames since the start of the motion [s]."""
    frame_time: Annotated[float, Field(gt=0)]
    """Time between frames [s]."""
    points: Count
    """Number of points per frame."""
    centre: tuple[float, float, float]
    """Subtracted from clouds before scaling [length unit]."""
    length: Annotated[float, Field(gt=0)]
    """Clouds are divided by this length [length unit]."""
    length_unit_m: Annotated[float, Field(gt=0)] = 1.0
    background: BackgroundBody | None = None
    order: Order = "cloud"
    density: Annotated[float, Field(gt=0, le=1)] = 1.0
    spread: tuple[float, ...]
    """Laplace width of each parameter's error on the target's scale, from the validation samples. With a
    predict_variance head, the factor on the predicted width."""
    training: dict[str, Any] = {}
    """Settings of the training."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not len(self.names) == len(self.bounds) == len(self.spread):
            raise ValueError(
                f"{len(self.names)} names need as many bounds and spreads, got {len(self.bounds)} and {len(self.spread)}"
            )
        if self.points * len(self.times) > _MOST_POINTS:
            raise ValueError(f"{self.points} points in {len(self.times)} frames are more than {_MOST_POINTS} together")
        if self.model == "posterior" and self.predict_variance:
            raise ValueError("a posterior has widths of its own, and no second output for them")
        for name, (low, high) in zip(self.names, self.bounds, strict=True):
            if not low < high or (self.target == "logarithmic" and low <= 0):
                raise ValueError(f"bounds of {name} must be in order (and positive if logarithmic), got {[low, high]}")
        return self

    @property
    def outputs(self) -> int:
        return len(self.names) * (2 if self.predict_variance else 1)

    def build(self, *, dropout: float | None = None) -> nn.Module:
        """Return the network with new random weights."""
        return build_network(
            self.model, self.outputs, frames=len(self.times), dropout=dropout, order=self.order, density=self.density
        )


@dataclass(frozen=True)
class OutputScale:
    """Conversion between a network's outputs and parameters."""

    bounds: Tensor
    """[k, 2] lower and upper bounds."""
    target: Target

    def values(self, fractions: Tensor) -> Tensor:
        """Convert fractions [..., k] of the range on the target's scale to parameters, without clipping."""
        low, high = self.bounds.unbind(-1)
        if self.target == "logarithmic":
            return low * (high / low) ** fractions
        return low + (high - low) * fractions

    def fractions(self, values: Tensor) -> Tensor:
        """Convert parameters to fractions, the inverse of `values`."""
        low, high = self.bounds.unbind(-1)
        return self.from_linear((values - low) / (high - low))

    def from_linear(self, fractions: Tensor) -> Tensor:
        """Convert linear fractions [..., k], as in data sets, to fractions on the target's scale."""
        if self.target == "linear":
            return fractions
        low, high = self.bounds.unbind(-1)
        return torch.log((low + (high - low) * fractions) / low) / torch.log(high / low)


@dataclass(frozen=True)
class Prediction:
    """Predicted parameters of a batch of clouds."""

    names: tuple[str, ...]
    values: Tensor
    """[B, k] predicted values, possibly outside the bounds."""
    fractions: Tensor
    """[B, k] fractions on the target's scale."""
    width: Tensor
    """[B, k] Laplace width on that scale. For a posterior, the width with the same interquartile range."""
    scale: OutputScale
    samples: Tensor | None = None
    """[B, S, k] samples from a posterior in the parameters' units; `values` are their medians."""

    @property
    def inside(self) -> Tensor:
        """bool [B, k], whether values are within the bounds."""
        low, high = self.scale.bounds.unbind(-1)
        return (self.values >= low) & (self.values <= high)

    @property
    def clipped(self) -> Tensor:
        """[B, k] values clipped to the bounds, for simulation."""
        low, high = self.scale.bounds.unbind(-1)
        return self.values.clamp(low, high)

    def interval(self, level: float) -> tuple[Tensor, Tensor]:
        """Return lower and upper ends [B, k] of intervals with this probability, from the widths or the posterior."""
        if self.samples is not None:
            low, high = torch.quantile(self.samples, torch.tensor([0.5 - level / 2, 0.5 + level / 2]), dim=1)
            return low, high
        reach = laplace_reach(level) * self.width
        return self.scale.values(self.fractions - reach), self.scale.values(self.fractions + reach)

    def first_intervals(self, level: float) -> dict[str, tuple[float, float]]:
        """Return the intervals of the first cloud by parameter name."""
        low, high = (end[0].tolist() for end in self.interval(level))
        return dict(zip(self.names, zip(low, high, strict=True), strict=True))


def laplace_reach(level: float) -> float:
    """Return the half-length of the central interval of a Laplace distribution, in widths: P(|x| <= reach) = level."""
    return -math.log1p(-level)


def split_outputs(outputs: Tensor, parameters: int) -> tuple[Tensor, Tensor]:
    """Split outputs [B, k or 2k] into fractions [B, k] and log-widths [B, k] (zero without a predict_variance head)."""
    fractions = outputs[:, :parameters]
    if outputs.shape[1] == parameters:
        return fractions, torch.zeros_like(fractions)
    return fractions, outputs[:, parameters:].clamp(-_WIDEST, _WIDEST)


@dataclass(frozen=True)
class Regressor:
    """A trained network with the preparation of clouds and the conversion of outputs."""

    description: Description
    network: nn.Module

    @property
    def scale(self) -> OutputScale:
        return OutputScale(torch.tensor(self.description.bounds), self.description.target)

    def predict(self, clouds: Sequence[Sequence[ArrayLike]] | Tensor, *, seed: int = 0) -> Prediction:
        """Predict the parameters of recorded clouds, which are first processed by `prepared`.

        Args:
            clouds: [B][T] clouds [N, 3] of any size, or a tensor [B, T, N, 3], in the frame and length unit of the
                scenario's scene; T frames at `description.times`. `predict_episode` selects these frames from a
                recording.
            seed: seed for the choice of points.

        Raises:
            EpisodeError: the number of frames is wrong, or a cloud is empty, not finite or not [N, 3].
        """
        return self.predict_prepared(torch.stack([self.prepared(frames, seed=seed) for frames in clouds]))

    def prepared(self, frames: Sequence[ArrayLike] | Tensor, *, seed: int = 0) -> Tensor:
        """Return the clouds of one recording as in training: without background, and downsampled.

        Points are sampled at random, without repeats if there are enough. The order of points in a recording must not
        affect which points a network groups.

        Args:
            frames: T clouds [N, 3].

        Returns:
            float32 [T, P, 3].

        Raises:
            EpisodeError: see `predict`.
        """
        told = self.description
        if len(frames) != len(told.times):
            raise EpisodeError(
                f"This {told.model} looks at {len(told.times)} frames, got {len(frames)}. Give those at "
                f"{list(told.times)} s."
            )
        rng = np.random.default_rng(seed)
        background = None if told.background is None else told.background.build()
        clouds = []
        for index, frame in enumerate(frames):  # clouds differ in size
            cloud = np.asarray(frame, dtype=np.float32)
            if cloud.ndim != 2 or cloud.shape[1] != 3 or not len(cloud) or not np.isfinite(cloud).all():
                raise EpisodeError(
                    f"Cloud {index} has shape {list(cloud.shape)}; a cloud is [points, 3], finite, not empty."
                )
            if background is not None:
                free = cloud[~background.holds(torch.from_numpy(cloud)).numpy()]
                cloud = free if len(free) else cloud
            clouds.append(cloud[rng.choice(len(cloud), told.points, replace=len(cloud) < told.points)])
        return torch.from_numpy(np.stack(clouds))

    @torch.no_grad()
    def predict_prepared(self, clouds: Tensor) -> Prediction:
        """Predict the parameters of clouds [B, T, P, 3] that are sampled as in training."""
        told = self.description
        self.network.eval()
        scaled, scale = self.scaled(clouds), self.scale
        if isinstance(self.network, Posterior):
            drawn = self.network.sample(scaled, SAMPLES, _SEED).cpu()
            low, fractions, high = torch.quantile(drawn, torch.tensor([0.25, 0.5, 0.75]), dim=1)
            width = (high - low) / (2 * laplace_reach(0.5))
            return Prediction(told.names, scale.values(fractions), fractions, width, scale, scale.values(drawn))
        outputs = self.network(scaled).float().cpu()
        fractions, log_width = split_outputs(outputs, len(told.names))
        width = log_width.exp() * torch.tensor(told.spread)
        return Prediction(told.names, scale.values(fractions), fractions, width, scale)

    def scaled(self, clouds: Tensor) -> Tensor:
        """Centre and scale clouds [B, T, P, 3] for the network, on its device."""
        clouds = clouds.to(next(self.network.parameters()))
        return (clouds - clouds.new_tensor(self.description.centre)) / self.description.length

    def write(self, path: Path) -> None:
        """Write the checkpoint atomically. The same regressor gives the same bytes."""
        tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in self.network.state_dict().items()}
        write_bytes(path, save(tensors, metadata={_KEY: self.description.model_dump_json()}))

    @staticmethod
    def read(path: Path) -> Regressor:
        """Read and check a checkpoint.

        Raises:
            CheckpointError: the file is missing, damaged, or not a regressor of this project; names the file and the
                field.
        """
        path = Path(path)
        if not path.exists():
            raise CheckpointError(f"No such checkpoint: {path}. Make one with `diffcloud network train`.")
        check_input(path, kind="checkpoint", error=CheckpointError)
        try:
            with safe_open(path, framework="pt") as file:
                text = (file.metadata() or {}).get(_KEY)
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict
        except (SafetensorError, OSError, ValueError) as error:
            raise CheckpointError(f"{path} is not a readable checkpoint: {error}. Train again.") from error
        if text is None:
            raise CheckpointError(
                f"{path} lacks the description of a regressor; it was not written by `diffcloud network train`."
            )
        try:
            described = Description.model_validate_json(text)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"])) or "description"
            raise CheckpointError(f"{path}: {where}: {first['msg']}, got {first['input']!r}.") from error
        try:
            with nullcontext() if described.model == "posterior" else torch.device("meta"):  # its masks are computed
                network = described.build()
        except ConfigError as error:
            raise CheckpointError(f"{path}: {error}") from error
        _check_tensors(path, network, tensors)
        # copies are aligned like torch's own tensors; other alignment changes the last bits of results
        network.load_state_dict({name: tensor.clone() for name, tensor in tensors.items()}, assign=True)
        return Regressor(described, network.eval())


def _check_tensors(path: Path, network: nn.Module, tensors: dict[str, Tensor]) -> None:
    wanted = network.state_dict()
    differing = sorted(wanted.keys() ^ tensors.keys())
    if differing:
        raise CheckpointError(f"{path}: the weights do not belong to its model: {differing[0]} is missing or too much.")
    for name, tensor in tensors.items():
        if tensor.shape != wanted[name].shape or tensor.dtype != wanted[name].dtype:
            raise CheckpointError(
                f"{path}: {name} must be {wanted[name].dtype} {list(wanted[name].shape)}, got {tensor.dtype} "
                f"{list(tensor.shape)}."
            )
        if not bool(torch.isfinite(tensor).all()):
            raise CheckpointError(f"{path}: {name} holds NaN or infinite numbers. Train again, at a lower learning rate.")
