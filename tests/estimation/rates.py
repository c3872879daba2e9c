"""The law of how motions change: their rates are derivatives of the nodes by what is fitted."""

from __future__ import annotations

import torch
from torch import Tensor

from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.residuals import Axis, Moved, moved_by


def check_rates(objective: Objective, space: FitSpace, places: Tensor, *, rtol: float = 1e-8, atol: float = 1e-14) -> Moved:
    """The motions at places [B, k] of the axis, once their rates are those of reverse mode through the simulation.

    Reverse mode gives the slope of a weighted sum of all nodes; the weights are random.
    """
    places = places.detach().requires_grad_(True)
    nodes = objective.looked_at(objective.simulate_to_loss(space.parameters(Axis.of(space).values(places))))
    generator = torch.Generator().manual_seed(1)
    weights = torch.randn(nodes.shape, generator=generator, dtype=torch.float64) / nodes[0].numel()
    (slope,) = torch.autograd.grad((weights * nodes).sum(), places)
    with torch.no_grad():
        found = moved_by(objective, space, places.detach())
        torch.testing.assert_close(objective.looked_at(found.run), nodes.detach())
        torch.testing.assert_close(torch.einsum("kblni,blni->bk", found.rates, weights), slope, rtol=rtol, atol=atol)
    assert bool((slope != 0).all())
    return found
