"""Derivatives of an implicitly defined quantity, by the implicit function theorem. This module knows no cloth.

A problem gives u with r(u, p) = 0 in two parts: `solve`, however it likes, and `residual`. Derivatives see only the
residual, so they cannot depend on how the solve was done:

    reverse:  Jᵀ y = ∂L/∂u,   ∂L/∂p = -(∂r/∂p)ᵀ y          (one vector-Jacobian product of r)
    forward:  J u̇ = -(∂r/∂p) ṗ                             (one Jacobian-vector product of r)

with J = ∂r/∂u. Where the factor returned by `solve` is J exactly (a linearly implicit step), one back-substitution does.
Where it only approximates J (a converged Newton step with a Gauss-Newton matrix), it preconditions GMRES on the exact J.

Reverse mode is ordinary autograd. Forward mode is torch's forward AD: give inputs tangents inside a
`torch.autograd.forward_ad.dual_level`. Several tangents ride along as copies of the batch, [K · B, ...] with copies
outermost; the primal solve is done once for the first B and its factor is shared.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

_TOLERANCE = 1e-13
_ITERATIONS = 60


class Factor(Protocol):
    """A factorised symmetric matrix: J, or an approximation of it."""

    def solve(self, right: Tensor, *, transposed: bool = False) -> Tensor:
        """[K · B, ...] -> [K · B, ...], with the matrix or its transpose."""
        ...


class ImplicitProblem(Protocol):
    """An equation r(u, *inputs) = 0 for u."""

    @property
    def exact(self) -> bool:
        """Whether the factor is ∂r/∂u (and symmetric), not an approximation."""
        ...

    def solve(self, *inputs: Tensor) -> tuple[Tensor, Factor | None]:
        """u and a factor, if the solve made one that derivatives can use; called without gradients."""
        ...

    def factorise(self, u: Tensor, *inputs: Tensor) -> Factor:
        """The factor at a solution, where `solve` gave none."""
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
            unknown = u.detach().requires_grad_(not problem.exact)
            residual = problem.residual(unknown, *inputs)
            factor = ctx.factor if ctx.factor is not None else problem.factorise(u, *(i.detach() for i in inputs))
            adjoint = factor.solve(gradient, transposed=True)
            if not problem.exact:

                def transposed(vector: Tensor) -> Tensor:
                    (product,) = torch.autograd.grad(residual, unknown, vector, retain_graph=True)
                    return product

                adjoint = gmres(transposed, factor.solve, gradient, adjoint)
            found = iter(torch.autograd.grad(residual, chosen, -adjoint, allow_unused=True))
        return (None, *(next(found) if want else None for want in wanted))


def _with_tangent(problem: ImplicitProblem, inputs: tuple[Tensor, ...], copies: int) -> Tensor:
    primals = [forward_ad.unpack_dual(i).primal for i in inputs]
    batch = len(primals[0]) // copies
    with torch.no_grad():
        first = [primal[:batch] for primal in primals]
        u, factor = problem.solve(*first)
        if factor is None:
            factor = problem.factorise(u, *first)
        u = u.repeat(copies, *[1] * (u.dim() - 1))
        change = forward_ad.unpack_dual(problem.residual(u, *inputs)).tangent
        if change is None:
            return u
        tangent = -factor.solve(change)
        if not problem.exact:

            def product(vector: Tensor) -> Tensor:
                out = problem.residual(forward_ad.make_dual(u, vector.contiguous()), *primals)
                return forward_ad.unpack_dual(out).tangent

            tangent = gmres(product, factor.solve, -change, tangent)
        return forward_ad.make_dual(u, tangent.contiguous())


def gmres(
    matrix: Callable[[Tensor], Tensor], precondition: Callable[[Tensor], Tensor], right: Tensor, start: Tensor
) -> Tensor:
    """Solve J x = right for each batch entry by GMRES, preconditioned from the right.

    Args:
        matrix, precondition: products with J and with an approximation of J⁻¹, [B, ...] -> [B, ...].
        right, start: [B, ...] right-hand side and initial guess.

    Returns:
        x, to a relative residual of 1e-13 or the last of 60 directions.
    """
    shape = right.shape
    batch = shape[0]

    def dot(a: Tensor, b: Tensor) -> Tensor:  # [B]
        return (a * b).reshape(batch, -1).sum(-1)

    def over(scale: Tensor, vector: Tensor) -> Tensor:
        return scale.view(batch, *[1] * (vector.dim() - 1)) * vector

    residual = right - matrix(start)
    norm = dot(residual, residual).sqrt()
    goal = _TOLERANCE * dot(right, right).sqrt()
    if bool((norm <= goal).all()):
        return start
    basis = [over(1 / norm.clamp(min=1e-300), residual)]
    directions: list[Tensor] = []
    hessenberg = right.new_zeros(batch, _ITERATIONS + 1, _ITERATIONS)
    target = right.new_zeros(batch, _ITERATIONS + 1, 1)
    target[:, 0, 0] = norm
    for column in range(_ITERATIONS):
        directions.append(precondition(basis[-1]))
        vector = matrix(directions[-1])
        for _ in range(2):  # Gram-Schmidt twice keeps the basis orthogonal
            for row, other in enumerate(basis):
                overlap = dot(vector, other)
                hessenberg[:, row, column] += overlap
                vector = vector - over(overlap, other)
        length = dot(vector, vector).sqrt()
        hessenberg[:, column + 1, column] = length
        basis.append(over(1 / length.clamp(min=1e-300), vector))
        small, goal_vector = hessenberg[:, : column + 2, : column + 1], target[:, : column + 2]
        weights = torch.linalg.pinv(small) @ goal_vector
        left = (goal_vector - small @ weights).flatten(1).norm(dim=1)
        if bool((left <= goal).all()):
            break
    return start + sum(over(weights[:, i, 0], direction) for i, direction in enumerate(directions))
