"""Batches of parameter sets of which some may diverge."""

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
    """Run a batch, without the entries that diverge.

    Args:
        count: B entries.
        run: takes the indices [b] of the entries still in the batch; raises DivergedError.

    Returns:
        What `run` gave (None if nothing is left), the indices [b] that it was given, and entry -> message of the others.
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
    """[B, k] values -> [B] losses with the priors; differentiable.

    Raises:
        DivergedError: names step and batch entries.
    """
    return objective(space.parameters(values)) * space.prior_factor(values, len(objective.members))


def batch_losses(objective: AnyObjective, space: FitSpace, values: Tensor) -> Tensor:
    """The same without a gradient; infinite where the simulation diverges."""
    losses = torch.full((len(values),), math.inf, dtype=values.dtype)
    with torch.no_grad():
        found, kept, _ = without_diverged(len(values), lambda index: posterior_losses(objective, space, values[index]))
    if found is not None:
        losses[kept] = found.to(losses)
    return losses
