"""How large a grasp is, and how it holds the cloth.

A node that is held alone is a point load: its compliance grows with the logarithm of the inverse edge length, without a
limit. A *pad* holds all nodes inside a square alike. A *pivot* holds one node, and scales the stretching stiffness of the
faces around it so that the node yields as a rigid square of the grasp's size would, which is free to turn:

    1/s = 1 + (K/c) ln(g h / a),      h = edge length, a = size.

K belongs to the angle of cloth around the point: 2/(φ + sin φ) for a free corner or edge (Flamant), (1 + ν)(3 - ν)/(4π)
inside. c is the share of the faces at the node in its compliance, g the size in edge lengths of the square that a node
stands for. Both depend on how the faces meet there. Those of corners come from hanging sheets, the others from linear
elasticity against rigid squares (`tests/sim/test_grasp.py`). Where edges are shorter than the square, the faces inside it
are made `_RIGID` times as stiff instead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from diffcloud.errors import SceneError
from diffcloud.mesh.topology import ClothMesh, FloatArray, IntArray

Grip = Literal["pad", "upright_pad", "pivot"]
"""A pad keeps the cloth's direction: as it lies ("pad", fingers level), or turned up at the start ("upright_pad", pinched
from above). A pivot lets it turn."""
GRIP_M = 0.02
"""Size of a grasp where none is stated: about that of the pads of a Robotiq 2F-85 [m]."""
_RIGID = 30.0
"""The compliance of a pivot is then within a tenth of a rigid square's, in most meshes within a twentieth."""
_LEAST = 0.09
"""Of 1/s, where the formula holds: beyond, edges are shorter than the square."""
_TOLERANCE = 1e-9
_POINTS: tuple[tuple[float, float, tuple[tuple[int, float, float], ...]], ...] = (
    (math.pi / 2, 0.81, ((2, 1.38, 0.20), (1, 1.0, 0.295))),
    (math.pi, 0.64, ((4, 0.88, 0.29), (2, 0.74, 0.37))),
    (2 * math.pi, 0.27, ((8, 0.39, 0.35), (4, 0.35, 0.40))),
)
"""Angle of cloth around the point [rad], K, and for so many faces there c and g [1]; isotropic, K and c times 1/(E h)."""


@dataclass(frozen=True)
class Grasp:
    """What holds the cloth at each held place."""

    kind: Grip
    size: float
    """Side of the square [m]."""

    def described(self, nodes: int) -> str:
        """
        Args:
            nodes: that are held.
        """
        size = f"{1e3 * self.size:.3g} mm"
        if self.kind == "pivot":
            return f"pivot of {size}"
        return f"{'upright' if self.kind == 'upright_pad' else 'level'} pad of {size}, {nodes} nodes held"


def window(place: FloatArray, low: FloatArray, high: FloatArray, size: float) -> tuple[FloatArray, FloatArray]:
    """The square of a pad around a place: centred there, and moved inwards where it would leave the cloth.

    Args:
        place, low, high: [2] in material space; the last two are corners of the rectangle around the cloth [m].

    Returns:
        Its lower and upper corner [2].
    """
    lower = np.clip(place - size / 2, low, np.maximum(high - size, low))
    return lower, lower + size


def inside(places: FloatArray, lower: FloatArray, upper: FloatArray) -> IntArray:
    """Numbers of the places [N, 2] in a rectangle, its border included."""
    slack = _TOLERANCE * float(np.abs(upper).max() + 1)
    return np.flatnonzero(((places >= lower - slack) & (places <= upper + slack)).all(axis=1))


