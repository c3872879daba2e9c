"""How far gradients can be trusted: their sign and size against differences of one percent, at random parameters."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.properties import PARAMETERS
from diffcloud.sim.simulate import rollout

NAMES = ("stretching", "density")
_CHUNK = 10
"""Pairs simulated together."""
STEP = 0.01
"""Of the central difference, as a part of the parameter."""


@dataclass(frozen=True)
class Agreement:
    """Derivatives of one loss at n parameter sets."""

    parameters: NDArray[np.float64]
    """[n, 2] multipliers of stretching and density."""
    gradient: NDArray[np.float64]
    """[n, 2] by reverse mode."""
    difference: NDArray[np.float64]
    """[n, 2] central difference of ±1 % of the parameter."""

    @property
    def same_sign(self) -> NDArray[np.bool_]:
        """[n, 2]"""
        return np.asarray(self.gradient * self.difference > 0)

    @property
    def same_size(self) -> NDArray[np.bool_]:
        """[n, 2] same sign, and sizes within a factor of 2."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = self.gradient / self.difference
        return np.asarray((ratio >= 0.5) & (ratio <= 2.0))


def random_parameters(scenario: Scenario, count: int, *, seed: int) -> NDArray[np.float64]:
    """[count, 2] stretching and density, uniform over their bounds; a longer list begins with the shorter one."""
    low, high = np.transpose([scenario.bounds.get(name, PARAMETERS[name].bounds) for name in NAMES])
    return np.random.default_rng(seed).uniform(low, high, (count, len(NAMES)))


def gradient_agreement(scenario: Scenario, parameters: NDArray[np.float64]) -> Iterator[Agreement]:
    """Compare derivatives of a loss that knows neither sampling nor noise, a few parameter sets at a time.

    The loss is the mean squared node distance at the first loss frame to the run at (1, 1).

    Args:
        parameters: [n, 2] stretching and density.

    Raises:
        DivergedError: names step and batch entries.
    """
    system, _ = scenario.scene.build()
    steps = (scenario.loss_frames[0] % (scenario.frames + 1)) * scenario.scene.frame_steps

    def last(values: Tensor) -> Tensor:
        properties = scenario.properties(system, dict(zip(NAMES, values.T, strict=True)))
        return rollout(system, steps, properties=properties).positions[:, -1]

    with torch.no_grad():
        target = last(torch.ones(1, len(NAMES), dtype=torch.float64))

    def losses(values: Tensor) -> Tensor:
        return (last(values) - target).square().sum(-1).mean(-1)

    nudge = STEP * torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], dtype=torch.float64)
    for begin in range(0, len(parameters), _CHUNK):
        chunk = parameters[begin : begin + _CHUNK]
        values = torch.as_tensor(chunk).requires_grad_()
        (gradient,) = torch.autograd.grad(losses(values).sum(), values)
        with torch.no_grad():
            around = losses((values[:, None] * (1 + nudge)).flatten(0, 1)).reshape(-1, len(NAMES), 2)
            difference = (around[..., 0] - around[..., 1]) / (2 * STEP * values)
        yield Agreement(chunk, gradient.numpy(), difference.numpy())
