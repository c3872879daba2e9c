"""Common part of searches without derivatives, which have a budget of simulations.

A search proposes points in the unit box. It is mapped to the bounds in fit coordinates (`residuals.Axis`), which are
logarithmic if the lower bound is positive. The first point is given. Diverged simulations have infinite loss.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloud.errors import ConfigError, DivergedError
from diffcloud.estimation.batches import batch_losses
from diffcloud.estimation.joint import AnyObjective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.residuals import Axis
from diffcloud.estimation.solvers.outcome import FitHistory, FitOutcome, Progress, StopReason


@dataclass(frozen=True)
class SearchSettings:
    """Settings of one search.

    Raises:
        ConfigError: the budget is less than one simulation.
    """

    max_simulations: int = 200
    """Maximum number of simulations. A parameter set needs one per recording."""
    threshold: float = 0.0
    """Loss below which the search stops; 0: never."""
    seed: int = 0
    """Seed of the samples."""
    init: Mapping[str, float] = field(default_factory=dict)
    """Values of the first parameter set; by default the centre of the range."""

    def __post_init__(self) -> None:
        if self.max_simulations < 1:
            raise ConfigError(f"A search needs simulations: one or more, got {self.max_simulations}.")


class Proposals(Protocol):
    """Interface of a search strategy."""

    @property
    def converged(self) -> bool:
        """Whether further candidates are not expected to be better."""

    def ask(self) -> NDArray[np.float64]:
        """Return the next candidates [b, k] in the unit box, which are simulated as one batch."""

    def tell(self, losses: NDArray[np.float64]) -> None:
        """Receive the losses [b] of the last candidates; infinite if a simulation diverged."""


def search(
    objective: AnyObjective,
    space: FitSpace,
    settings: SearchSettings,
    propose: Callable[[NDArray[np.float64]], Proposals],
    *,
    progress: Callable[[Progress], None] | None = None,
) -> FitOutcome:
    """Evaluate candidates until the budget is used. Ctrl-C ends the search and keeps the best so far.

    The history has one column, the lowest loss after each batch. It begins with the first finite loss.

    Args:
        propose: function that creates the search strategy from the first point [k] in the unit box.

    Raises:
        DivergedError: every parameter set diverged.
        KeyboardInterrupt: Ctrl-C before the first loss.
    """
    began = time.perf_counter()
    axis = Axis.of(space)
    low, high = axis.ends
    values = space.starts(1, seed=settings.seed, first=settings.init)[0].double()
    proposals = propose(((axis.places(values[0]) - low) / (high - low)).numpy())
    best = _Best(math.inf, values[0])
    history = FitHistory(space.names)
    simulated, each = 0, len(objective.members)

    def simulate(batch: Tensor) -> NDArray[np.float64]:
        nonlocal best, simulated
        losses = batch_losses(objective, space, batch)
        simulated += each * len(batch)
        lowest = int(losses.argmin())
        if float(losses[lowest]) < best.loss:
            best = _Best(float(losses[lowest]), batch[lowest])
        if math.isfinite(best.loss):
            history.losses.append(torch.tensor([best.loss], dtype=torch.float64))
            history.values.append(best.values[None])
        if progress is not None:
            told = dict(zip(space.names, best.values.tolist(), strict=True))
            iteration = max(len(history.losses) - 1, 0)
            progress(Progress(iteration, float(losses[lowest]), best.loss, told, simulations=simulated))
        return losses.numpy()

    reason: StopReason = "simulations"
    try:
        simulate(values)
        while simulated + each <= settings.max_simulations and not best.loss < settings.threshold:
            if proposals.converged:
                reason = "converged"
                break
            asked = proposals.ask()
            places = torch.as_tensor(asked[: (settings.max_simulations - simulated) // each])
            losses = simulate(axis.bounded(low + (high - low) * places))
            if len(losses) == len(asked):  # else the budget has ended within the batch
                proposals.tell(losses)
        if best.loss < settings.threshold:
            reason = "threshold"
    except KeyboardInterrupt:
        if not history.losses:
            raise
        reason = "interrupted"
    if not history.losses:
        raise DivergedError(0, [], f"all {simulated // each} parameter sets diverged")
    return FitOutcome(
        values=dict(zip(space.names, best.values.tolist(), strict=True)),
        loss=best.loss,
        best_start=0,
        simulations=simulated,
        stop_reason=reason,
        seconds=time.perf_counter() - began,
        history=history,
    )


@dataclass(frozen=True)
class _Best:
    loss: float
    values: Tensor
    """[k] values of the best candidate."""