def nodes_under_pad(mesh: ClothMesh, node: int, size: float) -> list[int]:
    """Nodes of any mesh that a pad at a node holds, the node among them; on a seam, those of all its patches.

    Raises:
        SceneError: a pad that is as large as the cloth, or that holds the node alone.
    """
    found = {node}
    for patch, lower, upper in _squares(mesh, node, size):
        extent = np.ptp(patch, axis=0)
        if size >= extent.min():
            raise SceneError(
                f"A pad of {size:g} does not fit on a cloth of {extent[0]:.4g} x {extent[1]:.4g}. It must be smaller than "
                "both sides; give a smaller grip_m."
            )
        found.update(mesh.vert_node[inside(mesh.verts, lower, upper)].tolist())
    if len(found) == 1:
        raise SceneError(
            f"A pad of {size:g} at node {node} holds no other node of this mesh, so it would be a point. A pad holds two "
            'nodes at least; give a larger grip_m, a finer mesh, or the grip "pivot".'
        )
    return sorted(found)


def _squares(mesh: ClothMesh, node: int, size: float) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """For each of a node's verts: the verts of its patch of material space [N, 2], and `window` around it there."""
    from scipy.sparse import coo_array  # slow to import
    from scipy.sparse.csgraph import connected_components

    corners = mesh.face_verts
    joined = coo_array(
        (np.ones(2 * len(corners)), (corners[:, :2].ravel(), corners[:, 1:].ravel())), (len(mesh.verts),) * 2
    )
    patch = connected_components(joined, directed=False)[1]
    found = []
    for vert in np.flatnonzero(mesh.vert_node == node):
        own = mesh.verts[patch == patch[vert]]
        found.append((own, *window(mesh.verts[vert], own.min(axis=0), own.max(axis=0), size)))
    return found


def turned_up(places: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """[N, 3] displacement of a pad's nodes by a quarter turn, about the line at the pad's inner end, that lifts the rim.

    Args:
        places: [N, 2] of the nodes in material space, the third axis being the cloth's normal [m].
        low, high: [2] corners of the rectangle around the cloth.

    Raises:
        SceneError: the pad is not at the rim.
    """
    at_low, at_high = (np.isclose(end, bound) for end, bound in ((places.min(0), low), (places.max(0), high)))
    outward = at_high.astype(float) - at_low.astype(float)
    if not outward.any():
        raise SceneError(
            'An upright pad inside the cloth. It turns up a rim: hold an edge or a corner, or use the grip "pad".'
        )
    outward /= np.linalg.norm(outward)
    reach = places @ outward
    reach = reach - reach.min()
    return np.column_stack([-reach[:, None] * outward, reach])


def stretching_factors(mesh: ClothMesh, nodes: Sequence[int], grasp: Grasp | None) -> FloatArray:
    """[F] on the stretching stiffness of each face: 1 except around the nodes of a pivot. Held nodes side by side are no
    point load, and have none.

    Args:
        nodes: that are held.
    """
    factors = np.ones(len(mesh.faces))
    if grasp is None or grasp.kind != "pivot":
        return factors
    middle = mesh.verts[mesh.face_verts].mean(axis=1)
    held = set(nodes)
    for node in held:
        at = np.flatnonzero((mesh.faces == node).any(axis=1))
        if held & (set(mesh.faces[at].ravel().tolist()) - {node}):
            continue
        corners = mesh.verts[mesh.face_verts[at]]
        own = mesh.faces[at] == node
        sides = corners[~own].reshape(-1, 2, 2) - corners[own][:, None]
        length = np.linalg.norm(sides, axis=-1)
        angle = np.arccos(np.clip((sides[:, 0] * sides[:, 1]).sum(-1) / length.prod(-1), -1, 1)).sum()
        _, strength, meetings = min(_POINTS, key=lambda point: abs(point[0] - angle))
        _, share, side = min(meetings, key=lambda meeting: abs(meeting[0] - len(at)))
        edge = math.sqrt(2 * float(mesh.face_area[at].mean()))
        inverse = 1 + strength / share * math.log(side * edge / grasp.size)
        if inverse > _LEAST:
            factors[at] = 1 / inverse
        else:
            factors[at] = _RIGID
            for _, lower, upper in _squares(mesh, node, grasp.size):
                factors[inside(middle, lower, upper)] = _RIGID
    return factors
