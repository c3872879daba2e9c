"""Elimination order of a sparse symmetric pattern that keeps its factors small.

Approximate minimum degree (Amestoy, Davis and Duff 1996): repeatedly eliminate the node with the fewest neighbours, which
connects its neighbours with each other. Instead of all these pairs, an *element* stores the list of these neighbours. An
element whose nodes all belong to a new element is removed. A degree counts a node twice if two elements share it.
"""

from __future__ import annotations

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Ints
from diffcloud.sim.compiled.pool import with_room


@kernel
def minimum_degree(starts: Ints, neighbours: Ints) -> Ints:
    """Return the position [V] of each node in the elimination order.

    Args:
        starts: [V + 1] start of each node's list in `neighbours`, which is overwritten.
        neighbours: the nodes with which each node shares a block. Each pair is in both lists.
    """
    count = len(starts) - 1
    place, degree = np.full(count, -1, np.int64), np.empty(count, np.int64)
    own, joined = np.empty(count, np.int64), np.zeros(count, np.int64)  # number of neighbours and of elements of each node
    elements = np.empty_like(neighbours)  # elements of each node, at most as many as its initial neighbours
    first, next_one = np.full(count + 1, -1, np.int64), np.empty(count, np.int64)  # lists of the nodes of each degree
    before = np.empty(count, np.int64)
    nodes, used = np.empty((4 * len(neighbours) + count, 1), np.int64), 0  # nodes of all elements, concatenated
    begin, size = np.empty(count, np.int64), np.zeros(count, np.int64)  # of each element in `nodes`; size 0: removed
    mark, seen, outside = np.full(count, -1, np.int64), np.full(count, -1, np.int64), np.empty(count, np.int64)
    for i in range(count - 1, -1, -1):
        own[i] = degree[i] = starts[i + 1] - starts[i]
        _file(first, next_one, before, degree, i)
    least = 0
    for k in range(count):
        while first[least] < 0:
            least += 1
        pivot = first[least]
        _take_out(first, next_one, before, degree, pivot)
        place[pivot], mark[pivot] = k, k
        nodes = with_room(nodes, used, count)
        begin[pivot] = used
        for q in range(starts[pivot], starts[pivot] + own[pivot]):
            mark[neighbours[q]] = k
            nodes[used, 0] = neighbours[q]
            used += 1
        for q in range(starts[pivot], starts[pivot] + joined[pivot]):
            e = elements[q]
            for r in range(begin[e], begin[e] + size[e]):
                if mark[nodes[r, 0]] != k:
                    mark[nodes[r, 0]] = k
                    nodes[used, 0] = nodes[r, 0]
                    used += 1
            size[e] = 0
        size[pivot] = used - begin[pivot]
        for r in range(begin[pivot], used):  # number of nodes of other elements outside the new one
            i = nodes[r, 0]
            for q in range(starts[i], starts[i] + joined[i]):
                e = elements[q]
                if seen[e] != k:
                    seen[e], outside[e] = k, size[e]
                outside[e] -= 1
        for r in range(begin[pivot], used):
            i = nodes[r, 0]
            _take_out(first, next_one, before, degree, i)
            found, kept = size[pivot] - 1, starts[i]
            for q in range(starts[i], starts[i] + joined[i]):
                e = elements[q]
                if outside[e] > 0 and size[e] > 0:
                    elements[kept] = e
                    found += outside[e]
                    kept += 1
            elements[kept] = pivot
            joined[i] = kept + 1 - starts[i]
            kept = starts[i]
            for q in range(starts[i], starts[i] + own[i]):
                if mark[neighbours[q]] != k:
                    neighbours[kept] = neighbours[q]
                    kept += 1
            own[i] = kept - starts[i]
            degree[i] = min(found + own[i], count - k - 2)
            _file(first, next_one, before, degree, i)
            least = min(least, degree[i])
    return place


@kernel
def _file(first: Ints, next_one: Ints, before: Ints, degree: Ints, i: int) -> None:
    """Insert a node at the head of the list of its degree."""
    head = first[degree[i]]
    next_one[i], before[i], first[degree[i]] = head, -1, i
    if head >= 0:
        before[head] = i


@kernel
def _take_out(first: Ints, next_one: Ints, before: Ints, degree: Ints, i: int) -> None:
    """Remove a node from the list of its degree."""
    if before[i] >= 0:
        next_one[before[i]] = next_one[i]
    else:
        first[degree[i]] = next_one[i]
    if next_one[i] >= 0:
        before[next_one[i]] = before[i]
