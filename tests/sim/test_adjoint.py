"""The implicit function theorem on equations that have nothing to do with cloth."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from torch.autograd import forward_ad

from diffcloud.sim.adjoint import implicit_solve


@dataclass
class Factor:
    matrix: torch.Tensor

    def solve(self, right, *, transposed=False):
        copies = len(right) // len(self.matrix)
        matrix = self.matrix.mT if transposed else self.matrix
        return torch.linalg.solve(matrix.repeat(copies, 1, 1), right)


class Linear:
    """A(p) u = b with A symmetric."""

    def matrix(self, p):
        root = torch.diag_embed(p) + 0.1 * p[:, :, None] * p[:, None, :]
        return root + 2 * torch.eye(p.shape[1], dtype=p.dtype)

    def solve(self, p, b):
        factor = Factor(self.matrix(p))
        return factor.solve(b), factor

    def residual(self, u, p, b):
        return (self.matrix(p) @ u[..., None]).squeeze(-1) - b


class Cubic:
    """u³ + p u + (mixing) = b by Newton; the Jacobian has no symmetry."""

    def residual(self, u, p, b):
        return u**3 + p * u + 0.3 * u.roll(1, -1) * u - b

    def jacobian(self, u, p):
        rolled = torch.roll(torch.eye(u.shape[1], dtype=u.dtype), 1, 0)
        return torch.diag_embed(3 * u**2 + p + 0.3 * u.roll(1, -1)) + 0.3 * u[:, :, None] * rolled

    def solve(self, p, b):
        u = torch.zeros_like(b)
        for _ in range(50):
            u = u - Factor(self.jacobian(u, p)).solve(self.residual(u, p, b))
        return u, Factor(self.jacobian(u, p))


@pytest.fixture(params=[Linear(), Cubic()], ids=lambda p: type(p).__name__)
def problem(request):
    return request.param


@pytest.fixture
def inputs(rng):
    return torch.as_tensor(1 + rng.random((2, 4))), torch.as_tensor(0.5 + rng.random((2, 4)))


def test_reverse_mode_passes_gradcheck(problem, inputs):
    p, b = (value.clone().requires_grad_(True) for value in inputs)
    assert torch.autograd.gradcheck(lambda *x: implicit_solve(problem, *x), (p, b), eps=1e-6, atol=1e-8)


def test_forward_mode_is_the_transpose_of_reverse_mode(problem, inputs, rng):
    directions = [torch.as_tensor(rng.normal(size=(3, 2, 4))) for _ in inputs]
    with forward_ad.dual_level():
        duals = [forward_ad.make_dual(v.repeat(3, 1), d.flatten(0, 1)) for v, d in zip(inputs, directions, strict=True)]
        tangent = forward_ad.unpack_dual(implicit_solve(problem, *duals, copies=3)).tangent.unflatten(0, (3, 2))
    weights = torch.as_tensor(rng.normal(size=(2, 4)))
    tracked = [value.clone().requires_grad_(True) for value in inputs]
    gradients = torch.autograd.grad((implicit_solve(problem, *tracked) * weights).sum(), tracked)
    for copy in range(3):
        expected = sum((g * d[copy]).sum() for g, d in zip(gradients, directions, strict=True))
        torch.testing.assert_close((tangent[copy] * weights).sum(), expected, rtol=1e-10, atol=1e-12)


def test_only_what_needs_a_gradient_gets_one(problem, inputs):
    p, b = inputs
    b = b.clone().requires_grad_(True)
    implicit_solve(problem, p, b).sum().backward()
    assert p.grad is None
    assert b.grad is not None
