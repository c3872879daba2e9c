"""Procedural meshes of cloths and obstacles."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import MeshError
from diffcloud.mesh.topology import ClothMesh, FloatArray, IntArray, SurfaceMesh

_ARC_SAMPLES = 2001
"""Samples for the arc length of a quarter ellipse; its relative error is then below 1e-6."""


def grid_cloth(rows: int, columns: int, height: float, width: float, *, through: int = 0) -> ClothMesh:
    """A flat rectangular cloth in the plane z = 0, centred at the origin. Its rest shape equals its initial shape.

    Node (i, j) has index i·columns + j. i increases along +y (and material v), j along +x (and material u). Diagonals
    alternate, so bending depends less on direction than with parallel diagonals.

    Args:
        rows, columns: node counts, at least 2 each.
        height, width: extent along y and x [m], positive.
        through: index of a node where diagonals meet. They meet at every second node.

    Raises:
        MeshError: fewer than 2 nodes per side, or a size that is not positive.
    """
    if rows < 2 or columns < 2:
        raise MeshError(f"A grid cloth needs at least 2 x 2 nodes, got {rows} x {columns}.")
    if not (height > 0 and width > 0):
        raise MeshError(f"A grid cloth needs a positive size in metres, got {height} x {width}.")
    return lined_cloth(np.linspace(0, width, columns), np.linspace(0, height, rows), through=through)


def lined_cloth(across: FloatArray, along: FloatArray, *, through: int = 0) -> ClothMesh:
    """A cloth like `grid_cloth`, with grid lines at given positions.

    Args:
        across: [columns] positions of the lines along x, ascending from 0 to the width [m].
        along: [rows] positions of the lines along y, ascending from 0 to the height [m].
        through: index of a node where diagonals meet.
    """
    v, u = np.meshgrid(along, across, indexing="ij")
    verts = np.stack([u.ravel(), v.ravel()], axis=1)
    nodes = np.column_stack([verts - verts[-1] / 2, np.zeros(len(verts))])
    faces = _grid_faces(len(along), len(across), through)
    return ClothMesh(nodes=nodes, verts=verts, vert_node=np.arange(len(verts)), face_verts=faces)


def loop_cloth(rows: int, columns: int, width: float, circumference: float, end_radius: float | None = None) -> ClothMesh:
    """A closed band that stands upright around the z axis, centred at the origin.

    Material space is the unrolled strip: u runs along the band (counter-clockwise from above), v upwards. Node (i, j) has
    index i·columns + j. i increases upwards, j along the band from its point at -y. At the closing seam (j = 0), each node
    has two verts. Faces are counter-clockwise seen from outside.

    Args:
        rows: number of nodes across the band, at least 2.
        columns: number of nodes along the band, at least 3.
        width: across the band [m].
        circumference: along the band [m].
        end_radius: radius of the two half circles at -y and +y, which straight lines join [m]. None: one circle. In curved
            parts the initial edges are chords, slightly shorter than at rest.

    Raises:
        MeshError: too few nodes, a size that is not positive, or a radius too large for the circumference.
    """
    if rows < 2 or columns < 3:
        raise MeshError(f"A loop needs at least 2 nodes across and 3 along, got {rows} and {columns}.")
    if not (width > 0 and circumference > 0):
        raise MeshError(f"A loop needs a positive width and circumference in metres, got {width} and {circumference}.")
    round_radius = circumference / (2 * np.pi)
    radius = round_radius if end_radius is None else end_radius
    if not 0 < radius <= round_radius:
        raise MeshError(f"A loop of {circumference} m allows end radii up to {round_radius:.4g} m, got {radius}.")
    v, u = np.meshgrid(np.linspace(0, width, rows), np.linspace(0, circumference, columns + 1), indexing="ij")
    ring = _stadium(circumference * np.arange(columns) / columns, circumference, radius)
    height = np.linspace(-width / 2, width / 2, rows)
    nodes = np.column_stack([np.tile(ring, (rows, 1)), np.repeat(height, columns)])
    return ClothMesh(
        nodes=nodes,
        verts=np.stack([u.ravel(), v.ravel()], axis=1),
        vert_node=(np.arange(rows)[:, None] * columns + np.arange(columns + 1) % columns).ravel(),
        face_verts=_grid_faces(rows, columns + 1, through=1),
    )


def _stadium(along: FloatArray, circumference: float, radius: float) -> FloatArray:
    """Points [N, 2] at distances [N] along a stadium, counter-clockwise from its lowest point."""
    straight = (circumference - 2 * np.pi * radius) / 2
    quarter = np.pi * radius / 2
    past = along[:, None] - np.cumsum([0, quarter, straight, 2 * quarter, straight])
    turn = np.clip(past, 0, [quarter, straight, 2 * quarter, straight, quarter])  # covered length of each of the five parts
    angle = -np.pi / 2 + (turn[:, 0] + turn[:, 2] + turn[:, 4]) / radius
    centre = -straight / 2 + turn[:, 1] - turn[:, 3]
    # Counter-clockwise, the right side runs up and the left side down.
    return np.stack([radius * np.cos(angle), centre + radius * np.sin(angle)], axis=1)


_VEST_UP = np.array([0.0, 0.2, 0.4, 0.58, 0.72, 0.86, 1.0])
"""Rows of a vest's panel, relative to its height: hem, side seam up to the armpit (0.58), chest, strap, shoulder."""
_VEST_ACROSS = np.array(
    [
        *[[-1.0, -2 / 3, -1 / 3, 0.0, 1 / 3, 2 / 3, 1.0]] * 4,
        [-0.84, -0.6, -0.36, 0.0, 0.36, 0.6, 0.84],
        [-0.76, -0.57, -0.38, 0.0, 0.38, 0.57, 0.76],
        [-0.76, -0.58, -0.4, 0.0, 0.4, 0.58, 0.76],
    ]
)
"""[row, column] positions relative to half the width. Above the armpits, the outer columns are the edge of the armholes."""
_NECK_COLUMN, _CHEST_ROW = 3, 4
"""The middle column ends at the chest, because the neck opening is above it."""
_NECK_BOTTOM = {"front": 0.65, "back": 0.7}
"""Lowest point of the neck opening, relative to the height."""
_LEAN = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.55, 0.0])
"""Distance of each row from the middle plane, relative to that of the ellipse. The straps meet at the shoulder."""
_ARMPIT_ROW, _SHOULDER_ROW = 3, 6


