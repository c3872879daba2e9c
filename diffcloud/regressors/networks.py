"""The networks by name, and their sizes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from torch import nn

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.regressors.dataset import Frames
from diffcloud.regressors.grouping import Order
from diffcloud.regressors.layers import Layer
from diffcloud.regressors.meteornet import MeteorNet
from diffcloud.regressors.mlp import MLP
from diffcloud.regressors.pointnet2 import PointNet2
from diffcloud.regressors.posterior import Posterior

ModelName = Literal["mlp", "pointnet2", "meteornet", "posterior"]
MODEL_NAMES: tuple[ModelName, ...] = get_args(ModelName)


def frames_seen(model: str) -> Frames:
    """MeteorNet, and the posterior that it tells, see the sequence, the others the loss frame of the scenario.

    Raises:
        ConfigError: no such model.
    """
    if model not in MODEL_NAMES:
        raise ConfigError(unknown_name("model", model, MODEL_NAMES))
    return "all" if model in ("meteornet", "posterior") else "loss"


def build_network(
    model: ModelName,
    outputs: int,
    *,
    frames: int = 1,
    dropout: float | None = None,
    order: Order = "cloud",
    density: float = 1.0,
) -> nn.Module:
    """A network with fresh weights from torch's global generator: [B, T, P, 3] -> [B, outputs], or a `Posterior` of as many
    parameters.

    Args:
        frames: T of the training; only MeteorNet uses it, alone and in the posterior.
        dropout: in the head; None for the model's own.
        order, density: of the grouping (see `grouping`, `layers.thinned`); the MLP has none.
    """
    head = {} if dropout is None else {"dropout": dropout}
    match model:
        case "mlp":
            return MLP(outputs, **head)
        case "pointnet2":
            return PointNet2(outputs, order=order, density=density, **head)
        case "meteornet":
            return MeteorNet(outputs, frames=frames, order=order, density=density, **head)
        case "posterior":
            return Posterior(outputs, frames=frames, order=order, density=density, dropout=dropout)


@dataclass(frozen=True)
class LayerSize:
    """One row of the table of layers."""

    name: str
    inputs: int
    outputs: int
    parameters: int
    """Trainable numbers, with bias and batch normalisation."""


def layer_sizes(network: nn.Module) -> list[LayerSize]:
    """All linear layers in the order of the data."""
    rows = []
    for name, module in network.named_modules():
        inside_layer = isinstance(module, nn.Linear) and name.endswith(".linear")
        if isinstance(module, Layer | nn.Linear) and not inside_layer:
            linear = module.linear if isinstance(module, Layer) else module
            count = sum(parameter.numel() for parameter in module.parameters())
            rows.append(LayerSize(name, linear.in_features, linear.out_features, count))
    return rows
