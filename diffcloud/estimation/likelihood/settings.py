"""Settings of a maximum-likelihood fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class LikelihoodSettings:
    """Settings of one fit with the solver `likelihood`."""

    max_steps: int = 12
    """Maximum number of iterates per start, the first one included."""
    starts: int = 3
    """Number of starts. The first is at the centres of the priors. The others shift the first variable (usually
    stretching) up and down."""
    seed: int = 0
    """Seed of the sampled points."""
    model_error: bool = True
    """Whether the fit allows for errors of the simulator and its mesh. Use False for motions that this simulator made."""
    init: Mapping[str, float] = field(default_factory=dict)
    """Values of the first start."""
