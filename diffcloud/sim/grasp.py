"""Types and sizes of grasps, and the nodes and stiffness that they give a mesh.

Holding a single node is a point load. Its compliance grows without limit as the mesh is refined, with log(1 / edge length).
So a grasp has a size a [m]. A *pad* holds all nodes inside a square. A *pivot* holds one node and scales the stretching
stiffness of the faces around it by s. The node then yields like a rigid, freely rotating square of side a:

    1/s = 1 + (K/c) ln(g h / a),      h = edge length.

K depends on the angle φ of cloth around the point: 2/(φ + sin φ) for a free corner or edge (Flamant's solution), and
(1 + ν)(3 - ν)/(4π) inside the cloth, with Poisson's ratio ν. c is the share of these faces in the node's compliance. g is
the side, in edge lengths, of the square that the node represents. c and g depend on how many faces meet at the node. At
corners they were fitted to hanging sheets, elsewhere to linear elasticity with rigid squares (`tests/sim/test_grasp.py`).
If the edges are shorter than the square, all faces inside the square become `_RIGID` times as stiff instead.
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
"""Type of grasp. "pad": fingers level, the cloth keeps its direction. "upright_pad": the cloth is pinched from above and
turned up at the start. "pivot": the cloth can rotate about the grasp."""
GRIP_M = 0.02
"""Default size of a grasp [m], about the pad width of a Robotiq 2F-85 gripper."""
_RIGID = 30.0
"""Stiffness factor of the faces inside a pivot. Its compliance is then within 10 % of a rigid square's, mostly within 5 %.
"""
_LEAST = 0.09
"""Smallest 1/s for which the formula holds. Below it, the edges are shorter than the square."""
_TOLERANCE = 1e-9
_POINTS: tuple[tuple[float, float, tuple[tuple[int, float, float], ...]], ...] = (
    (math.pi / 2, 0.81, ((2, 1.38, 0.20), (1, 1.0, 0.295))),
    (math.pi, 0.64, ((4, 0.88, 0.29), (2, 0.74, 0.37))),
    (2 * math.pi, 0.27, ((8, 0.39, 0.35), (4, 0.35, 0.40))),
)
"""Angle of cloth around the point [rad], K, and (number of faces at the node, c, g) for each type of mesh. For an isotropic
sheet of thickness h, K and c are in units of 1/(E h)."""


@dataclass(frozen=True)
class Grasp:
    """Type and size of every grasp in a scene."""

    kind: Grip
    size: float
    """Side of the square [m]."""

    def described(self, nodes: int) -> str:
        """Text that describes the grasp, for `nodes` held nodes."""
        size = f"{1e3 * self.size:.3g} mm"
        if self.kind == "pivot":
            return f"pivot of {size}"
        return f"{'upright' if self.kind == 'upright_pad' else 'level'} pad of {size}, {nodes} nodes held"


def window(place: FloatArray, low: FloatArray, high: FloatArray, size: float) -> tuple[FloatArray, FloatArray]:
    """Square of a pad around a point, shifted inwards where it would extend beyond the cloth.

    Args:
        place: [2] centre in material space [m].
        low, high: [2] corners of the cloth's bounding rectangle [m].

    Returns:
        Its lower and upper corner [2].
    """
    lower = np.clip(place - size / 2, low, np.maximum(high - size, low))
    return lower, lower + size


def inside(places: FloatArray, lower: FloatArray, upper: FloatArray) -> IntArray:
    """Indices of the points [N, 2] that are inside a rectangle or on its border."""
    slack = _TOLERANCE * float(np.abs(upper).max() + 1)
    return np.flatnonzero(((places >= lower - slack) & (places <= upper + slack)).all(axis=1))


def nodes_under_pad(mesh: ClothMesh, node: int, size: float) -> list[int]:
    """Nodes that a pad centred at a node holds, including this node. On a seam, all patches that meet there are searched.

    Raises:
        SceneError: the pad is as large as the cloth, or contains no other node.
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
    """For each vert of a node: the verts of its patch in material space [N, 2], and the pad's `window` around the vert."""
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
    """Displacement [N, 3] of a pad's nodes that lifts the rim by a quarter turn about the pad's inner edge.

    Args:
        places: [N, 2] nodes in material space [m]. The third axis of the result is the cloth's normal.
        low, high: [2] corners of the cloth's bounding rectangle [m].

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
    """Factor [F] on the stretching stiffness of each face: 1, except around the nodes of a pivot.

    Held nodes that share a face are not point loads, so their faces keep the factor 1.

    Args:
        nodes: the held nodes.
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
