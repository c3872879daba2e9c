"""Terms of Φ for one recording, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffcloud.estimation.matching import Pairs

TINY = 1e-12


@dataclass(frozen=True)
class Frames:
    """Terms of Φ for one recording with L frames, two directions, k motion variables and d pose variables."""

    squares: Tensor
    """[2, L] mean squared distances."""
    slopes: Tensor
    """[2, L, k + d] half their gradients."""
    curvatures: Tensor
    """[2, L, k + d, k + d] half their Gauss–Newton matrices."""
    shifted: Tensor
    """[2, L, k + d] change of half the gradients if the nodes move by the given shifts."""
    variances: Tensor
    """[2, L] known variances."""

    @property
    def chi_squares(self) -> Tensor:
        """[L] mean squared distance divided by the known variance, c, averaged over both directions."""
        return (self.squares / self.variances).mean(0)

    @property
    def weights(self) -> Tensor:
        """[2, L] derivative of Φ with respect to the mean squared distances, for one independent residual."""
        return 0.5 / (self.variances * self.chi_squares.clamp(min=1.0))

    def energy(self) -> float:
        """Return Φ for one independent residual per frame, up to a constant."""
        c = self.chi_squares
        return float((self.variances.log().mean(0) + torch.where(c < 1, c, 1 + c.clamp(min=1e-9).log())).sum())


def one_way(
    pairs: Pairs, away: Tensor, normals: Tensor, moves: Tensor, moved: Tensor | None, cap: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the terms of `Frames` for one direction. `estimation.matching` explains the curvature.

    Args:
        away: [1, L, N, 3] displacements from recorded to simulated points.
        normals: [1, L, N, 3] surface normals.
        moves: [K, 1, L, N, 3] derivatives of the simulated points with respect to the variables.
        moved: [1, L, N, 3] shifts of the simulated points whose effect on the gradients is needed.
    """
    across = (away * normals).sum(-1, keepdim=True) * normals
    along = away - across
    along = along / (along.square().sum(-1, keepdim=True) + pairs.spacing[:, None, None].square()).sqrt().clamp(min=TINY)
    counts = (pairs.weights / pairs.weights.sum(-1, keepdim=True).clamp(min=TINY))[0]
    squares = away.square().sum(-1)[0]
    near = torch.where(squares < cap**2, counts, 0.0)
    mean = torch.where(counts.sum(-1) > 0, (counts * squares.clamp(max=cap**2)).sum(-1), cap**2)
    slope = torch.einsum("kln,ln->lk", (moves * away).sum(-1)[:, 0], near)
    matrix, shifted = torch.zeros_like(slope)[..., None] * slope[:, None], torch.zeros_like(slope)
    for direction in (normals, along):
        part = (moves * direction).sum(-1)[:, 0]
        matrix = matrix + torch.einsum("aln,bln,ln->lab", part, part, near)
        if moved is not None:
            shifted = shifted + torch.einsum("kln,ln,ln->lk", part, (moved * direction).sum(-1)[0], near)
    return mean, slope, matrix, shifted


def squared(shift: Tensor) -> Tensor:
    """Return the mean squared node displacement [L] of displacements [1, L, N, 3]."""
    return shift[0].square().sum(-1).mean(-1)
