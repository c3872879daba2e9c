"""Settings of a fit by its likelihood."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class LikelihoodSettings:
    """Of one fit."""

    max_steps: int = 12
    """Places that each start compares at most, the first one included."""
    starts: int = 3
    """Descents: from the centres of the priors, then with the first variable, the stretching, above and below."""
    seed: int = 0
    """Of the points that are drawn."""
    model_error: bool = True
    """Whether the cloth may move otherwise than this simulator on this mesh can make it move; False for its own motions."""
    init: Mapping[str, float] = field(default_factory=dict)
    """Values of the first start."""
