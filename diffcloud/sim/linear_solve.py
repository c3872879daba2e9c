"""Symmetric positive definite systems over the nodes of a mesh, batched: assemble, factorise, solve.

Small meshes use dense Cholesky. Larger ones use a block-tridiagonal Cholesky: nodes in reverse Cuthill-McKee order, cut
into blocks as long as the bandwidth, so that a block couples only to its neighbours. Both are plain batched torch on any
device; the index maps are built once per mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor

_DENSE_NODES = 200
"""Up to here dense factorisation is faster on a CPU (measured with `diffcloud bench`)."""


class NotPositiveDefiniteError(ArithmeticError):
    """A step matrix could not be factorised. `entries` lists the batch entries."""

    def __init__(self, entries: list[int]) -> None:
        self.entries = entries
        super().__init__(f"step matrix is not positive definite in batch entries {entries}")


class SingularMatrixError(ArithmeticError):
    """A Jacobian could not be factorised. `entries` lists the batch entries."""

    def __init__(self, entries: list[int]) -> None:
        self.entries = entries
        super().__init__(f"the step's Jacobian is singular in batch entries {entries}")


@dataclass(frozen=True)
class Couplings:
    """Blocks at places that the pattern need not have: Q pairs of nodes."""

    entry: Tensor
    """[Q] batch entry."""
    rows: Tensor
    """[Q] node"""
    columns: Tensor
    """[Q] node"""
    blocks: Tensor
    """[Q, 3, 3]; together symmetric where the pattern's matrices are."""


class Factor(Protocol):
    """A factorised matrix."""

    def solve(self, right: Tensor, *, transposed: bool = False) -> Tensor:
        """[K · B, V, 3] -> [K · B, V, 3] with the matrix or its transpose, for any whole K (copies outermost)."""
        ...


class MatrixPattern(Protocol):
    """Where the blocks of elements go."""

    def factorise(self, diagonal: Tensor, blocks: Sequence[Tensor], couplings: Couplings | None = None) -> Factor:
        """Assemble and factorise.

        Args:
            diagonal: [B, V, 3, 3].
            blocks: one [B, E, 3n, 3n] per element group of the pattern.
            couplings: added on top, between any nodes.

        Raises:
            NotPositiveDefiniteError: names the batch entries.
        """
        ...


def pattern(node_count: int, groups: Sequence[NDArray[np.int64]], device: torch.device) -> MatrixPattern:
    """The pattern of a mesh: node_count nodes, and for each element group its nodes [E, n]."""
    if node_count <= _DENSE_NODES:
        return DensePattern.build(node_count, groups, device)
    return BlockTridiagonalPattern.build(node_count, groups, device)


@dataclass(frozen=True)
class DensePattern:
    """All pairs of nodes."""

    node_count: int
    index: Tensor
    """Flat position in [3V · 3V] of each number of the diagonal and of the blocks."""

    @staticmethod
    def build(node_count: int, groups: Sequence[NDArray[np.int64]], device: torch.device) -> DensePattern:
        size = 3 * node_count
        rows, columns = _entries(node_count, groups)
        return DensePattern(node_count, torch.as_tensor(rows * size + columns, device=device))

    def factorise(self, diagonal: Tensor, blocks: Sequence[Tensor], couplings: Couplings | None = None) -> Factor:
        size = 3 * self.node_count
        values = torch.cat([diagonal.flatten(1), *(block.flatten(1) for block in blocks)], dim=1)
        index = self.index.expand(len(values), -1)
        matrix = values.new_zeros(len(values), size * size).scatter_add_(1, index, values)
        if couplings is not None:
            axis = torch.arange(3, device=index.device)
            rows = (couplings.entry * size + 3 * couplings.rows)[:, None, None] + axis[:, None]
            place = rows * size + 3 * couplings.columns[:, None, None] + axis
            matrix.view(-1).index_add_(0, place.flatten(), couplings.blocks.flatten())
        return DenseFactor(_cholesky(matrix.view(-1, size, size)))


@dataclass(frozen=True)
class DenseFactor:
    """Cholesky factor [B, 3V, 3V]."""

    lower: Tensor

    def solve(self, right: Tensor, *, transposed: bool = False) -> Tensor:
        columns = _copies_as_columns(right, len(self.lower))
        return _columns_as_copies(torch.cholesky_solve(columns, self.lower), right)


