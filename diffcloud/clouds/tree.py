"""Exact nearest points by a tree of boxes, in kernels.

Points are sorted along a Hilbert curve, eight per leaf. Sixteen consecutive nodes form a node of the next level. Sixteen
consecutive queries along their own curve traverse the tree together. A node is opened if its box is as close to the box of
the queries as the farthest neighbour found so far. Guesses, and the leaf of the previous neighbours, are tested first.

Rounding is monotone, so the computed distance to a box never exceeds that to a point inside. So the result is exact. Of
equally near points it is the one with the lowest index.

Loops over sixteen have a constant length, no branches, and are too long to be unrolled. So they become vector instructions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from diffcloud.clouds.curve import Floats, Ints, curve_order, larger, smaller
from diffcloud.compiled import kernel

_LEAF = 8
_FAN = 16
_LANES = 16
_X, _Y, _Z, _NEAREST, _FOUND = 0, _LANES, 2 * _LANES, 3 * _LANES, 4 * _LANES
"""Offsets of the queries' coordinates, squared distances and neighbour indices."""
_STACK = 16 * _FAN


class Tree(NamedTuple):
    """Search tree of a cloud of P points."""

    points: Floats
    """[P, 3] points [m]."""
    order: Ints
    """[P] indices of the points along the curve."""
    leaves: Floats
    """[L * 32] for each leaf 8 x, 8 y, 8 z [m] and 8 indices. Missing points in the last leaf are infinite, with index
    P."""
    boxes: Floats
    """[G * 96] for each group of 16 nodes 16 lowest x, y, z, then 16 highest [m]. Boxes of missing nodes are inverted."""
    starts: Ints
    """[D] first group of each level, leaves first. Group n of a level contains the children of node n of the next level."""
    counts: Ints
    """[D] number of nodes of each level."""


