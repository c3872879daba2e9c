"""Adam with the paper's settings, from several starts at once (paper, sections III-C and IV)."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from diffcloud.errors import DivergedError
from diffcloud.estimation.batches import posterior_losses
from diffcloud.estimation.joint import AnyObjective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.solvers.outcome import FitHistory, FitOutcome, Progress, StopReason

_COPIES = 8
"""Number of perturbed copies of the first start. They are antithetic pairs, so it is even."""


@dataclass(frozen=True)
class AdamSettings:
    """Settings of one fit with Adam."""

    learning_rate: float = 0.2
    max_steps: int = 50
    threshold: float = 0.0
    """Loss below which the descent stops; 0: never."""
    starts: int = 1
    seed: int = 0
    resample: bool = False
    """Sample new points in each iteration, as the published scripts do, instead of using the same ones."""
    smoothing: float = 0.0
    """Standard deviation of the perturbed copies of the first start, in unbounded variables; 0: no copies.

    After contact the loss is non-smooth, and its exact gradient is often useless over finite distances. The mean
    gradient of several perturbed copies estimates the gradient of a smoothed loss (randomised smoothing; Suh et al.
    2022, "Do differentiable simulators give better policy gradients?"). The copies are simulated as one batch. Each is
    also a candidate for the result. Other starts have no copies.
    """
    init: Mapping[str, float] = field(default_factory=dict)
    """Values of the first start; by default the centre of the range."""


def fit_adam(
    objective: AnyObjective,
    space: FitSpace,
    settings: AdamSettings,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> FitOutcome:
    """Minimise the loss and return the iterate with the lowest one.

    A start that diverges is dropped and reported; the others continue. Ctrl-C ends the fit and keeps the best result so
    far.

    Raises:
        DivergedError: every start diverged.
        KeyboardInterrupt: Ctrl-C before the first loss.
    """
    began = time.perf_counter()
    start_values, logarithmic = space.starts(settings.starts, seed=settings.seed, first=settings.init)
    start_values, simulations = start_values.double(), 0
    unbounded = space.unbounded(start_values, logarithmic).requires_grad_()
    optimiser = torch.optim.Adam([unbounded], lr=settings.learning_rate)
    generator = torch.Generator().manual_seed(settings.seed)
    alive = torch.ones(settings.starts, dtype=torch.bool)
    history = FitHistory(space.names)
    failures: list[str] = []
    best = _Best(math.inf, 0, start_values[0])
    reason: StopReason = "iterations"
    try:
        for iteration in range(settings.max_steps + 1):
            if settings.resample and iteration:
                objective.reseed(settings.seed + iteration)
            owner, noise = _trials(settings, unbounded, generator)
            optimiser.zero_grad()
            while True:
                owner, noise = owner[alive[owner]], noise[alive[owner]]
                values = space.values(unbounded[owner] + noise, logarithmic[owner])
                try:
                    simulations += len(values) * len(objective.members)
                    found = posterior_losses(objective, space, values)
                    share = 1.0 / torch.bincount(owner, minlength=settings.starts)[owner]
                    (share * found).sum().backward()
                    break
                except DivergedError as error:
                    lost = torch.zeros(len(owner), dtype=torch.bool)
                    lost[error.entries] = True
                    for entry in (lost & (noise == 0).all(-1)).nonzero().flatten().tolist():
                        alive[owner[entry]] = False  # the start itself; a diverged copy is only skipped in this iteration
                        failures.append(f"start {int(owner[entry])} {_describe(space, values[entry])}: {error}")
                    if not bool(alive.any()):
                        described = _describe(space, values[error.entries[0]])
                        raise DivergedError(error.step, error.entries, error.reason, described) from error
                    owner, noise = owner[~lost], noise[~lost]
            found, values = found.detach(), values.detach()
            unperturbed = (noise == 0).all(-1)
            losses = torch.full((settings.starts,), math.inf, dtype=torch.float64)
            losses[owner[unperturbed]] = found[unperturbed]
            centre = torch.full_like(start_values, float("nan"))
            centre[owner[unperturbed]] = values[unperturbed]
            assert unbounded.grad is not None
            history.losses.append(losses)
            history.values.append(centre)
            history.gradients.append(unbounded.grad.clone())
            lowest = int(found.argmin())
            if float(found[lowest]) < best.loss:
                best = _Best(float(found[lowest]), int(owner[lowest]), values[lowest])
            if progress is not None:
                named = dict(zip(space.names, best.values.tolist(), strict=True))
                progress(Progress(iteration, float(losses.min()), best.loss, named))
            if best.loss < settings.threshold:
                reason = "threshold"
                break
            if iteration < settings.max_steps:
                optimiser.step()
    except KeyboardInterrupt:
        if not history.losses:
            raise
        reason = "interrupted"
    if settings.resample:
        objective.reseed(settings.seed)  # the record states this seed, so later evaluations must use these points
    return FitOutcome(
        values=dict(zip(space.names, best.values.tolist(), strict=True)),
        loss=best.loss,
        best_start=best.start,
        simulations=simulations,
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
    """[k] values of the best iterate."""


def _trials(settings: AdamSettings, unbounded: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return the start [E] to which each simulation of one iteration belongs, and its perturbation [E, k]."""
    starts, variables = unbounded.shape
    half = settings.smoothing * torch.randn(_COPIES // 2, variables, generator=generator)
    copies = torch.cat([half, -half]) if settings.smoothing else half[:0]
    owner = torch.cat([torch.arange(starts), torch.zeros(len(copies), dtype=torch.long)])
    return owner.to(unbounded.device), torch.cat([torch.zeros(starts, variables), copies]).to(unbounded)


def _describe(space: FitSpace, values: Tensor) -> str:
    return "(" + ", ".join(f"{name}={value:.4g}" for name, value in zip(space.names, values.tolist(), strict=True)) + ")"