def vest_cloth(width: float, height: float, depth: float) -> ClothMesh:
    """A sleeveless vest of 80 nodes: two panels, joined by seams at the sides and the shoulders.

    It stands upright and open. x is parallel to the shoulders, the front faces -y, and the hem is in the plane z = 0. Each
    panel is a separate patch in material space, seen from outside, the back to the right of the front. Nodes on seams have
    a vert in both. Openings: waist, neck and two arms. The cross-section is an ellipse whose half circumference is the
    panel's width. So the body is almost unstrained. The straps lean together and are slightly strained.

    Nodes are those of the front panel from the hem upwards, each row along +x. Then follow those of the back, without the
    seams.

    Args:
        width: of a flat panel [m].
        height: of a flat panel, from the hem to the shoulder [m].
        depth: half the distance between front and back, the ellipse's semi-axis along y [m].

    Raises:
        MeshError: a size is not positive, or the depth exceeds that of a circular cross-section.
    """
    if not (width > 0 and height > 0 and depth > 0):
        raise MeshError(f"A vest needs a positive width, height and depth in metres, got {width}, {height}, {depth}.")
    if depth > width / np.pi:
        raise MeshError(f"A vest {width} m wide is round at a depth of {width / np.pi:.4g} m; {depth} m is too much.")
    present = _vest_present()
    u = _VEST_ACROSS * width / 2
    x, y = _on_half_ellipse(u, depth, width)
    lean = _LEAN[:, None]
    rise = np.diff(_VEST_UP)[:, None] * height
    # A leaning strap is lower, so that its length is preserved.
    rise = np.sqrt(np.maximum(rise**2 - (y[1:] * np.diff(lean, axis=0)) ** 2, (0.5 * rise) ** 2))
    z = np.concatenate([np.zeros((1, u.shape[1])), np.cumsum(rise, axis=0)])

    def panel(which: str) -> tuple[FloatArray, FloatArray]:
        """Nodes of one panel in material space and in world space. The sign of y sets the side."""
        v = np.repeat(_VEST_UP[:, None] * height, u.shape[1], axis=1)
        drop = v[_CHEST_ROW, _NECK_COLUMN] - _NECK_BOTTOM[which] * height
        side, height_up = (-1.0 if which == "front" else 1.0), z.copy()
        v[_CHEST_ROW, _NECK_COLUMN] -= drop
        height_up[_CHEST_ROW, _NECK_COLUMN] -= drop
        material = np.stack([-side * u, v], axis=-1)  # u of the back runs along -x, since it is seen from behind
        return material[present], np.stack([x, side * y * lean, height_up], axis=-1)[present]

    front_verts, front_nodes = panel("front")
    back_verts, back_nodes = panel("back")
    seam = _vest_seam()[present]
    count = len(front_nodes)
    back_node = np.where(seam, np.arange(count), count - 1 + np.cumsum(~seam))
    faces = _vest_faces()
    return ClothMesh(
        nodes=np.concatenate([front_nodes, back_nodes[~seam]]),
        verts=np.concatenate([front_verts, back_verts]) + np.repeat([[0.5 * width, 0], [1.75 * width, 0]], count, axis=0),
        vert_node=np.concatenate([np.arange(count), back_node]),
        face_verts=np.concatenate([faces, faces[:, ::-1] + count]),
    )


