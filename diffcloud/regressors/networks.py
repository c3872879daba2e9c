"""The networks by name, and the sizes of their layers."""

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
    """Return the input frames of a model: "all" for MeteorNet and the posterior, "loss" (the loss frame) for the
    others.

    Raises:
        ConfigError: the model is unknown.
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
    """Return a network with new weights from torch's global generator: [B, T, P, 3] -> [B, outputs], or a `Posterior`
    with this number of parameters.

    Args:
        frames: number of frames T in training; used by MeteorNet and the posterior.
        dropout: rate in the head; None for the model's default.
        order, density: settings of the grouping (see `grouping`, `layers.thinned`); not used by the MLP.
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
    """Size of one linear layer."""

    name: str
    inputs: int
    outputs: int
    parameters: int
    """Number of trainable parameters, including bias and batch normalisation."""


def layer_sizes(network: nn.Module) -> list[LayerSize]:
    """Return the sizes of all linear layers, in the order of evaluation."""
    rows = []
    for name, module in network.named_modules():
        inside_layer = isinstance(module, nn.Linear) and name.endswith(".linear")
        if isinstance(module, Layer | nn.Linear) and not inside_layer:
            linear = module.linear if isinstance(module, Layer) else module
            count = sum(parameter.numel() for parameter in module.parameters())
            rows.append(LayerSize(name, linear.in_features, linear.out_features, count))
    return rows
