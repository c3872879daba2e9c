"""Evaluation of batches of parameter sets, some of which may diverge."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor

from diffcloud.errors import DivergedError
from diffcloud.estimation.joint import AnyObjective
from diffcloud.estimation.parameters import FitSpace

T = TypeVar("T")


def without_diverged(count: int, run: Callable[[Tensor], T]) -> tuple[T | None, Tensor, dict[int, str]]:
    """Run a batch repeatedly until no entry diverges, dropping the diverged entries.

    Args:
        count: number of entries B.
        run: function of the indices [b] of the remaining entries. Raises DivergedError.

    Returns:
        The result of `run` (None if no entry is left), the remaining indices [b], and dropped entry -> message.
    """
    kept, lost = torch.arange(count), dict[int, str]()
    while len(kept):
        try:
            return run(kept), kept, lost
        except DivergedError as error:
            gone = torch.zeros(len(kept), dtype=torch.bool)
            gone[error.entries] = True
            lost |= {int(entry): str(error) for entry in kept[gone]}
            kept = kept[~gone]
    return None, kept, lost


def posterior_losses(objective: AnyObjective, space: FitSpace, values: Tensor) -> Tensor:
    """Return losses [B] of values [B, k], multiplied by the prior factors; differentiable.

    Raises:
        DivergedError: a simulation diverged; names the step and the batch entries.
    """
    return objective(space.parameters(values)) * space.prior_factor(values, len(objective.members))


def batch_losses(objective: AnyObjective, space: FitSpace, values: Tensor) -> Tensor:
    """Return `posterior_losses` without gradients; infinite if the simulation diverges."""
    losses = torch.full((len(values),), math.inf, dtype=values.dtype)
    with torch.no_grad():
        found, kept, _ = without_diverged(len(values), lambda index: posterior_losses(objective, space, values[index]))
    if found is not None:
        losses[kept] = found.to(losses)
    return losses