def vest_shoulder(side: int) -> list[int]:
    """Nodes of `vest_cloth` on one shoulder seam, from the neck to the arm: at +x for `side` 1, at -x for -1."""
    index = np.cumsum(_vest_present()).reshape(_VEST_ACROSS.shape) - 1
    columns = [4, 5, 6] if side > 0 else [2, 1, 0]
    return [int(node) for node in index[_SHOULDER_ROW, columns]]


def rectangle_surface(center: Sequence[float], half_size: Sequence[float], height: float) -> SurfaceMesh:
    """A horizontal rectangle that faces upwards, such as a table.

    Args:
        center, half_size: (x, y) of its centre, and half its extent [m].
        height: z of the rectangle [m].
    """
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.asarray(half_size) + np.asarray(center)
    return SurfaceMesh(np.column_stack([corners, np.full(4, height)]), np.array([[0, 1, 2], [0, 2, 3]]))


def box_surface(lower: Sequence[float], upper: Sequence[float]) -> SurfaceMesh:
    """A closed axis-aligned box of 8 nodes and 12 faces, with outward normals.

    Args:
        lower, upper: corners (x, y, z) [m].

    Raises:
        MeshError: the lower corner is not below the upper one.
    """
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    if not (low < high).all():
        raise MeshError(f"A box needs its lower corner below its upper one in x, y and z, got {low} and {high}.")
    corner = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
    quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    faces = [[a, b, c] for a, b, c, _ in quads] + [[a, c, d] for a, _, c, d in quads]
    return SurfaceMesh(low + corner * (high - low), np.array(faces))


def cylinder_surface(start: Sequence[float], end: Sequence[float], radius: float, sides: int = 24) -> SurfaceMesh:
    """A closed prism with a regular polygon as cross-section, with outward normals.

    Args:
        start, end: centres of its two caps [m].
        radius: of the circle through the polygon's corners [m].
        sides: number of sides, at least 3.

    Raises:
        MeshError: fewer than 3 sides, or a length or radius that is not positive.
    """
    first, last = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    length = float(np.linalg.norm(last - first))
    if sides < 3 or not (length > 0 and radius > 0):
        raise MeshError(f"A cylinder needs 3 sides, a length and a radius, got {sides}, {length} m and {radius} m.")
    axis = (last - first) / length
    sideways = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    sideways /= np.linalg.norm(sideways)
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = radius * (np.cos(angle)[:, None] * sideways + np.sin(angle)[:, None] * np.cross(axis, sideways))
    here = np.arange(sides)
    after = np.roll(here, -1)
    bottom, top = 2 * sides, 2 * sides + 1
    faces = np.concatenate(
        [
            np.stack([here, after, after + sides], axis=1),
            np.stack([here, after + sides, here + sides], axis=1),
            np.stack([np.full(sides, bottom), after, here], axis=1),
            np.stack([np.full(sides, top), here + sides, after + sides], axis=1),
        ]
    )
    return SurfaceMesh(np.concatenate([first + ring, last + ring, [first, last]]), faces)


def sphere_surface(center: Sequence[float], radius: float, subdivisions: int = 2) -> SurfaceMesh:
    """A closed icosphere of 20 · 4^subdivisions faces, with outward normals.

    Args:
        center: (x, y, z) [m].
        radius: of the sphere through its nodes [m].
        subdivisions: how often each triangle is split into four.

    Raises:
        MeshError: a radius that is not positive, or a negative number of subdivisions.
    """
    if not radius > 0 or subdivisions < 0:
        raise MeshError(f"A sphere needs a radius and 0 or more subdivisions, got {radius} m and {subdivisions}.")
    golden = (1 + np.sqrt(5)) / 2
    rectangle = np.array([[-1, golden, 0], [1, golden, 0], [-1, -golden, 0], [1, -golden, 0]])
    nodes = np.concatenate([np.roll(rectangle, turn, axis=1) for turn in range(3)])
    nodes = nodes / np.linalg.norm(nodes[0])
    gap = np.linalg.norm(nodes[:, None] - nodes, axis=-1)
    near = np.isclose(gap, gap[gap > 0].min())
    triples = np.array(list(combinations(range(len(nodes)), 3)))
    faces = triples[near[triples, np.roll(triples, 1, axis=1)].all(axis=1)]
    for _ in range(subdivisions):
        nodes, faces = _divided(nodes, faces)
    corner = nodes[faces]
    inward = np.linalg.det(corner) < 0
    faces[inward] = faces[inward, ::-1]
    return SurfaceMesh(np.asarray(center, dtype=np.float64) + radius * nodes, faces)


