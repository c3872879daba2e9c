"""Both factorisations against a dense reference, and matrices that are refused."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from diffcloud.mesh import grid_cloth
from diffcloud.sim.linear_solve import BlockTridiagonalPattern, Couplings, DensePattern, NotPositiveDefiniteError

CPU = torch.device("cpu")


def random_system(mesh, batch, rng):
    groups = [mesh.faces, mesh.hinges.nodes]
    blocks = []
    for nodes in groups:
        root = rng.normal(size=(batch, len(nodes), 3 * nodes.shape[1], 4))
        blocks.append(torch.as_tensor(root @ root.transpose(0, 1, 3, 2)))
    root = rng.normal(size=(batch, len(mesh.nodes), 3, 3))
    diagonal = torch.as_tensor(root @ root.transpose(0, 1, 3, 2) + np.eye(3))
    dense = torch.zeros(batch, 3 * len(mesh.nodes), 3 * len(mesh.nodes), dtype=torch.float64)
    for nodes, values in [(np.arange(len(mesh.nodes))[:, None], diagonal), *zip(groups, blocks, strict=True)]:
        for element, members in enumerate(nodes):  # the slow obvious assembly
            index = (3 * members[:, None] + np.arange(3)).ravel()
            dense[:, index[:, None], index] += values[:, element]
    return groups, diagonal, blocks, dense


@pytest.mark.parametrize("pattern", [DensePattern, BlockTridiagonalPattern])
@pytest.mark.parametrize("shape", [(2, 2), (3, 7), (6, 6), (4, 15)])
def test_solves_what_a_dense_solver_solves(pattern, shape, rng):
    mesh = grid_cloth(*shape, 1.0, 1.0)
    groups, diagonal, blocks, dense = random_system(mesh, 3, rng)
    factor = pattern.build(len(mesh.nodes), groups, CPU).factorise(diagonal, blocks)
    right = torch.as_tensor(rng.normal(size=(3, len(mesh.nodes), 3)))
    expected = torch.linalg.solve(dense, right.flatten(1)).view_as(right)
    torch.testing.assert_close(factor.solve(right), expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("pattern", [DensePattern, BlockTridiagonalPattern])
def test_copies_of_the_batch_share_the_factor(pattern, rng):
    mesh = grid_cloth(5, 4, 1.0, 1.0)
    groups, diagonal, blocks, _ = random_system(mesh, 2, rng)
    factor = pattern.build(len(mesh.nodes), groups, CPU).factorise(diagonal, blocks)
    right = torch.as_tensor(rng.normal(size=(6, len(mesh.nodes), 3)))
    parts = [factor.solve(right[2 * copy : 2 * copy + 2]) for copy in range(3)]
    torch.testing.assert_close(factor.solve(right), torch.cat(parts))


@pytest.mark.parametrize("pattern", [DensePattern, BlockTridiagonalPattern])
def test_an_indefinite_matrix_names_its_batch_entry(pattern, rng):
    mesh = grid_cloth(4, 4, 1.0, 1.0)
    groups, diagonal, blocks, _ = random_system(mesh, 3, rng)
    diagonal[1] -= 1e3 * torch.eye(3, dtype=torch.float64)
    with pytest.raises(NotPositiveDefiniteError) as caught:
        pattern.build(len(mesh.nodes), groups, CPU).factorise(diagonal, blocks)
    assert caught.value.entries == [1]


@pytest.mark.parametrize("pattern", [DensePattern, BlockTridiagonalPattern])
@pytest.mark.parametrize("reach", [1, 40])
def test_couplings_between_any_nodes(pattern, reach, rng):
    """Near ones fall into the pattern's blocks; far ones break its band."""
    mesh = grid_cloth(4, 15, 1.0, 1.0)
    groups, diagonal, blocks, dense = random_system(mesh, 3, rng)
    first = rng.integers(0, len(mesh.nodes) - reach, 10)
    entries, rows, columns, values = [], [], [], []
    for node, entry in zip(first, rng.integers(0, 2, 10), strict=True):  # the last entry has none
        direction = rng.normal(size=6)
        both = (node, node + reach)
        for (i, a), (j, b) in ((p, q) for p in enumerate(both) for q in enumerate(both)):
            block = torch.as_tensor(np.outer(direction[3 * i : 3 * i + 3], direction[3 * j : 3 * j + 3]))
            dense[entry, 3 * a : 3 * a + 3, 3 * b : 3 * b + 3] += block
            entries.append(int(entry))
            rows.append(int(a))
            columns.append(int(b))
            values.append(block)
    couplings = Couplings(torch.tensor(entries), torch.tensor(rows), torch.tensor(columns), torch.stack(values))
    factor = pattern.build(len(mesh.nodes), groups, CPU).factorise(diagonal, blocks, couplings)
    right = torch.as_tensor(rng.normal(size=(6, len(mesh.nodes), 3)))
    expected = torch.linalg.solve(dense.repeat(2, 1, 1), right.flatten(1)).view_as(right)
    torch.testing.assert_close(factor.solve(right), expected, rtol=1e-9, atol=1e-11)


def test_a_far_coupling_that_makes_the_matrix_indefinite(rng):
    mesh = grid_cloth(4, 15, 1.0, 1.0)
    groups, diagonal, blocks, _ = random_system(mesh, 2, rng)
    nodes = torch.tensor([0, 59])
    block = 1e4 * torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    couplings = Couplings(torch.tensor([1, 1]), nodes, nodes.flip(0), block)
    with pytest.raises(NotPositiveDefiniteError) as caught:
        BlockTridiagonalPattern.build(60, groups, CPU).factorise(diagonal, blocks, couplings)
    assert caught.value.entries == [1]
