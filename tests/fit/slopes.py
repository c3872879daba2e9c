"""The law of every linearisation: its slope is half the gradient of the loss, by reverse mode through the simulation."""

from __future__ import annotations

import torch
from torch import Tensor

from diffcloud.fit import FitSpace
from diffcloud.fit.batches import posterior_losses
from diffcloud.fit.joint import AnyObjective
from diffcloud.fit.residuals import Axis, Linearisation, linearise


def linearised(
    objective: AnyObjective, space: FitSpace, places: Tensor, *, rtol: float = 1e-8, atol: float = 1e-14
) -> Linearisation:
    """The linearisation at places [B, k] of the axis, once its losses and slopes are those of the loss, priors included."""
    places = places.detach().requires_grad_(True)
    losses = posterior_losses(objective, space, Axis.of(space).values(places))
    (gradient,) = torch.autograd.grad(losses.sum(), places)
    found = linearise(objective, space, places.detach())
    torch.testing.assert_close(found.losses, losses.detach())
    torch.testing.assert_close(2 * found.slope, gradient, rtol=rtol, atol=atol)
    return found