def _grid_faces(rows: int, columns: int, through: int) -> IntArray:
    """Faces [2 (rows - 1)(columns - 1), 3] of a grid whose point (i, j) has index i·columns + j. Diagonals meet at the
    point `through`, and at all points an even number of cells away."""
    i, j = (index.ravel() for index in np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij"))
    a = i * columns + j
    turned = (i + j) % 2 == sum(divmod(through, columns)) % 2
    return _quad_faces(np.stack([a, a + 1, a + columns, a + columns + 1], axis=1), turned)


def _quad_faces(corners: IntArray, turned: NDArray[np.bool_]) -> IntArray:
    """Triangles [2 Q, 3] of quads [Q, 4], given as (left bottom, right bottom, left top, right top). The diagonal starts at
    the right bottom, or if `turned` at the left bottom."""
    a, b, c, d = corners.T
    first = np.where(turned[:, None], np.stack([a, b, d], axis=1), np.stack([a, b, c], axis=1))
    second = np.where(turned[:, None], np.stack([a, d, c], axis=1), np.stack([b, d, c], axis=1))
    return np.stack([first, second], axis=1).reshape(-1, 3)


def _vest_present() -> NDArray[np.bool_]:
    """[row, column] True for points of the panel's grid that are cloth."""
    present = np.ones(_VEST_ACROSS.shape, dtype=bool)
    present[_CHEST_ROW + 1 :, _NECK_COLUMN] = False
    return present


def _vest_seam() -> NDArray[np.bool_]:
    """[row, column] True for points of the panel's grid that both panels share."""
    seam = np.zeros(_VEST_ACROSS.shape, dtype=bool)
    seam[: _ARMPIT_ROW + 1, [0, -1]] = True
    seam[_SHOULDER_ROW] = True
    return seam


def _vest_faces() -> IntArray:
    """Faces of a panel over its existing points, with diagonals that are mirror-symmetric about the middle."""
    present = _vest_present()
    index = np.cumsum(present).reshape(present.shape) - 1
    whole = present[:-1, :-1] & present[:-1, 1:] & present[1:, :-1] & present[1:, 1:]
    i, j = np.nonzero(whole)
    corners = np.stack([index[i, j], index[i, j + 1], index[i + 1, j], index[i + 1, j + 1]], axis=1)
    return _quad_faces(corners, j < _NECK_COLUMN)


def _on_half_ellipse(arc: FloatArray, depth: float, length: float) -> tuple[FloatArray, FloatArray]:
    """Points (x, y >= 0) on a half ellipse with semi-axis `depth` along y and arc length `length`. `arc` is the signed arc
    length from the top of the ellipse, in ±length/2 [m]."""
    angle = np.linspace(0, np.pi / 2, _ARC_SAMPLES)

    def quarter(semi_axis: float) -> FloatArray:
        """Arc length from the top at each sampled angle."""
        speed = np.hypot(semi_axis * np.cos(angle), depth * np.sin(angle))
        return np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(angle))])

    from scipy.optimize import brentq  # slow to import, and needed by few meshes

    semi_axis = float(brentq(lambda a: quarter(a)[-1] - length / 2, 1e-3 * length, length))
    at = np.interp(np.abs(arc), quarter(semi_axis), angle)
    return np.sign(arc) * semi_axis * np.sin(at), depth * np.cos(at)


def _divided(nodes: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Split each triangle of a unit sphere into four, with the new nodes on the sphere."""
    half = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, inverse = np.unique(half, axis=0, return_inverse=True)
    middle = nodes[edges].mean(axis=1)
    ab, bc, ca = (len(nodes) + inverse.reshape(-1, 3)).T
    a, b, c = faces.T
    divided = [np.stack(f, axis=1) for f in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate([nodes, middle / np.linalg.norm(middle, axis=1, keepdims=True)]), np.concatenate(divided)
