"""Derivatives of an implicitly defined quantity, by the implicit function theorem. This module knows no cloth.

A problem gives u with r(u, p) = 0 in two parts: `solve`, however it likes, and `residual`. Derivatives see only the
residual, so they cannot depend on how the solve was done:

    reverse:  Jᵀ y = ∂L/∂u,   ∂L/∂p = -(∂r/∂p)ᵀ y          (one vector-Jacobian product of r)
    forward:  J u̇ = -(∂r/∂p) ṗ                             (one Jacobian-vector product of r)

with J = ∂r/∂u at the solution, which `solve` returns in factorised form.

Reverse mode is ordinary autograd. Forward mode is torch's forward AD: give inputs tangents inside a
`torch.autograd.forward_ad.dual_level`. Several tangents ride along as copies of the batch, [K · B, ...] with copies
outermost; the primal solve is done once for the first B and its factor is shared.
"""

from __future__ import annotations

from typing import Any, Protocol

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor


class Factor(Protocol):
    """J, factorised."""

    def solve(self, right: Tensor, *, transposed: bool = False) -> Tensor:
        """[K · B, ...] -> [K · B, ...], with the matrix or its transpose."""
        ...


class ImplicitProblem(Protocol):
    """An equation r(u, *inputs) = 0 for u."""

    def solve(self, *inputs: Tensor) -> tuple[Tensor, Factor]:
        """u and the factor of J there; called without gradients."""
        ...

    def residual(self, u: Tensor, *inputs: Tensor) -> Tensor:
        """r, of u's shape, differentiable in everything."""
        ...


def implicit_solve(problem: ImplicitProblem, *inputs: Tensor, copies: int = 1) -> Tensor:
    """u with r(u, *inputs) = 0, differentiable in reverse and in forward mode.

    Args:
        copies: K, when the inputs' batch holds K copies of the same values that differ in their tangents.
    """
    # duals exist only inside a level; asking for its number avoids unpacking every input of an ordinary step
    if forward_ad._current_level >= 0:
        return _with_tangent(problem, inputs, copies)
    return _Implicit.apply(problem, *inputs)


class _Implicit(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, problem: ImplicitProblem, *inputs: Tensor) -> Tensor:
        u, factor = problem.solve(*inputs)
        ctx.problem, ctx.factor = problem, factor
        ctx.save_for_backward(u, *inputs)
        return u

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = gradients
        u, *inputs = ctx.saved_tensors
        problem, wanted = ctx.problem, ctx.needs_input_grad[1:]
        inputs = [i.detach().requires_grad_(want) for i, want in zip(inputs, wanted, strict=True)]
        chosen = [i for i, want in zip(inputs, wanted, strict=True) if want]
        with torch.enable_grad():
            residual = problem.residual(u, *inputs)
            adjoint = ctx.factor.solve(gradient, transposed=True)
            # of a number: checking the shape of given output gradients makes torch import sympy, a second or more
            found = iter(torch.autograd.grad(-(residual * adjoint).sum(), chosen, allow_unused=True))
        return (None, *(next(found) if want else None for want in wanted))


def _with_tangent(problem: ImplicitProblem, inputs: tuple[Tensor, ...], copies: int) -> Tensor:
    primals = [forward_ad.unpack_dual(i).primal for i in inputs]
    batch = len(primals[0]) // copies
    with torch.no_grad():
        u, factor = problem.solve(*(primal[:batch] for primal in primals))
        u = u.repeat(copies, *[1] * (u.dim() - 1))
        change = forward_ad.unpack_dual(problem.residual(u, *inputs)).tangent
        if change is None:
            return u
        tangent = -factor.solve(change)
        return forward_ad.make_dual(u, tangent.contiguous())
