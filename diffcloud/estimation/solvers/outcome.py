"""Progress and result types that all solvers share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

if TYPE_CHECKING:
    from diffcloud.estimation.likelihood import Estimate

StopReason = Literal["converged", "iterations", "simulations", "threshold", "interrupted"]
"""`converged`: the best start converged, or the candidates of a search are close together. `threshold`: the loss is
below the threshold. `iterations` or `simulations`: the limit was reached first. `interrupted`: Ctrl-C."""


@dataclass(frozen=True)
class Progress:
    """Progress after one iteration, or after one batch of a search."""

    iteration: int
    loss: float
    best: float
    values: Mapping[str, float]
    """Values of the best iterate so far."""
    simulations: int | None = None
    """Number of simulations so far, which the budget of a search limits; None for other solvers."""


@dataclass
class FitHistory:
    """Losses, values and gradients of N iterations, B starts and k variables. A search has B = 1, the best so far."""

    names: tuple[str, ...]
    losses: list[Tensor] = field(default_factory=list)
    """N tensors [B], without perturbation; infinite for a diverged start."""
    values: list[Tensor] = field(default_factory=list)
    """N tensors [B, k]."""
    gradients: list[Tensor] = field(default_factory=list)
    """N tensors [B, k], with respect to the unbounded variables; empty for a search."""


@dataclass(frozen=True)
class FitOutcome:
    """Result of a solver: the best iterate of all starts."""

    values: dict[str, float]
    loss: float
    best_start: int
    simulations: int
    """Number of simulations, including gradients (searches have none)."""
    stop_reason: StopReason
    seconds: float
    history: FitHistory
    failures: tuple[str, ...] = ()
    """Messages of diverged starts."""
    estimate: Estimate | None = None
    """The estimate with its uncertainty; None unless the solver is `likelihood`."""

    def uninterrupted(self) -> FitOutcome:
        """Return self, or raise KeyboardInterrupt if the fit was interrupted.

        Raises:
            KeyboardInterrupt: Ctrl-C ended the fit.
        """
        if self.stop_reason == "interrupted":
            raise KeyboardInterrupt
        return self

    @property
    def iterations(self) -> int:
        """Number of updates, or of batches after the first in a search."""
        return len(self.history.losses) - 1

    @property
    def start(self) -> dict[str, float]:
        """Initial values of the first start whose initial loss is finite. For a search, the best values of the first batch
        with a finite loss."""
        return dict(zip(self.history.names, self.history.values[0][self._first].tolist(), strict=True))

    @property
    def loss_start(self) -> float:
        """Loss at `start`, before the first update."""
        return float(self.history.losses[0][self._first])

    @property
    def _first(self) -> int:
        return int(torch.isfinite(self.history.losses[0]).nonzero()[0])
