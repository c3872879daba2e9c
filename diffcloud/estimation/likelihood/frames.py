"""What one recording says at one place, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffcloud.estimation.matching import Pairs

TINY = 1e-12


@dataclass(frozen=True)
class Frames:
    """What one recording says at one place: L frames, forth and back, k variables of the motion and d of the pose."""

    squares: Tensor
    """[2, L] mean squared distances."""
    slopes: Tensor
    """[2, L, k + d] half of their slopes."""
    curvatures: Tensor
    """[2, L, k + d, k + d] half of their Gauss–Newton matrices."""
    shifted: Tensor
    """[2, L, k + d] by which half of the slopes change if the nodes move by the requested shifts."""
    variances: Tensor
    """[2, L] that are known."""

    @property
    def chi_squares(self) -> Tensor:
        """[L] mean squares over known variances, c."""
        return (self.squares / self.variances).mean(0)

    @property
    def weights(self) -> Tensor:
        """[2, L] slope of Φ by the mean squares, for one independent residual."""
        return 0.5 / (self.variances * self.chi_squares.clamp(min=1.0))

    def energy(self) -> float:
        """Φ for one independent residual a frame, but for a constant."""
        c = self.chi_squares
        return float((self.variances.log().mean(0) + torch.where(c < 1, c, 1 + c.clamp(min=1e-9).log())).sum())


def one_way(
    pairs: Pairs, away: Tensor, normals: Tensor, moves: Tensor, moved: Tensor | None, cap: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """One way's parts of `Frames`, the curvature as `estimation.matching` has it.

    Args:
        away: [1, L, N, 3] from the recorded points to the simulated ones; likewise the surfaces' normals.
        moves: [K, 1, L, N, 3] of the simulated points by the variables.
        moved: [1, L, N, 3] of them, whose effect on the slopes is wanted.
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
    """[L] mean over nodes of a displacement [1, L, N, 3]."""
    return shift[0].square().sum(-1).mean(-1)
