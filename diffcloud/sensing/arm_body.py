"""Realistic arm surfaces for rendering, which differ from the robot model: rounder, slightly larger, with a cable.
Masks are made from the robot model. Rendering the same model would make them look too good."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull

from diffcloud.errors import RobotError
from diffcloud.io.urdf import LinkMesh, joined
from diffcloud.mesh.shapes import cylinder_surface
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.sensing.cameras import transform
from diffcloud.sensing.masking import offset
from diffcloud.sensing.robot import Robot

Floats = NDArray[np.float64]

_ROUNDING = 0.3
"""Radius of rounded edges, as a fraction of a body's smallest extent."""
_LARGEST_ROUNDING_M = 0.006
_CABLE_RADIUS_M = 0.003
_CABLE_SIDES = 8
_GEN3_CABLE = (
    ("half_arm_1_link", (0.053, -0.06, -0.0075)),
    ("half_arm_1_link", (0.053, -0.18, -0.0075)),
    ("half_arm_2_link", (0.052, 0.0, -0.05)),
    ("half_arm_2_link", (0.052, 0.0, -0.17)),
    ("forearm_link", (0.051, -0.05, -0.0115)),
    ("forearm_link", (0.051, -0.18, -0.0115)),
    ("spherical_wrist_1_link", (0.041, 0.0, -0.05)),
    ("spherical_wrist_2_link", (0.041, -0.06, 0.0)),
    ("bracelet_link", (0.043, 0.0, -0.033)),
    ("robotiq_arg2f_base_link", (0.042, 0.0, 0.03)),
)
"""Fixing points of the cable: (link, position in its frame)."""


def lookalike(robot: Robot, rng: np.random.Generator, *, largest_growth_m: float = 0.003) -> Robot:
    """Return the robot with every convex part of its links rounded at the edges and grown by up to `largest_growth_m`.
    Each part is moved inwards by the rounding radius, then expanded by a ball of radius rounding plus growth. The
    growth of each part is random."""
    meshes = {
        name: joined([_rounded(part, rng.uniform(0.0, largest_growth_m)) for part in _parts(mesh)])
        for name, mesh in robot.description.meshes.items()
    }
    return Robot(replace(robot.description, meshes=meshes), robot.tool)


def cable(robot: Robot, poses: Floats) -> SurfaceMesh:
    """Return the cable of a Gen3 with a 2F-85, fixed to its links, in the world.

    Args:
        poses: [L, 4, 4] T_world_link.

    Raises:
        RobotError: the robot lacks a link to which the cable is fixed.
    """
    missing = sorted({link for link, _ in _GEN3_CABLE} - set(robot.links))
    if missing:
        raise RobotError(f"{robot.description.name} has no links {missing}; the cable is that of a Gen3 with a 2F-85.")
    ties = np.stack([transform(poses[robot.links.index(link)], np.array([place]))[0] for link, place in _GEN3_CABLE])
    pieces = [cylinder_surface(a.tolist(), b.tolist(), _CABLE_RADIUS_M, _CABLE_SIDES) for a, b in pairwise(ties)]
    whole = joined([LinkMesh(piece.nodes, piece.faces) for piece in pieces])
    return SurfaceMesh(whole.vertices, whole.faces)


def _parts(mesh: LinkMesh) -> Iterator[LinkMesh]:
    """Yield the connected parts of a mesh."""
    count = len(mesh.vertices)
    ends = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    for part in np.unique(label[mesh.faces[:, 0]]):  # a handful per link
        faces = mesh.faces[label[mesh.faces[:, 0]] == part]
        used, place = np.unique(faces, return_inverse=True)
        yield LinkMesh(mesh.vertices[used], place.reshape(faces.shape))


def _rounded(part: LinkMesh, growth_m: float) -> LinkMesh:
    radius = min(_ROUNDING * float(np.ptp(part.vertices, axis=0).min()), _LARGEST_ROUNDING_M)
    inside = offset(part, -radius).vertices
    ball = _ball() * (radius + growth_m)
    corners = inside[ConvexHull(inside).vertices]
    cloud = (corners[:, None] + ball[None]).reshape(-1, 3)
    hull = ConvexHull(cloud)
    used, faces = np.unique(hull.simplices, return_inverse=True)
    return LinkMesh(cloud[used], faces.reshape(-1, 3))


def _ball() -> Floats:
    """Return 42 evenly spread unit vectors [42, 3]."""
    index = np.arange(42) + 0.5
    z, turn = 1 - 2 * index / 42, np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - z**2)
    return np.column_stack([ring * np.cos(turn), ring * np.sin(turn), z])
