"""Exact Jacobians of functions that act on each element alone, by forward-mode differentiation."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor


def element_jacobian(function: Callable[[Tensor, int], Tensor], at: Tensor, size: int) -> Tensor:
    """d function / d at, where every group of `size` trailing numbers is an element of its own.

    All directions are carried as copies in one evaluation.

    Args:
        function: (values [K · B, ..., size], K) -> [K · B, ..., size]; K counts copies, outermost.
        at: [B, ..., size].

    Returns:
        [B, ..., size, size]: row, column.
    """
    directions = torch.eye(size, dtype=at.dtype, device=at.device)
    tangent = directions.view(size, *[1] * (at.dim() - 1), size).expand(size, *at.shape)
    # torch has one level of forward mode; inside a rollout that already carries tangents it is shared
    level = nullcontext() if forward_ad._current_level >= 0 else forward_ad.dual_level()
    # inside a custom autograd function torch switches forward mode off
    with torch.no_grad(), level, forward_ad._set_fwd_grad_enabled(True):
        repeated = at.expand(size, *at.shape)
        dual = forward_ad.make_dual(repeated.flatten(0, 1).contiguous(), tangent.flatten(0, 1).contiguous())
        out = forward_ad.unpack_dual(function(dual, size)).tangent
        assert out is not None, "the function does not depend on its argument"
        return out.unflatten(0, (size, len(at))).movedim(0, -1)
