"""A posterior instead of a point: neural posterior estimation (Papamakarios and Murray 2016), with the flows of sbi.

A network that looks at the whole motion shapes a normalising flow (Durkan et al. 2019), a density over the parameters.
Trained on simulated clouds and the parameters behind them, the mean of -log q(parameters | clouds) is lowest where q is the
posterior under the law that the parameters were drawn by. It shares the simulator and the noise model with the intervals of
a fit, but neither the linearisation nor the loss.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from diffcloud.errors import ConfigError
from diffcloud.regressors.grouping import Order
from diffcloud.regressors.meteornet import MeteorNet

_FEATURES = 32
"""What the flow is told of the clouds."""
_HIDDEN, _TRANSFORMS = 48, 3
_EDGE = 1e-4
"""Fractions of the bounds are brought so far from 0 and 1: the flow lives on their logits."""


class Posterior(nn.Module):
    """Clouds -> a density of k parameters."""

    def __init__(
        self, parameters: int, *, frames: int, dropout: float | None = None, order: Order = "cloud", density: float = 1.0
    ) -> None:
        """
        Args:
            parameters: k.
            frames, dropout, order, density: of the network that looks at clouds, see `networks.build_network`.

        Raises:
            ConfigError: sbi is not installed.
        """
        super().__init__()
        head = {} if dropout is None else {"dropout": dropout}
        self.embedding = MeteorNet(_FEATURES, frames=frames, order=order, density=density, **head)
        self.flow = _flow(parameters)

    def forward(self, clouds: Tensor) -> Tensor:
        """[B, T, P, 3] -> [B, features]."""
        features: Tensor = self.embedding(clouds)
        return features

    def loss(self, clouds: Tensor, fractions: Tensor) -> Tensor:
        """Mean of -log q of fractions [B, k] of the bounds."""
        found: Tensor = self.flow.loss(_logits(fractions), condition=self(clouds)).mean()
        return found

    def sample(self, clouds: Tensor, count: int, generator: int) -> Tensor:
        """[B, count, k] fractions of the bounds, all between them.

        Args:
            generator: seed of the draws.
        """
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(generator)
            drawn: Tensor = self.flow.sample((count,), condition=self(clouds))
        return drawn.transpose(0, 1).sigmoid()

    def log_density(self, clouds: Tensor, fractions: Tensor) -> Tensor:
        """[B, S] of fractions [B, S, k], up to a constant for each cloud: on their logits.

        Two sets are ranked by it as by the density of the parameters only if the same transformation of both is meant, as
        in a check of coverage.
        """
        found: Tensor = self.flow.log_prob(_logits(fractions).transpose(0, 1), condition=self(clouds))
        return found.transpose(0, 1)


def _flow(parameters: int) -> Any:
    try:
        from sbi.neural_nets.net_builders import build_zuko_nsf
    except ImportError as error:
        raise ConfigError(
            "The model posterior needs sbi, which is not installed: pip install 'diffcloud[posterior]'."
        ) from error
    return build_zuko_nsf(
        torch.zeros(2, parameters),
        torch.zeros(2, _FEATURES),
        z_score_x=None,
        z_score_y=None,
        hidden_features=_HIDDEN,
        num_transforms=_TRANSFORMS,
    )


def _logits(fractions: Tensor) -> Tensor:
    return torch.logit(fractions.float().clamp(_EDGE, 1 - _EDGE))
