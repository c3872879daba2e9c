"""Procedural cloths."""

from __future__ import annotations

import numpy as np

from diffcloud.errors import MeshError
from diffcloud.mesh.topology import ClothMesh


def grid_cloth(rows: int, columns: int, height: float, width: float, *, alternate_diagonals: bool = False) -> ClothMesh:
    """A flat rectangular cloth in the plane z = 0, centred on the origin, rest shape equal to its world shape.

    Node (i, j) has index i·columns + j; i runs along +y (and material v), j along +x (and material u).

    Args:
        rows, columns: node counts, at least 2 each.
        height, width: extent along y and x [m], positive.
        alternate_diagonals: turn every second diagonal, which makes bending less dependent on direction.

    Raises:
        MeshError: fewer than 2 nodes a side, or a size that is not positive.
    """
    if rows < 2 or columns < 2:
        raise MeshError(f"A grid cloth needs at least 2 x 2 nodes, got {rows} x {columns}.")
    if not (height > 0 and width > 0):
        raise MeshError(f"A grid cloth needs a positive size in metres, got {height} x {width}.")
    v, u = np.meshgrid(np.linspace(0, height, rows), np.linspace(0, width, columns), indexing="ij")
    verts = np.stack([u.ravel(), v.ravel()], axis=1)
    nodes = np.column_stack([verts - [width / 2, height / 2], np.zeros(len(verts))])
    i, j = (index.ravel() for index in np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij"))
    a = i * columns + j
    b, c, d = a + 1, a + columns, a + columns + 1
    turned = ((i + j) % 2 == 1) & alternate_diagonals
    first = np.where(turned[:, None], np.stack([a, b, d], axis=1), np.stack([a, b, c], axis=1))
    second = np.where(turned[:, None], np.stack([a, d, c], axis=1), np.stack([b, d, c], axis=1))
    faces = np.stack([first, second], axis=1).reshape(-1, 3)
    return ClothMesh(nodes=nodes, verts=verts, vert_node=np.arange(len(verts)), face_verts=faces)
