"""The search tree against brute force, bit by bit, over clouds of all kinds."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from diffcloud.clouds import NeighbourIndex, chamfer, one_sided_chamfer
from diffcloud.clouds.curve import curve_order
from diffcloud.clouds.neighbours import flattest_directions
from diffcloud.mesh import grid_cloth

SIZES = [1, 2, 7, 8, 9, 127, 128, 129, 700, 2200]  # around full leaves, groups, and levels


def brute_force(queries, targets):
    """[Q, 3], [P, 3] -> [Q] the lowest number of the nearest."""
    with np.errstate(over="ignore"):
        squares = (queries[:, None] - targets) ** 2
        return (squares[..., 0] + squares[..., 1] + squares[..., 2]).argmin(1)


def surface(rng, count):
    """Points of a wrinkled sheet, in no order."""
    u, v = rng.random((2, count))
    return np.stack([u, v, 0.05 * np.sin(9 * u + 4 * v)], axis=1)


CLOUDS = {
    "random": lambda rng, count: rng.normal(size=(count, 3)),
    "surface": surface,
    "clustered": lambda rng, count: rng.integers(0, 3, (count, 1)) + 1e-4 * rng.normal(size=(count, 3)),
    "planar": lambda rng, count: rng.random((count, 3)) * [1, 1, 0],
    "line": lambda rng, count: rng.random((count, 1)) * [1.0, 2.0, -1.0],
    "lattice": lambda rng, count: rng.integers(0, 5, (count, 3)).astype(float),  # many equal distances and points
    "one place": lambda rng, count: np.ones((count, 3)),
    "outlier": lambda rng, count: np.where(np.arange(count)[:, None] == 0, 1e9, rng.random((count, 3))),
    "huge": lambda rng, count: 1e200 * rng.normal(size=(count, 3)),  # squares overflow
    "tiny": lambda rng, count: 1e-310 * rng.random((count, 3)),
}


@pytest.mark.parametrize("kind", CLOUDS)
@pytest.mark.parametrize("size", SIZES)
def test_exactly_brute_force(rng, kind, size):
    target = CLOUDS[kind](rng, size)
    own = CLOUDS[kind](rng, 150)
    for queries in (own, own + np.array([0, 0, 0.3]), 100 * own, target[:50], target.mean(0, keepdims=True)):
        index, expected = NeighbourIndex(torch.as_tensor(target)), brute_force(queries, target)
        assert np.array_equal(index.nearest_index(torch.as_tensor(queries)).numpy(), expected)
        for guesses in (rng.integers(-1, size, len(queries)), expected):  # whatever is guessed, the answer is the same
            assert np.array_equal(index.nearest_index(torch.as_tensor(queries), torch.as_tensor(guesses)).numpy(), expected)


@pytest.mark.parametrize("kind", CLOUDS)
def test_clouds_of_different_kinds_and_of_each_other(rng, kind):
    first, second = CLOUDS[kind](rng, 333), surface(rng, 450)
    indices = NeighbourIndex(torch.as_tensor(first)), NeighbourIndex(torch.as_tensor(second))
    assert np.array_equal(indices[0].nearest_to(indices[1]).numpy(), first[brute_force(second, first)])
    assert np.array_equal(indices[1].nearest_to(indices[0]).numpy(), second[brute_force(first, second)])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_shapes_and_types(rng, dtype):
    target, queries = (torch.as_tensor(rng.normal(size=size), dtype=dtype) for size in ((300, 3), (4, 5, 6, 3)))
    index = NeighbourIndex(target)
    expected = brute_force(queries.double().view(-1, 3).numpy(), target.double().numpy())
    assert np.array_equal(index.nearest_index(queries).view(-1).numpy(), expected)
    assert index.nearest(queries).shape == queries.shape
    assert index.nearest(queries.double()).dtype == torch.float64
    assert index.nearest(queries[:0]).shape == (0, 5, 6, 3)
    strided = queries.transpose(0, 2)
    assert torch.equal(index.nearest_index(strided), index.nearest_index(queries).transpose(0, 2))


def test_what_is_not_finite_has_no_neighbour_and_disturbs_no_other(rng):
    target, queries = surface(rng, 400), surface(rng, 100)
    expected = brute_force(queries, target)
    for row, value in ((3, np.nan), (50, np.inf), (99, -np.inf)):
        queries[row, row % 3] = value
        expected[row] = 0
    index = NeighbourIndex(torch.as_tensor(target))
    assert np.array_equal(index.nearest_index(torch.as_tensor(queries)).numpy(), expected)
    assert np.array_equal(index.nearest_index(torch.full((20, 3), torch.nan)).numpy(), np.zeros(20))
    assert not torch.isfinite(one_sided_chamfer(torch.as_tensor(queries), index))


def test_the_curve_goes_from_cell_to_cell():
    cells = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), axis=-1).reshape(-1, 3)
    order = curve_order(cells)
    assert np.array_equal(np.sort(order), np.arange(512))
    assert (np.abs(np.diff(cells[order], axis=0)).sum(1) == 1).all()


def test_derivatives_of_both_sides(rng):
    source = torch.as_tensor(surface(rng, 40))[None].requires_grad_(True)
    target = torch.as_tensor(grid_cloth(4, 5, 1.0, 1.0).nodes + 0.03).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda s: one_sided_chamfer(s, NeighbourIndex(target.detach())), (source,))
    assert torch.autograd.gradcheck(lambda s, t: chamfer(s, [NeighbourIndex(t)]), (source, target))


@pytest.mark.parametrize(
    "shape", [(1.0, 1.0, 1.0), (1.0, 1.0, 0.01), (1.0, 0.05, 0.04), (1.0, 0.01, 0.01), (1.0, 0.0, 0.0)]
)
def test_flattest_directions_are_those_of_an_eigenvalue_solver(shape):
    rng = np.random.default_rng(3)
    points = (rng.standard_normal((400, 3)) * shape) @ np.linalg.qr(rng.standard_normal((3, 3)))[0] + [5.0, -2.0, 1.0]
    groups = rng.integers(0, 400, (200, 13))
    found = flattest_directions(points, groups)
    around = points[groups] - points[groups].mean(axis=1, keepdims=True)
    spread = np.swapaxes(around, 1, 2) @ around
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-12)
    along = np.einsum("gi,gij,gj->g", found, spread, found)
    scale = np.trace(spread, axis1=1, axis2=2)
    np.testing.assert_allclose(along / scale, np.linalg.eigvalsh(spread)[:, 0] / scale, atol=1e-10)


def test_points_in_one_place_have_some_direction():
    found = flattest_directions(np.ones((5, 3)), np.array([[0, 1, 2, 3]]))
    assert np.linalg.norm(found) == pytest.approx(1.0)