@kernel
def build_tree(points: Floats) -> Tree:
    """Build the tree of finite points [P, 3], at least one."""
    order = curve_order(points)
    size = len(order)
    starts, counts = np.zeros(16, np.int64), np.zeros(16, np.int64)
    nodes, groups, levels = (size + _LEAF - 1) // _LEAF, 0, 0
    while True:
        starts[levels], counts[levels] = groups, nodes
        levels += 1
        nodes = (nodes + _FAN - 1) // _FAN
        groups += nodes
        if nodes == 1:
            break
    leaves = np.full(counts[0] * 4 * _LEAF, np.inf)
    boxes = np.empty(groups * 6 * _FAN)
    for group in range(groups):
        for k in range(3 * _FAN):
            boxes[6 * _FAN * group + k], boxes[6 * _FAN * group + 3 * _FAN + k] = np.inf, -np.inf
    for k in range(counts[0] * _LEAF):
        leaf, place = k // _LEAF, k % _LEAF
        at, box = 4 * _LEAF * leaf + place, 6 * _FAN * (leaf // _FAN) + leaf % _FAN
        if k >= size:
            leaves[at + 3 * _LEAF] = size
            continue
        leaves[at + 3 * _LEAF] = order[k]
        for axis in range(3):
            value = points[order[k], axis]
            leaves[at + axis * _LEAF] = value
            low, high = box + axis * _FAN, box + (3 + axis) * _FAN
            boxes[low], boxes[high] = smaller(boxes[low], value), larger(boxes[high], value)
    for level in range(1, levels):
        for node in range(counts[level]):
            below = 6 * _FAN * (starts[level - 1] + node)
            box = 6 * _FAN * (starts[level] + node // _FAN) + node % _FAN
            for side in range(3):
                low, high = box + side * _FAN, box + (3 + side) * _FAN
                for k in range(side * _FAN, (side + 1) * _FAN):
                    boxes[low] = smaller(boxes[low], boxes[below + k])
                    boxes[high] = larger(boxes[high], boxes[below + 3 * _FAN + k])
    return Tree(points, order, leaves, boxes, starts[:levels], counts[:levels])


@kernel
def _scan(leaves: Floats, leaf: int, lanes: Floats) -> None:
    """Compare the queries with the points of a leaf."""
    begin = 4 * _LEAF * leaf
    for point in range(begin, begin + _LEAF):
        x, y, z, number = leaves[point], leaves[point + _LEAF], leaves[point + 2 * _LEAF], leaves[point + 3 * _LEAF]
        for lane in range(_LANES):
            dx, dy, dz = lanes[_X + lane] - x, lanes[_Y + lane] - y, lanes[_Z + lane] - z
            distance = dx * dx + dy * dy + dz * dz
            nearest, found = lanes[_NEAREST + lane], lanes[_FOUND + lane]
            nearer = (distance < nearest) | ((distance == nearest) & (number < found))
            lanes[_NEAREST + lane] = distance if nearer else nearest
            lanes[_FOUND + lane] = number if nearer else found


@kernel
def _reach(lanes: Floats) -> float:
    """Largest squared distance found so far. Pairwise, so that the comparisons can run in parallel."""
    reach = -np.inf
    for k in range(_NEAREST, _NEAREST + _LANES, 4):
        reach = larger(reach, larger(larger(lanes[k], lanes[k + 1]), larger(lanes[k + 2], lanes[k + 3])))
    return reach


@kernel
def _gaps(boxes: Floats, group: int, box: Floats, gaps: Floats) -> None:
    """Squared distances [16] from the queries' box (lowest x, y, z, highest x, y, z) to the boxes of a group."""
    begin = 6 * _FAN * group
    low_x, low_y, low_z, high_x, high_y, high_z = box[0], box[1], box[2], box[3], box[4], box[5]
    for k in range(_FAN):
        at = begin + k
        dx = larger(larger(boxes[at] - high_x, low_x - boxes[at + 3 * _FAN]), 0.0)
        dy = larger(larger(boxes[at + _FAN] - high_y, low_y - boxes[at + 4 * _FAN]), 0.0)
        dz = larger(larger(boxes[at + 2 * _FAN] - high_z, low_z - boxes[at + 5 * _FAN]), 0.0)
        gaps[k] = dx * dx + dy * dy + dz * dz


@kernel
def _gather(queries: Floats, order: Ints, guesses: Ints, begin: int, points: Floats, lanes: Floats, box: Floats) -> None:
    """Load the next queries with their guesses and their bounding box. The last query fills the remaining lanes."""
    for axis in range(3):
        low, high = np.inf, -np.inf
        for lane in range(_LANES):
            value = queries[order[min(begin + lane, len(order) - 1)], axis]
            lanes[axis * _LANES + lane] = value
            low, high = smaller(value, low), larger(value, high)
        box[axis], box[3 + axis] = low, high
    for lane in range(_LANES):
        lanes[_NEAREST + lane], lanes[_FOUND + lane] = np.inf, len(points)
        guess = guesses[order[min(begin + lane, len(order) - 1)]] if len(guesses) > 0 else -1
        if guess >= 0:
            dx, dy = lanes[_X + lane] - points[guess, 0], lanes[_Y + lane] - points[guess, 1]
            dz = lanes[_Z + lane] - points[guess, 2]
            lanes[_NEAREST + lane], lanes[_FOUND + lane] = dx * dx + dy * dy + dz * dz, guess


@kernel
def find_nearest(queries: Floats, order: Ints, guesses: Ints, tree: Tree) -> Ints:
    """Index [Q] of the nearest point of each query [Q, 3] that `order` lists; 0 for the other queries.

    Args:
        order: indices of the queries to answer, along a curve.
        guesses: [Q] points that may be near; negative for none, or [0] without guesses.
    """
    result = np.zeros(len(queries), np.int64)
    lanes, box, gaps = np.empty(5 * _LANES), np.empty(6), np.empty(_FAN)
    nodes, levels, bounds = np.empty(_STACK, np.int64), np.empty(_STACK, np.int64), np.empty(_STACK)
    leaf = 0  # leaf in which the previous neighbours were found
    for begin in range(0, len(order), _LANES):
        _gather(queries, order, guesses, begin, tree.points, lanes, box)
        _scan(tree.leaves, leaf, lanes)
        reach, first = _reach(lanes), leaf
        nodes[0], levels[0], bounds[0] = 0, len(tree.starts) - 1, 0.0
        depth = 1
        while depth > 0:
            depth -= 1
            if bounds[depth] > reach:
                continue
            level, node = levels[depth], _FAN * nodes[depth]
            _gaps(tree.boxes, tree.starts[level] + nodes[depth], box, gaps)
            for k in range(min(_FAN, tree.counts[level] - node)):
                if gaps[k] > reach or (level == 0 and node + k == first):
                    continue
                if level > 0:
                    nodes[depth], levels[depth], bounds[depth] = node + k, level - 1, gaps[k]
                    depth += 1
                    continue
                _scan(tree.leaves, node + k, lanes)
                shorter = _reach(lanes)
                if shorter < reach:
                    reach, leaf = shorter, node + k
        for lane in range(min(_LANES, len(order) - begin)):
            result[order[begin + lane]] = int(lanes[_FOUND + lane])
    return result
