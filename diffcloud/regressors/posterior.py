"""Posterior distribution of the parameters instead of a point estimate, by neural posterior estimation (Papamakarios
and Murray 2016) with the flows of the package sbi.

A network of the whole motion conditions a normalising flow (Durkan et al. 2019), which is a density of the parameters.
It is trained on simulated clouds and their parameters. The mean of -log q(parameters | clouds) is minimal if q is the
posterior, with the distribution of the training parameters as the prior. It uses the same simulator and noise model as
the intervals of a fit, but no linearisation and another loss.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from diffcloud.errors import ConfigError
from diffcloud.regressors.grouping import Order
from diffcloud.regressors.meteornet import MeteorNet

_FEATURES = 32
"""Number of features of the clouds that condition the flow."""
_HIDDEN, _TRANSFORMS = 48, 3
_EDGE = 1e-4
"""Fractions of the range are clipped to this distance from 0 and 1, because the flow uses their logits."""


class Posterior(nn.Module):
    """Density of k parameters, conditioned on clouds."""

    def __init__(
        self, parameters: int, *, frames: int, dropout: float | None = None, order: Order = "cloud", density: float = 1.0
    ) -> None:
        """Create the network and the flow.

        Args:
            parameters: number of parameters k.
            frames, dropout, order, density: settings of the network, see `networks.build_network`.

        Raises:
            ConfigError: sbi is not installed.
        """
        super().__init__()
        head = {} if dropout is None else {"dropout": dropout}
        self.embedding = MeteorNet(_FEATURES, frames=frames, order=order, density=density, **head)
        self.flow = _flow(parameters)

    def forward(self, clouds: Tensor) -> Tensor:
        """Map clouds [B, T, P, 3] to features [B, features]."""
        features: Tensor = self.embedding(clouds)
        return features

    def loss(self, clouds: Tensor, fractions: Tensor) -> Tensor:
        """Return the mean of -log q for fractions [B, k] of the range."""
        found: Tensor = self.flow.loss(_logits(fractions), condition=self(clouds)).mean()
        return found

    def sample(self, clouds: Tensor, count: int, generator: int) -> Tensor:
        """Return samples [B, count, k] as fractions of the range, all within the bounds.

        Args:
            generator: seed of the samples.
        """
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(generator)
            drawn: Tensor = self.flow.sample((count,), condition=self(clouds))
        return drawn.transpose(0, 1).sigmoid()

    def log_density(self, clouds: Tensor, fractions: Tensor) -> Tensor:
        """Return log-densities [B, S] of fractions [B, S, k], up to a constant for each cloud. They are densities of
        the logits. This ranking differs from that by densities of the parameters, so compare only values of this
        function, as in a coverage check."""
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