@dataclass(frozen=True)
class BlockTridiagonalPattern:
    """N blocks of `width` numbers each, the last padded with ones on its diagonal."""

    node_count: int
    block_count: int
    width: int
    order: Tensor
    """[V] node at each place."""
    place: Tensor
    """[V] place of each node."""
    index: Tensor
    """Flat position of each number of the diagonal and the blocks; numbers above the diagonal go to a spare place."""

    @staticmethod
    def build(node_count: int, groups: Sequence[NDArray[np.int64]], device: torch.device) -> BlockTridiagonalPattern:
        first = np.concatenate([np.repeat(nodes, nodes.shape[1], axis=1).ravel() for nodes in groups])
        second = np.concatenate([np.tile(nodes, nodes.shape[1]).ravel() for nodes in groups])
        graph = csr_matrix(coo_matrix((np.ones(len(first)), (first, second)), shape=(node_count, node_count)))
        order = reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int64)
        place = np.argsort(order)
        block_nodes = max(int(np.abs(place[first] - place[second]).max()), 1)
        block_count = -(-node_count // block_nodes)
        width = 3 * block_nodes
        rows, columns = _entries(node_count, groups, place)
        row_block, column_block = rows // width, columns // width
        below = row_block - column_block  # 0 on the diagonal blocks, 1 under them, -1 above: not stored
        flat = ((below * block_count + row_block - below) * width + rows % width) * width + columns % width
        spare = 2 * block_count * width * width
        return BlockTridiagonalPattern(
            node_count=node_count,
            block_count=block_count,
            width=width,
            order=torch.as_tensor(order.copy(), device=device),
            place=torch.as_tensor(place, device=device),
            index=torch.as_tensor(np.where(below < 0, spare, flat), device=device),
        )

    def factorise(self, diagonal: Tensor, blocks: Sequence[Tensor], couplings: Couplings | None = None) -> Factor:
        values = torch.cat([diagonal.flatten(1), *(block.flatten(1) for block in blocks)], dim=1)
        count, width = self.block_count, self.width
        storage = values.new_zeros(len(values), 2 * count * width * width + 1)
        storage.scatter_add_(1, self.index.expand(len(values), -1), values)
        if couplings is not None:
            place, far = self._places(couplings)
            if bool(far.any()):
                return self._sparse(storage, couplings)
            flat = couplings.entry[:, None, None] * storage.shape[1] + place
            storage.view(-1).index_add_(0, flat.flatten(), couplings.blocks.flatten())
        matrix = storage[:, :-1].view(-1, 2, count, width, width)
        padding = count * width - 3 * self.node_count
        if padding:
            matrix[:, 0, -1].diagonal(dim1=-2, dim2=-1)[:, width - padding :] = 1.0
        lower: list[Tensor] = []
        coupling: list[Tensor] = []
        for block in range(count):  # a chain of blocks, tens of them; each operation is batched
            current = matrix[:, 0, block]
            if block:
                step = torch.linalg.solve_triangular(lower[-1], matrix[:, 1, block - 1].mT, upper=False)
                coupling.append(step.mT)
                current = current - step.mT @ step
            lower.append(_cholesky(current))
        return BlockTridiagonalFactor(self, lower, coupling)

    def _places(self, couplings: Couplings) -> tuple[Tensor, Tensor]:
        """(place in the storage [Q, 3, 3], whether the coupling is outside of the three diagonals of blocks [Q])."""
        axis = torch.arange(3, device=self.place.device)
        rows = 3 * self.place[couplings.rows][:, None, None] + axis[:, None]
        columns = 3 * self.place[couplings.columns][:, None, None] + axis
        row_block, column_block, width = rows // self.width, columns // self.width, self.width
        below = row_block - column_block
        flat = ((below * self.block_count + row_block - below) * width + rows % width) * width + columns % width
        spare = 2 * self.block_count * width * width
        return torch.where(below < 0, spare, flat), (below.abs() > 1).flatten(1).any(1)

    def _sparse(self, storage: Tensor, couplings: Couplings) -> ReorderedFactor:
        """Where far couplings break the band: a sparse factor for each entry (scipy, on the CPU)."""
        count, width, size = self.block_count, self.width, 3 * self.node_count
        below, block, row, column = np.unravel_index(np.arange(2 * count * width**2), (2, count, width, width))
        rows, columns = (block + below) * width + row, block * width + column
        inside = (rows < size) & (columns < size)
        rows, columns, under = rows[inside], columns[inside], below[inside] == 1
        band = storage[:, :-1].cpu().numpy()[:, inside]
        entry, nodes = couplings.entry.cpu().numpy(), (self.place[couplings.rows], self.place[couplings.columns])
        first, second = (3 * node.cpu().numpy()[:, None, None] for node in nodes)
        axis = np.arange(3)
        first, second = np.broadcast_arrays(first + axis[:, None], second + axis)
        extra = couplings.blocks.cpu().numpy()
        factors, indefinite = [], []
        for index, values in enumerate(band):
            own = entry == index
            matrix = csc_matrix((values, (rows, columns)), shape=(size, size))
            matrix += csc_matrix((values[under], (columns[under], rows[under])), shape=(size, size))
            matrix += csc_matrix((extra[own].ravel(), (first[own].ravel(), second[own].ravel())), shape=(size, size))
            matrix.eliminate_zeros()
            # pivots on the diagonal, as a symmetric matrix allows: they are positive where it is positive definite
            factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
            factors.append(factor)
            if not (factor.U.diagonal() > 0).all():
                indefinite.append(index)
        if indefinite:
            raise NotPositiveDefiniteError(indefinite)
        return ReorderedFactor(self, SparseLU(factors))


@dataclass(frozen=True)
class ReorderedFactor:
    """The factor of a matrix whose nodes are in the pattern's order."""

    pattern: BlockTridiagonalPattern
    factor: SparseLU

    def solve(self, right: Tensor, *, transposed: bool = False) -> Tensor:
        ordered = self.factor.solve(right[:, self.pattern.order], transposed=transposed)
        return ordered[:, self.pattern.place]


@dataclass(frozen=True)
class BlockTridiagonalFactor:
    """Cholesky factors of the chain."""

    pattern: BlockTridiagonalPattern
    lower: list[Tensor]
    """N of [B, width, width]."""
    coupling: list[Tensor]
    """N - 1 of [B, width, width]: L[i+1, i]."""

    def solve(self, right: Tensor, *, transposed: bool = False) -> Tensor:
        pattern = self.pattern
        columns = _copies_as_columns(right[:, pattern.order], len(self.lower[0]))
        padded = torch.nn.functional.pad(columns, (0, 0, 0, pattern.block_count * pattern.width - columns.shape[1]))
        parts = list(padded.split(pattern.width, dim=1))
        for block, lower in enumerate(self.lower):
            if block:
                parts[block] = parts[block] - self.coupling[block - 1] @ parts[block - 1]
            parts[block] = torch.linalg.solve_triangular(lower, parts[block], upper=False)
        for block in reversed(range(len(parts))):
            if block + 1 < len(parts):
                parts[block] = parts[block] - self.coupling[block].mT @ parts[block + 1]
            parts[block] = torch.linalg.solve_triangular(self.lower[block].mT, parts[block], upper=True)
        solution = torch.cat(parts, dim=1)[:, : 3 * pattern.node_count]
        return _columns_as_copies(solution, right)[:, pattern.place]


def _entries(
    node_count: int, groups: Sequence[NDArray[np.int64]], place: NDArray[np.int64] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row and column of each number of the diagonal blocks [V, 3, 3] and the element blocks [E, 3n, 3n], flattened."""
    place = np.arange(node_count) if place is None else place
    rows, columns = [], []
    for nodes in [np.arange(node_count)[:, None], *groups]:
        coordinates = (3 * place[nodes][:, :, None] + np.arange(3)).reshape(len(nodes), -1)
        rows.append(np.repeat(coordinates, coordinates.shape[1], axis=1).ravel())
        columns.append(np.tile(coordinates, coordinates.shape[1]).ravel())
    return np.concatenate(rows), np.concatenate(columns)


def _cholesky(matrix: Tensor) -> Tensor:
    lower, info = torch.linalg.cholesky_ex(matrix)
    if info.any():
        raise NotPositiveDefiniteError(info.nonzero().flatten().tolist())
    return lower


def _copies_as_columns(right: Tensor, batch: int) -> Tensor:
    """[K · B, V, 3] -> [B, 3V, K]."""
    return right.reshape(-1, batch, 3 * right.shape[1]).permute(1, 2, 0)


def _columns_as_copies(solution: Tensor, like: Tensor) -> Tensor:
    """[B, 3V, K] -> [K · B, V, 3]."""
    return solution.permute(2, 0, 1).reshape(like.shape)


@dataclass(frozen=True)
class GeneralPattern:
    """Matrices without symmetry over the nodes of a mesh, with couplings wherever contact puts them.

    Dense LU for small meshes; sparse LU (SuperLU, one batch entry after the other) beyond.
    """

    node_count: int
    rows: Tensor
    """Row of each number of the diagonal and of the blocks."""
    columns: Tensor

    @staticmethod
    def build(node_count: int, groups: Sequence[NDArray[np.int64]], device: torch.device) -> GeneralPattern:
        rows, columns = _entries(node_count, groups)
        return GeneralPattern(node_count, torch.as_tensor(rows, device=device), torch.as_tensor(columns, device=device))

    def factorise(self, diagonal: Tensor, blocks: Sequence[Tensor], couplings: Sequence[Couplings]) -> Factor:
        """Assemble and factorise; arguments as for `MatrixPattern`, and blocks between any nodes.

        Raises:
            SingularMatrixError: names the batch entries.
        """
        batch, size = len(diagonal), 3 * self.node_count
        values = torch.cat([diagonal.flatten(1), *(block.flatten(1) for block in blocks)], dim=1)
        axis = torch.arange(3, device=values.device)
        extra = [
            (
                c.entry.repeat_interleave(9),
                (3 * c.rows[:, None, None] + axis[:, None]).expand(-1, 3, 3).flatten(),
                (3 * c.columns[:, None, None] + axis).expand(-1, 3, 3).flatten(),
                c.blocks.flatten(),
            )
            for c in couplings
        ]
        if self.node_count <= _DENSE_NODES:
            flat = values.new_zeros(batch, size * size)
            flat.scatter_add_(1, (self.rows * size + self.columns).expand(batch, -1), values)
            flat = flat.view(-1)
            for entry, row, column, value in extra:
                flat.index_add_(0, (entry * size + row) * size + column, value)
            lu, pivots, info = torch.linalg.lu_factor_ex(flat.view(batch, size, size))
            if bool(info.any()):
                raise SingularMatrixError(info.nonzero().flatten().tolist())
            return DenseLU(lu, pivots)
        factors = []
        for index in range(batch):
            rows, columns, numbers = [self.rows], [self.columns], [values[index]]
            for entry, row, column, value in extra:
                own = entry == index
                rows.append(row[own])
                columns.append(column[own])
                numbers.append(value[own])
            triplets = (
                torch.cat(numbers).cpu().numpy(),
                (torch.cat(rows).cpu().numpy(), torch.cat(columns).cpu().numpy()),
            )
            try:
                factors.append(splu(csc_matrix(coo_matrix(triplets, shape=(size, size)))))
            except RuntimeError as error:
                raise SingularMatrixError([index]) from error
        return SparseLU(factors)


@dataclass(frozen=True)
class DenseLU:
    """LU factors [B, 3V, 3V] and pivots."""

    lu: Tensor
    pivots: Tensor

    def solve(self, right: Tensor, *, transposed: bool = False) -> Tensor:
        columns = _copies_as_columns(right, len(self.lu)).contiguous()
        return _columns_as_copies(torch.linalg.lu_solve(self.lu, self.pivots, columns, adjoint=transposed), right)


@dataclass(frozen=True)
class SparseLU:
    """SuperLU factors, one for each batch entry."""

    factors: list[SuperLU]

    def solve(self, right: Tensor, *, transposed: bool = False) -> Tensor:
        columns = _copies_as_columns(right, len(self.factors)).cpu().numpy()
        trans = "T" if transposed else "N"
        solved = [factor.solve(np.ascontiguousarray(own), trans) for factor, own in zip(self.factors, columns, strict=True)]
        return _columns_as_copies(torch.as_tensor(np.stack(solved), dtype=right.dtype, device=right.device), right)
