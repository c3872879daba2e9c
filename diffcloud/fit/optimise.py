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
    smoothing: float = 0.0
    """Standard deviation of perturbed copies on the unbounded axis, whose gradients are averaged; 0: none.

    After contact the loss is rough, and its exact derivative is right in the small and often useless in the large. The
    mean gradient over a few perturbed copies estimates the slope of the smoothed loss (randomised smoothing; Suh et al.
    2022, "Do differentiable simulators give better policy gradients?"). The copies are simulated as one batch, and they
    are iterates like any other: each is a parameter set whose loss has been measured.
    """
    copies: int = 8
    """Perturbed copies per start, in antithetic pairs; even."""
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
    generator = torch.Generator().manual_seed(settings.seed)
    alive = torch.ones(settings.starts, dtype=torch.bool, device=device)
    history = FitHistory(space.names)
    failures: list[str] = []
    best = _Best(float("inf"), 0, start_values[0])
    reason: StopReason = "iterations"
    evaluations = 0
    try:
        for iteration in range(settings.iterations + 1):
            if settings.resample and iteration:
                objective.reseed(settings.seed + iteration)
            noise = _perturbations(unbounded, settings, generator)  # [C, B, k], the first zero
            optimiser.zero_grad()
            while True:
                chosen = alive.nonzero().flatten()
                values = space.values((unbounded + noise)[:, chosen].flatten(0, 1), logarithmic[chosen].repeat(len(noise)))
                try:
                    evaluations += len(values)
                    found = objective(*space.split(values)).unflatten(0, (len(noise), len(chosen)))
                    found.mean(0).sum().backward()
                    break
                except DivergedError as error:
                    entries = sorted({entry % len(chosen) for entry in error.entries})
                    described = [_describe(space, values[entry]) for entry in entries]
                    failures += [
                        f"start {int(chosen[e])} {text}: {error}" for e, text in zip(entries, described, strict=True)
                    ]
                    alive[chosen[entries]] = False
                    if not bool(alive.any()):
                        raise DivergedError(error.step, error.entries, error.reason, described[-1]) from error
            values = values.detach().unflatten(0, found.shape)
            losses = torch.full((settings.starts,), float("inf"), dtype=dtype, device=device)
            losses[chosen] = found.detach()[0]
            centre = torch.full_like(start_values, float("nan"))
            centre[chosen] = values[0]
            assert unbounded.grad is not None
            history.losses.append(losses)
            history.values.append(centre)
            history.gradients.append(unbounded.grad.clone())
            lowest = int(found.detach().argmin())
            copy, start = divmod(lowest, len(chosen))
            if float(found[copy, start].detach()) < best.loss:
                best = _Best(float(found[copy, start].detach()), int(chosen[start]), values[copy, start])
            if progress is not None:
                named = dict(zip(space.names, best.values.tolist(), strict=True))
                progress(Progress(iteration, float(losses.min()), best.loss, named))
            if best.loss < settings.threshold:
                reason = "threshold"
                break
            if iteration < settings.iterations:
                optimiser.step()
    except KeyboardInterrupt:
        if not history.losses:
            raise
        reason = "interrupted"
    return FitOutcome(
        values=dict(zip(space.names, best.values.tolist(), strict=True)),
        loss=best.loss,
        loss_start=float(history.losses[0][0]),
        best_start=best.start,
        iterations=len(history.losses) - 1,
        evaluations=evaluations,
        stop_reason=reason,
        seconds=time.perf_counter() - began,
        history=history,
        failures=tuple(failures),
    )


@dataclass(frozen=True)
class _Best:
    loss: float
    start: int
    values: Tensor
    """[k]"""


def _perturbations(unbounded: Tensor, settings: AdamSettings, generator: torch.Generator) -> Tensor:
    """[1 + copies, B, k]: zero, then antithetic pairs."""
    zero = torch.zeros(1, *unbounded.shape)
    if settings.smoothing == 0:
        return zero.to(unbounded)
    half = settings.smoothing * torch.randn(settings.copies // 2, *unbounded.shape, generator=generator)
    return torch.cat([zero, half, -half]).to(unbounded)


def _describe(space: FitSpace, values: Tensor) -> str:
    return "(" + ", ".join(f"{name}={value:.4g}" for name, value in zip(space.names, values.tolist(), strict=True)) + ")"
