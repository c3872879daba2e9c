"""Losses along the principal axes of a fitted place: is another minimum lower, and how far do nearly as low ones reach?

Where a cloth may fold in more than one way, the loss has many minima, side by side. A descent knows the one that it ended
in, and its curvature only how sharp that one is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffcloud.fit.batches import batch_losses
from diffcloud.fit.joint import AnyObjective
from diffcloud.fit.parameters import FitSpace
from diffcloud.fit.record import LARGEST, ScanRecord
from diffcloud.fit.residuals import Axis

LOWER = 0.02
"""Part by which a loss nearby must be lower to be another minimum."""
LENGTHS = (0.04, 0.1, 0.25, 0.6)
"""On the axis, to both sides."""
AXES = 3
"""The flattest ones: minima lie side by side along them, and the cost does not grow with the number of variables. Along a
steep axis the loss rises over the shortest of these lengths already."""


@dataclass(frozen=True)
class Scan:
    """Around one place, of k variables."""

    directions: Tensor
    """[a, k] principal axes of what is asked for, in rows, the flattest first. What is doubtful follows: to where, by the
    curvature, the loss is lowest."""
    lengths: Tensor
    """[a, n] along each, negative ones first; where a bound cuts one short, its length is what is left."""
    losses: Tensor
    """[a, n] with priors; infinite where a motion diverges."""

    def place(self, centre: Tensor) -> tuple[Tensor, float]:
        """Where the loss is lowest [k], and that loss."""
        axis, index = divmod(int(self.losses.argmin()), self.losses.shape[1])
        return centre + self.lengths[axis, index] * self.directions[axis], float(self.losses[axis, index])

    def corrected(self, loss: float) -> Scan:
        """With another loss where it is lowest."""
        losses = self.losses.clone()
        losses.view(-1)[int(losses.argmin())] = loss
        return replace(self, losses=losses)

    @staticmethod
    def of(record: ScanRecord) -> Scan:
        """That of a fit's record."""
        directions, lengths = (torch.tensor(part, dtype=torch.float64) for part in (record.directions, record.lengths))
        losses = [[torch.inf if loss is None else loss for loss in row] for row in record.losses]
        return Scan(directions, lengths, torch.tensor(losses, dtype=torch.float64))

    def record(self) -> ScanRecord:
        """As a fit's file has it."""
        losses = [[loss if loss <= LARGEST else None for loss in row] for row in self.losses.tolist()]
        return ScanRecord(directions=self.directions.tolist(), lengths=self.lengths.tolist(), losses=losses)

    def lower(self, centre: Tensor, loss: float) -> Tensor | None:
        """A place [k] of another minimum, lower than the centre's loss; None if the scan has met none."""
        place, lowest = self.place(centre)
        return place if lowest < (1 - LOWER) * loss else None


def scan(objective: AnyObjective, space: FitSpace, place: Tensor, curvature: Tensor) -> tuple[Scan, int]:
    """
    Args:
        place: [k] on the axis.
        curvature: [k, k] half of the loss's.

    Returns:
        The scan, and how many simulations it took.
    """
    axis = Axis.of(space)
    directions = _axes(space, curvature)
    ways = torch.tensor([-length for length in reversed(LENGTHS)] + list(LENGTHS), dtype=torch.float64)
    moving = torch.where(directions.abs() > 1e-9, directions, 0.0)
    back, forth = (axis.room(place.expand_as(moving), sign * moving)[:, None] for sign in (-1, 1))
    lengths = ways.clamp(-back, forth)
    places = place + lengths[..., None] * directions[:, None]
    losses = batch_losses(objective, space, axis.bounded(places.flatten(0, 1))).reshape(lengths.shape)
    return Scan(directions, lengths, losses), losses.numel() * len(objective.members)


def _axes(space: FitSpace, curvature: Tensor) -> Tensor:
    """[a, k] directions of a scan: of the curvature [k, k] with doubtful variables solved for."""
    doubtful = torch.tensor([variable.doubtful for variable in space.variables])
    asked = ~doubtful
    follow = -torch.linalg.solve(curvature[doubtful][:, doubtful], curvature[doubtful][:, asked])
    own = torch.linalg.eigh(curvature[asked][:, asked] + curvature[asked][:, doubtful] @ follow)[1].T[:AXES]
    directions = own.new_zeros(len(own), len(doubtful))
    directions[:, asked], directions[:, doubtful] = own, own @ follow.T
    return directions
