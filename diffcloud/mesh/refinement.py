"""Mesh refinement of a cloth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from diffcloud.mesh.topology import ClothMesh, IntArray

_SIDES = [[0, 1], [1, 2], [2, 0]]
_RIGHT = 1e-6
"""Cosine below which an angle counts as right or obtuse."""


def refined(mesh: ClothMesh) -> tuple[ClothMesh, IntArray]:
    """Split each face into four at the midpoints of its edges.

    The midpoints and the corner with the largest angle form a parallelogram, which is split along its shorter diagonal. If
    both are equal, it is the one through this corner. So a grid with alternating diagonals becomes one of half the edge
    length.

    Returns:
        The mesh, whose first nodes are those of the given mesh, and the edges [E, 2] whose midpoints are the other nodes.
    """
    sides = np.sort(mesh.face_verts[:, _SIDES], axis=-1)  # [F, 3, 2] of verts, since seams have two sides
    cuts, of_side = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
    edges, of_cut = np.unique(np.sort(mesh.vert_node[cuts], axis=1), axis=0, return_inverse=True)
    a, b, c = mesh.face_verts.T
    ab, bc, ca = len(mesh.verts) + of_side.reshape(-1, 3).T
    faces = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]], axis=1)  # [3, 4, F]
    corner = mesh.verts[mesh.face_verts]
    ways = np.roll(corner, -1, axis=1) - corner  # [F, 3, 2] vectors from each corner to the next
    cosine = -(ways * np.roll(ways, 1, axis=1)).sum(-1)  # times both lengths
    length = np.linalg.norm(ways, axis=-1)
    cosine /= length * np.roll(length, 1, axis=1)
    wide = cosine < _RIGHT
    for k, (start, before, after, opposite) in enumerate(((a, ca, ab, bc), (b, ab, bc, ca), (c, bc, ca, ab))):
        cut = wide[:, k]
        faces[:, k, cut] = np.stack([start, after, opposite])[:, cut]
        faces[:, 3, cut] = np.stack([start, opposite, before])[:, cut]
    finer = replace(
        mesh,
        nodes=np.concatenate([mesh.nodes, mesh.nodes[edges].mean(axis=1)]),
        verts=np.concatenate([mesh.verts, mesh.verts[cuts].mean(axis=1)]),
        vert_node=np.concatenate([mesh.vert_node, len(mesh.nodes) + of_cut.reshape(-1)]),
        face_verts=faces.transpose(2, 1, 0).reshape(-1, 3),
    )
    return finer, edges
