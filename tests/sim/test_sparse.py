"""The sparse factors against a dense solver, patterns that grow, and matrices that are refused."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.mesh import grid_cloth
from diffcloud.sim.compiled.sparse import add_assemble, cholesky, hold, pattern, reordered, slots, solve, widened

SHAPES = pytest.mark.parametrize("shape", [(2, 2), (3, 7), (6, 6), (4, 15)])


def dense_of(of, matrix) -> np.ndarray:
    """[3 V, 3 V] of the stored half, in the nodes' own order."""
    count = len(of.place)
    node = np.argsort(of.place)
    found = np.zeros((count, 3, count, 3))
    for column in range(count):
        for p in range(of.starts[column], of.starts[column + 1]):
            i, j, block = node[of.rows[p]], node[column], matrix[p].reshape(3, 3)
            found[j, :, i] = block.T
            found[i, :, j] = block
    return found.reshape(3 * count, -1)


def random_system(mesh, rng):
    """(pattern, matrix [A + 1, 9], dense matrix) of random positive elements, assembled both ways."""
    groups = [np.arange(len(mesh.nodes))[:, None], mesh.faces, mesh.hinges.nodes]
    of = pattern(len(mesh.nodes), groups)
    matrix = np.zeros((len(of.rows) + 1, 9))
    dense = np.zeros((3 * len(mesh.nodes),) * 2)
    for nodes in groups:
        size = 3 * nodes.shape[1]
        root = rng.normal(size=(len(nodes), size, size))
        values = root @ root.transpose(0, 2, 1)
        first, second = np.triu_indices(nodes.shape[1])
        blocks = np.stack(
            [values[:, 3 * a : 3 * a + 3, 3 * b : 3 * b + 3].reshape(-1, 9) for a, b in zip(first, second, strict=True)], 1
        )
        add_assemble(slots(of, nodes), blocks, matrix)
        for element, members in enumerate(nodes):  # the slow obvious assembly
            index = (3 * members[:, None] + np.arange(3)).ravel()
            dense[np.ix_(index, index)] += values[element]
    return of, matrix, dense


def solved(of, matrix, right):
    factor = np.empty((len(of.factor_rows), 9))
    assert cholesky(of, matrix, factor)
    found = np.empty_like(right)
    solve(of, factor, right, found)
    return found


