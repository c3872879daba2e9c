"""Finer meshes of the same cloth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from diffcloud.mesh.topology import ClothMesh, IntArray

_SIDES = [[0, 1], [1, 2], [2, 0]]


def refined(mesh: ClothMesh) -> tuple[ClothMesh, IntArray]:
    """Each face cut into four at the middles of its edges.

    Returns:
        The mesh, whose first nodes are those of the given one, and [E, 2] the ends of the edges whose middles follow.
    """
    sides = np.sort(mesh.face_verts[:, _SIDES], axis=-1)  # [F, 3, 2] of verts: a seam has two sides in material space
    cuts, of_side = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
    edges, of_cut = np.unique(np.sort(mesh.vert_node[cuts], axis=1), axis=0, return_inverse=True)
    a, b, c = mesh.face_verts.T
    ab, bc, ca = len(mesh.verts) + of_side.reshape(-1, 3).T
    faces = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]], axis=1)  # [3, 4, F]
    finer = replace(
        mesh,
        nodes=np.concatenate([mesh.nodes, mesh.nodes[edges].mean(axis=1)]),
        verts=np.concatenate([mesh.verts, mesh.verts[cuts].mean(axis=1)]),
        vert_node=np.concatenate([mesh.vert_node, len(mesh.nodes) + of_cut.reshape(-1)]),
        face_verts=faces.transpose(2, 1, 0).reshape(-1, 3),
    )
    return finer, edges
