"""Adam with the paper's settings, over several starts at once (paper, sections III-C and IV)."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from diffcloud.errors import DivergedError
from diffcloud.fit.objective import Objective
from diffcloud.fit.parameters import FitSpace

StopReason = Literal["iterations", "threshold", "interrupted"]


@dataclass(frozen=True)
class AdamSettings:
    """Of one fit."""

    learning_rate: float = 0.2
    iterations: int = 50
    threshold: float = 0.0
    """Stop below this loss; 0: never."""
    starts: int = 1
    seed: int = 0
    resample: bool = False
    """Draw new points in each iteration (the published scripts do) instead of common random numbers."""
    init: Mapping[str, float] = field(default_factory=dict)
    """Values of the first start; the middle of the range where not given."""


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
    """N of [B]; infinite for a start that has diverged."""
    values: list[Tensor] = field(default_factory=list)
    """N of [B, k]"""
    gradients: list[Tensor] = field(default_factory=list)
    """N of [B, k], by the unbounded variables."""


@dataclass(frozen=True)
class FitOutcome:
    """The best iterate of all starts."""

    values: dict[str, float]
    loss: float
    loss_start: float
    """Of the first start, before the first update."""
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


def fit_adam(
    objective: Objective,
    space: FitSpace,
    settings: AdamSettings,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> FitOutcome:
    """Minimise; the lowest-loss iterate wins. Ctrl-C ends the fit and keeps the best so far.

    A start that diverges is dropped and reported; the others go on.

    Raises:
        DivergedError: every start diverged.
        KeyboardInterrupt: interrupted before the first loss.
    """
    began = time.perf_counter()
    device, dtype = objective.system.device, objective.system.dtype
    start_values, logarithmic = space.starts(settings.starts, seed=settings.seed, first=settings.init)
    start_values, logarithmic = start_values.to(device, dtype), logarithmic.to(device)
    unbounded = space.unbounded(start_values, logarithmic).requires_grad_(True)
    optimiser = torch.optim.Adam([unbounded], lr=settings.learning_rate)
    alive = torch.ones(settings.starts, dtype=torch.bool, device=device)
    history, failures = FitHistory(space.names), []
    best_loss, best_start, best_values = float("inf"), 0, start_values[0]
    reason: StopReason = "iterations"
    evaluations = 0
    try:
        for iteration in range(settings.iterations + 1):
            if settings.resample and iteration:
                objective.reseed(settings.seed + iteration)
            optimiser.zero_grad()
            values = space.values(unbounded, logarithmic)
            losses = torch.full((settings.starts,), float("inf"), dtype=dtype, device=device)
            while True:
                chosen = alive.nonzero().flatten()
                try:
                    evaluations += len(chosen)
                    found = objective(*space.split(values[chosen]))
                    found.sum().backward()  # type: ignore[no-untyped-call]
                    break
                except DivergedError as error:
                    lost = chosen[error.entries]
                    failures += [f"start {int(s)} {_describe(space, values[s])}: {error}" for s in lost]
                    alive[lost] = False
                    if not bool(alive.any()):
                        raise DivergedError(error.step, lost.tolist(), error.reason, failures[-1]) from error
                    values = space.values(unbounded, logarithmic)
            losses[chosen] = found.detach()
            gradient = torch.zeros_like(unbounded) if unbounded.grad is None else unbounded.grad.clone()
            history.losses.append(losses)
            history.values.append(values.detach())
            history.gradients.append(gradient)
            lowest = int(losses.argmin())
            if float(losses[lowest]) < best_loss:
                best_loss, best_start, best_values = float(losses[lowest]), lowest, values.detach()[lowest]
            if progress is not None:
                named = dict(zip(space.names, best_values.tolist(), strict=True))
                progress(Progress(iteration, float(losses[lowest]), best_loss, named))
            if best_loss < settings.threshold:
                reason = "threshold"
                break
            if iteration < settings.iterations:
                optimiser.step()
    except KeyboardInterrupt:
        if not history.losses:
            raise
        reason = "interrupted"
    return FitOutcome(
        values=dict(zip(space.names, best_values.tolist(), strict=True)),
        loss=best_loss,
        loss_start=float(history.losses[0][0]),
        best_start=best_start,
        iterations=len(history.losses) - 1,
        evaluations=evaluations,
        stop_reason=reason,
        seconds=time.perf_counter() - began,
        history=history,
        failures=tuple(failures),
    )


def _describe(space: FitSpace, values: Tensor) -> str:
    return "(" + ", ".join(f"{name}={value:.4g}" for name, value in zip(space.names, values.tolist(), strict=True)) + ")"