@SHAPES
def test_solves_what_a_dense_solver_solves(shape, rng):
    mesh = grid_cloth(*shape, 1.0, 1.0)
    of, matrix, dense = random_system(mesh, rng)
    np.testing.assert_allclose(dense_of(of, matrix), dense, rtol=0, atol=1e-12 * np.abs(dense).max())
    right = rng.normal(size=(len(mesh.nodes), 3))
    expected = np.linalg.solve(dense, right.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(solved(of, matrix, right), expected, rtol=1e-9, atol=1e-11)


@SHAPES
def test_a_wider_pattern_keeps_what_was_there_and_takes_more(shape, rng):
    mesh = grid_cloth(*shape, 1.0, 1.0)
    of, matrix, dense = random_system(mesh, rng)
    first, second = rng.integers(0, len(mesh.nodes), (2, 9))
    first, second = first[first != second], second[first != second]
    wide, moved = widened(of, first, second, of.place)
    larger = np.zeros((len(wide.rows) + 1, 9))
    larger[moved] = matrix[:-1]
    np.testing.assert_array_equal(dense_of(wide, larger), dense_of(of, matrix))
    pairs = np.column_stack([first, second])
    blocks = np.zeros((len(pairs), 3, 9))
    blocks[:, 0] = blocks[:, 2] = np.eye(3).ravel()
    blocks[:, 1] = -np.eye(3).ravel()
    add_assemble(slots(wide, pairs), blocks, larger)
    for a, b in pairs:
        for axis in range(3):
            i, j = 3 * a + axis, 3 * b + axis
            dense[i, i] += 1
            dense[j, j] += 1
            dense[i, j] -= 1
            dense[j, i] -= 1
    right = rng.normal(size=(len(mesh.nodes), 3))
    expected = np.linalg.solve(dense, right.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(solved(wide, larger, right), expected, rtol=1e-9, atol=1e-11)


@SHAPES
def test_a_wider_pattern_may_be_eliminated_in_another_order(shape, rng):
    """Blocks that are then above the diagonal are transposed, and the solution is the same."""
    mesh = grid_cloth(*shape, 1.0, 1.0)
    of, matrix, dense = random_system(mesh, rng)
    nodes = len(mesh.nodes)
    plain, _ = widened(of, np.arange(nodes - 1), np.full(nodes - 1, nodes - 1), of.place)
    wide, moved = widened(of, np.arange(nodes - 1), np.full(nodes - 1, nodes - 1), reordered(plain))
    assert (moved < 0).any() or nodes == 4
    larger = np.zeros((len(wide.rows) + 1, 9))
    for old, new in enumerate(moved):
        larger[max(new, ~new)] = matrix[old] if new >= 0 else matrix[old].reshape(3, 3).T.ravel()
    np.testing.assert_array_equal(dense_of(wide, larger), dense_of(of, matrix))
    right = rng.normal(size=(nodes, 3))
    expected = np.linalg.solve(dense, right.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(solved(wide, larger, right), expected, rtol=1e-9, atol=1e-11)


def test_two_layers_that_touch_are_eliminated_with_little_fill():
    """In the order of layers that are apart, the factor of coupled ones is longer by a third and more."""
    one = grid_cloth(20, 20, 1.0, 1.0)
    groups = [one.hinges.nodes, one.hinges.nodes + len(one.nodes)]
    apart = pattern(2 * len(one.nodes), groups)
    first = np.arange(len(one.nodes))
    second = len(one.nodes) + first.reshape(20, 20)[:, ::-1].ravel()  # lies the other way round on the first one
    kept, _ = widened(apart, first, second, apart.place)
    found, _ = widened(apart, first, second, reordered(kept))
    known = pattern(2 * len(one.nodes), [*groups, np.column_stack([first, second])])  # another library's order
    assert len(found.factor_rows) < 1.25 * len(known.factor_rows)
    assert len(kept.factor_rows) > 1.3 * len(found.factor_rows)


@pytest.mark.parametrize("count", [1, 2, 17])
def test_a_chain_is_eliminated_without_fill(count):
    """From its ends, whatever the numbers of its nodes."""
    order = np.random.default_rng(count).permutation(count)
    chain = pattern(count, [np.column_stack([order[:-1], order[1:]])])
    place = reordered(chain)
    assert sorted(place) == list(range(count))
    found, _ = widened(chain, np.empty(0, np.int64), np.empty(0, np.int64), place)
    assert len(found.factor_rows) == 2 * count - 1


def test_held_nodes_couple_with_nothing(rng):
    mesh = grid_cloth(4, 5, 1.0, 1.0)
    of, matrix, dense = random_system(mesh, rng)
    holder, mass = np.full(len(mesh.nodes), -1), rng.uniform(0.5, 1.5, len(mesh.nodes))
    holder[[0, 7, 19]] = [2, 0, 1]
    hold(of, holder, mass, matrix)
    held = np.repeat(holder >= 0, 3)
    dense[held] = dense[:, held] = 0.0
    dense[held, held] = np.repeat(mass, 3)[held]
    np.testing.assert_allclose(dense_of(of, matrix), dense, rtol=0, atol=1e-12 * np.abs(dense).max())


def test_an_indefinite_matrix_is_refused(rng):
    mesh = grid_cloth(4, 4, 1.0, 1.0)
    of, matrix, _ = random_system(mesh, rng)
    matrix[of.starts[of.place[5]], 4] = -1e3
    assert not cholesky(of, matrix, np.empty((len(of.factor_rows), 9)))


def test_the_order_keeps_factors_small():
    """From row to row the factor of a square cloth has two rows of blocks for each node."""
    for side in (16, 32, 64):
        mesh = grid_cloth(side, side, 1.0, 1.0)
        of = pattern(len(mesh.nodes), [mesh.faces, mesh.hinges.nodes])
        assert len(of.factor_rows) < 0.6 * 2 * side * len(mesh.nodes)
