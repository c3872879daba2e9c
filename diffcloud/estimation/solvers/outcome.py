"""What every solver hands out: progress while it works, and what it found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

if TYPE_CHECKING:
    from diffcloud.estimation.likelihood import Estimate

StopReason = Literal["converged", "iterations", "simulations", "threshold", "interrupted"]
"""`converged`: the best start has arrived, or the candidates of a search lie together. `threshold`: low enough.
`iterations`, or `simulations` of a search: none of them yet."""


@dataclass(frozen=True)
class Progress:
    """What a progress display gets after each iteration, which is a batch of a search."""

    iteration: int
    loss: float
    best: float
    values: Mapping[str, float]
    """Of the best so far."""
    simulations: int | None = None
    """Simulations so far, which count towards the budget of a search; None for other solvers."""


@dataclass
class FitHistory:
    """Losses, values and gradients of N iterations, B starts and k variables. A search has B = 1, its best so far."""

    names: tuple[str, ...]
    losses: list[Tensor] = field(default_factory=list)
    """N of [B], unperturbed; infinite for a start that has diverged."""
    values: list[Tensor] = field(default_factory=list)
    """N of [B, k]"""
    gradients: list[Tensor] = field(default_factory=list)
    """N of [B, k], by the unbounded variables; none of a search."""


@dataclass(frozen=True)
class FitOutcome:
    """The best iterate of all starts."""

    values: dict[str, float]
    loss: float
    best_start: int
    simulations: int
    """Simulations run, with their gradients but for searches."""
    stop_reason: StopReason
    seconds: float
    history: FitHistory
    failures: tuple[str, ...] = ()
    """Messages of starts that diverged."""
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
        """Updates done, or batches of a search after the first."""
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
