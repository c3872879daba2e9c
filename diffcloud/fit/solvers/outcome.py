"""What every solver hands out: progress while it works, and what it found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from torch import Tensor

StopReason = Literal["converged", "rough", "iterations", "threshold", "interrupted"]
"""`converged`: the best start cannot get lower by more than a thousandth. `rough`: steps along its slope lower the loss no
more. `threshold`: low enough. `iterations`: none of them yet."""


@dataclass(frozen=True)
class Progress:
    """What a progress display gets after each iteration."""

    iteration: int
    loss: float
    best: float
    values: Mapping[str, float]
    """Of the best so far."""


@dataclass
class FitHistory:
    """What happened; N iterations, B starts, k variables."""

    names: tuple[str, ...]
    losses: list[Tensor] = field(default_factory=list)
    """N of [B], unperturbed; infinite for a start that has diverged."""
    values: list[Tensor] = field(default_factory=list)
    """N of [B, k]"""
    gradients: list[Tensor] = field(default_factory=list)
    """N of [B, k], by the unbounded variables."""


@dataclass(frozen=True)
class FitOutcome:
    """The best iterate of all starts."""

    values: dict[str, float]
    loss: float
    start: dict[str, float]
    """Initial values of the first start that did not diverge at once."""
    loss_start: float
    """Its loss before the first update."""
    best_start: int
    iterations: int
    """Updates done."""
    evaluations: int
    """Simulations run, with their gradients."""
    stop_reason: StopReason
    seconds: float
    history: FitHistory
    failures: tuple[str, ...]
    """Messages of starts that diverged."""
