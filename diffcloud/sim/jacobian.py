"""Exact Jacobians of functions that act on each element alone."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def element_jacobian(function: Callable[[Tensor, int], Tensor], at: Tensor, size: int) -> Tensor:
    """d function / d at, where every group of `size` trailing numbers is an element of its own.

    All rows are carried as copies through one reverse pass. (Forward mode would do as well, but torch 2.13 takes a
    Python path, a hundred times slower, for every operation that mixes a dual number with a plain one.)

    Args:
        function: (values [K · B, ..., size], K) -> [K · B, ..., size]; K counts copies, outermost.
        at: [B, ..., size].

    Returns:
        [B, ..., size, size]: row, column.
    """
    rows = torch.eye(size, dtype=at.dtype, device=at.device).view(size, *[1] * (at.dim() - 1), size)
    with torch.enable_grad():
        copies = at.detach().repeat(size, *[1] * (at.dim() - 1)).requires_grad_()
        out = function(copies, size)
        (gradient,) = torch.autograd.grad(out, copies, rows.expand(size, *at.shape).reshape(out.shape))
    return gradient.unflatten(0, (size, len(at))).movedim(0, -2)
