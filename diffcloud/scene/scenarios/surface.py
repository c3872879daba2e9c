"""A cloth of any shape, from a triangle mesh: flat on a table, or hanging at rest from its grippers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from diffcloud.errors import DivergedError, MeshError, SceneError
from diffcloud.io.obj import read_surface
from diffcloud.io.schema import Checked, NonNegative
from diffcloud.mesh.shapes import rectangle_surface
from diffcloud.mesh.simplified import cloth_of, corners_of, lines, simplified, topology
from diffcloud.mesh.topology import SurfaceMesh, directed_edges
from diffcloud.scene.scenarios.grid import GridScenario
from diffcloud.scene.scenarios.hang import settled
from diffcloud.scene.scenarios.options import (
    Coordinate,
    Keyframes,
    Length,
    Regrip,
    ScenarioOptions,
    assemble,
    resting_height,
    sunk,
)
from diffcloud.scene.scenarios.scenario import Scenario
from diffcloud.sim.grasp import GRIP_M, Grasp

Floats = NDArray[np.float64]
Point = tuple[Coordinate, Coordinate, Coordinate]

_FINER = 5 / 3
"""Factor of the wanted number of nodes, above which a mesh is simplified."""
_LARGEST_M = 5.0
_THICK_M = 0.05
"""Largest thickness of a mesh that lies flat on the table."""
_BESIDE = (0.07, 0.03)
"""Barycentric coordinates of a point beside a node."""
_UNEVEN_M = 1e-3
"""Standard deviation [m] of noise on a hanging cloth before it settles. Without, it would stay in an unstable plane."""


class Hold(Checked):
    """What one gripper holds."""

    on_mesh_m: Point
    """Point of the grasp, in the coordinates of the mesh file."""
    at_m: Point | None = None
    """Where a hanging cloth is held, in the world."""
    path: Keyframes | None = None
    """Displacement of this gripper. Default: the scenario's `path`."""


class MeshScenario(ScenarioOptions):
    """A cloth in the shape of a triangle mesh, at rest in that shape. A YAML file may set every field (SI units)."""

    mesh: str
    """Path of the OBJ file: positions `v` [m] and faces `f`. Texture coordinates are not used."""
    nodes: Annotated[int, Field(ge=20, le=2000)] = 300
    """Number of nodes to which a mesh is simplified if it has more than 5/3 of them."""
    start: Literal["flat", "hang"] = "flat"
    grippers: dict[str, Hold] = Field(default_factory=dict)
    path: Keyframes = Field(default_factory=lambda: [(0.0, 0.0, 0.0, 0.0), (2.5, 0.0, 0.0, 0.3)])
    up: Literal["front", "back"] = "front"
    """Face that is up on the table: front, or back (turned over about the mesh's x axis)."""
    center_m: tuple[Coordinate, Coordinate] = (0.0, 0.0)
    """Position of the cloth's centre of area on the table."""
    yaw_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    """Rotation about the vertical."""
    table_height_m: Coordinate = 0.0
    gap_m: NonNegative = GridScenario.model_fields["gap_m"].default
    """Initial height of the lowest layer's mid-surface above the table."""
    grip: Literal["pad", "pivot"] = "pad"
    """Type of each grasp: a level pad with fixed orientation, or a point that lets the cloth rotate."""
    grip_m: Length = GRIP_M
    """Side of the pad, or of the square that a pivot represents."""
    grip_known_within: Annotated[float, Field(ge=1, le=3)] = 1.0
    """Standard deviation of `grip_m`, as a factor. With 1, `grip_m` is exact. Fits by `likelihood` take it into account."""

    @property
    def own_paths(self) -> Mapping[str, Keyframes]:
        return {name: one.path for name, one in self.grippers.items() if one.path is not None}


def mesh_scenario(options: MeshScenario) -> Scenario:
    """Return the scenario.

    Raises:
        MeshError: the file is not readable, or its mesh cannot be a cloth.
        SceneError: the mesh is too thick to lie flat, a hanging cloth has no place or does not come to rest, or two
            grippers hold the same nodes.
    """
    if not options.grippers:
        raise SceneError(f"Scenario {options.name}: no gripper holds the cloth. Give `grippers`, each with `on_mesh_m`.")
    rest = read_mesh(Path(options.mesh), options.nodes)
    held = dict[str, list[int]]()
    for name, one in options.grippers.items():
        point = np.array(one.on_mesh_m)
        if options.grip == "pivot":
            held[name] = [int(np.linalg.norm(rest.nodes - point, axis=1).argmin())]
        else:
            rest, held[name] = under_pad(rest, point, options.grip_m)
    nodes = _hanging(options, rest, held) if options.start == "hang" else _flat(options, rest)
    extent = 2.0 * float(np.ptp(rest.nodes, axis=0).max()) + options.reach
    table = rectangle_surface(options.center_m, (extent, extent), options.table_height_m - sunk(options, options.gap_m))
    scenario = assemble(
        options,
        replace(cloth_of(rest), nodes=nodes),
        () if options.start == "hang" else (table,),
        grippers=held,
        grasp=Grasp(options.grip, options.grip_m),
        pads=None
        if options.grip == "pivot"
        else {node: number for number, each in enumerate(held.values(), 1) for node in each},
    )
    regrip = Regrip(mesh_scenario, options) if options.grip_known_within > 1 else None
    scenario = replace(scenario, regrip=regrip)
    if options.start == "flat":
        return scenario
    try:
        nodes = settled(scenario.scene)
    except DivergedError as error:
        raise SceneError(f"Scenario {options.name}: the hanging cloth does not come to rest: {error}") from error
    return replace(scenario, scene=replace(scenario.scene, mesh=replace(scenario.scene.mesh, nodes=nodes)))


def read_mesh(path: Path, count: int) -> SurfaceMesh:
    """Read a cloth's mesh. One of more than 5/3 `count` nodes is simplified to about `count`.

    Raises:
        MeshError: the file is not readable, is not in metres, or is not one manifold part.
    """
    return _read(path, path.stat().st_mtime_ns if path.is_file() else 0, count)


@cache
def _read(path: Path, changed: int, count: int) -> SurfaceMesh:
    found = read_surface(path)
    extent = float(np.ptp(found.nodes[found.faces].reshape(-1, 3), axis=0).max())
    if not 0 < extent < _LARGEST_M:
        raise MeshError(
            f"{path} is {extent:.3g} across. Meshes are in metres, and a cloth is at most {_LARGEST_M:g} m. Export it in "
            "metres."
        )
    used, faces = np.unique(found.faces, return_inverse=True)
    found = SurfaceMesh(found.nodes[used], faces.reshape(-1, 3))
    parts, _, irregular, _ = topology(found)
    if parts > 1 or irregular:
        raise MeshError(
            f"{path} has {parts} separate parts and {irregular} edges where faces do not continue each other. A cloth is "
            "one part, in which each edge has one or two faces of the same orientation. Join vertices at seams and make "
            "normals consistent (in Blender: Merge by Distance, Recalculate Outside)."
        )
    try:
        cloth_of(found)  # checks the faces
        return simplified(found, count) if len(used) > _FINER * count else found
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error


def level_frame(nodes: Floats, faces: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Return the rotation [3, 3] for column vectors that lays a mesh flat, front up, and its centre of area [3].

    The front is the side in the direction of the mesh's positive axis that is nearest to the normal. A mesh in the plane
    z = 0 is not rotated.
    """
    corner = nodes[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    centre = (corner.mean(axis=1) * area[:, None]).sum(axis=0) / area.sum()
    _, axes = np.linalg.eigh(np.cov((corner.mean(axis=1) - centre).T, aweights=area))
    up = axes[:, 0] * np.sign(axes[np.abs(axes[:, 0]).argmax(), 0])
    side = np.eye(3)[1 if np.abs(up[0]) > np.sqrt(0.5) else 0]  # the axis that stays x, unless it becomes vertical
    x = side - up * (side @ up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up]), centre


def flat_points(points: Floats, frame: tuple[Floats, Floats], up: str, yaw: float) -> Floats:
    """Return mesh points [N, 3] placed flat about the origin, with rotation `yaw` [rad] about the vertical."""
    rotation, centre = frame
    flat = (points - centre) @ rotation.T
    if up == "back":
        flat = flat * [1, -1, -1]
    return np.asarray(flat @ about_vertical(yaw))


def about_vertical(yaw: float) -> Floats:
    """Return the matrix [3, 3] that rotates row vectors by `yaw` [rad] about the vertical."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])


def _flat(options: MeshScenario, rest: SurfaceMesh) -> Floats:
    """Return the nodes [V, 3] on the table, its layers above each other."""
    flat = flat_points(rest.nodes, level_frame(rest.nodes, rest.faces), options.up, float(np.deg2rad(options.yaw_deg)))
    thick = float(np.ptp(flat[:, 2]))
    if thick > _THICK_M:
        raise SceneError(
            f"Scenario {options.name}: the mesh {options.mesh} is {1e3 * thick:.0f} mm thick; at most {1e3 * _THICK_M:.0f} "
            "mm are allowed for a cloth that lies on a table. Lay the garment flat in the program that made the mesh."
        )
    height = options.table_height_m + options.gap_m + layers(flat, rest.faces) * resting_height(options)
    return np.column_stack([flat[:, :2] + options.center_m, height])


def layers(nodes: Floats, faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return how many layers of a flat mesh lie below each node [V, 3]. Layers at the same height are ordered by the
    direction of their normals, which point outwards."""
    corner = nodes[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2]
    tilt = np.bincount(faces.ravel(), np.repeat(normal, 3), len(nodes))
    a, b, c = corner[:, None, 0], corner[:, None, 1], corner[:, None, 2]  # [F, 1, 3]

    def twice_area(p: Floats, q: Floats, r: Floats) -> Floats:
        return np.asarray(
            (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])
        )

    whole = twice_area(a, b, c)
    # a point beside each node, inside one of its faces: it is inside the outline, and hardly above an edge
    order = np.argsort(faces.ravel(), kind="stable")
    first = order[np.searchsorted(faces.ravel()[order], np.arange(len(nodes)))]
    others = [faces[first // 3, (first % 3 + turn) % 3] for turn in (1, 2)]
    point = (nodes + sum(share * (nodes[one] - nodes) for share, one in zip(_BESIDE, others, strict=True)))[None]
    weights = np.stack([twice_area(point, b, c), twice_area(a, point, c), twice_area(a, b, point)], -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        weights = weights / whole[..., None]  # [F, V, 3]
    inside = np.asarray((weights >= 0).all(axis=-1))
    inside[np.repeat(np.arange(len(faces)), 3), faces.ravel()] = False
    below = np.einsum("fvi,fi->fv", np.where(inside[..., None], weights, 0.0), corner[..., 2]) - nodes[:, 2]
    same = np.abs(below) < 1e-6
    lower = np.where(same, np.sign(normal)[:, None] < np.sign(tilt), below < 0)
    return np.asarray((inside & lower).sum(axis=0))


def _hanging(options: MeshScenario, rest: SurfaceMesh, held: Mapping[str, list[int]]) -> Floats:
    """Return the nodes [V, 3] before settling: the mesh turned such that its centre hangs below what is held."""
    places = [one.at_m for one in options.grippers.values()]
    if None in places or len(places) > 2:
        raise SceneError(
            f"Scenario {options.name}: a hanging cloth has one or two grippers, and each needs `at_m`, its place in the "
            f"world; got {len(places)} grippers."
        )
    at = np.array(places, dtype=np.float64)
    own = np.array([rest.nodes[each].mean(axis=0) for each in held.values()])
    yaw = np.deg2rad(options.yaw_deg)
    if len(at) == 2:
        across, taken = at[1] - at[0], own[1] - own[0]
    else:
        across, taken = np.array([np.cos(yaw), np.sin(yaw), 0.0]), level_frame(rest.nodes, rest.faces)[0][0]
    frames = []
    _, centre = level_frame(rest.nodes, rest.faces)
    for along, down in ((taken, centre - own.mean(axis=0)), (across, np.array([0.0, 0.0, -1.0]))):
        if len(at) == 2:
            first = along / np.linalg.norm(along)
            second = down - first * (first @ down)
            second /= np.linalg.norm(second)
        else:
            second = down / np.linalg.norm(down)
            first = along - second * (second @ along)
            if np.linalg.norm(first) < 1e-3 * np.linalg.norm(along):
                first = np.cross(second, np.eye(3)[np.abs(second).argmin()])
            first /= np.linalg.norm(first)
        frames.append(np.stack([first, second, np.cross(first, second)]))
    local = (rest.nodes - own.mean(axis=0)) @ frames[0].T
    local += np.random.default_rng(0).normal(0.0, _UNEVEN_M, local.shape)
    if len(at) == 2 and (span := float(np.linalg.norm(across) / np.linalg.norm(taken))) < 1:
        length = float(np.linalg.norm(taken))
        bow = 2 / np.pi * span * length * np.sqrt(1 / span - 1)  # a sine of about the chord's length, as in `hang`
        local[:, 2] += bow * np.cos(np.pi * np.clip(local[:, 0] / length, -0.5, 0.5)) * (1 if options.up == "front" else -1)
        local[:, 0] *= span
    nodes = local @ frames[1] + at.mean(axis=0)
    for place, each in zip(at, held.values(), strict=True):
        nodes[each] += place - nodes[each].mean(axis=0)
    return np.asarray(nodes)


def under_pad(surface: SurfaceMesh, point: Floats, size: float) -> tuple[SurfaceMesh, list[int]]:
    """Return the mesh with faces that fit a pad, and the nodes [K] that it holds.

    In each layer under the pad, the faces nearest to the point whose area is about that of the pad are held. They are
    scaled to this area, so the size of the grasp does not depend on the mesh. Outline, creases and corners are kept.

    Args:
        point: [3] middle of the pad [m].
        size: side of the pad [m].
    """
    from trimesh.triangles import closest_point  # slow to import

    nodes, faces = surface.nodes.copy(), surface.faces
    corner = nodes[faces]
    nearest = closest_point(corner, np.broadcast_to(point, (len(faces), 3)))
    away = np.linalg.norm(nearest - point, axis=1)
    place = nearest[away.argmin()]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2
    feature = lines(surface)
    on_line, corners = np.unique(feature), corners_of(nodes, feature)
    edges, sides = directed_edges(faces)
    smooth = ~np.isin(edges @ [len(nodes), 1], np.sort(feature @ [len(nodes), 1])) & (sides >= 0).all(axis=1)
    near = np.linalg.norm(closest_point(corner, np.broadcast_to(place, corner[:, 0].shape)) - place, axis=1) < size / 2
    joined = sides[smooth & near[np.maximum(sides, 0)].all(axis=1)]
    layer = connected_components(
        coo_array((np.ones(len(joined)), joined.T), shape=(len(faces),) * 2).tocsr(), directed=False
    )[1]
    held = np.zeros(0, dtype=np.int64)
    for number in np.unique(layer[near]):
        own = np.flatnonzero(near & (layer == number))
        own = own[np.linalg.norm(corner[own].mean(axis=1) - place, axis=1).argsort()]
        sums = np.cumsum(area[own])
        taken = own[: int(np.abs(np.log(sums / size**2)).argmin()) + 1]
        members = np.unique(faces[taken])
        factor = size / np.sqrt(area[taken].sum())
        turning, bound = np.intersect1d(members, corners), np.intersect1d(members, on_line)
        middle, target = place, place
        if len(turning):
            middle = target = nodes[turning[np.linalg.norm(nodes[turning] - place, axis=1).argmin()]]
        elif len(bound) == 1:
            middle = target = nodes[bound[0]]
        elif len(bound):
            start, way = nodes[bound[0]], nodes[bound[1]] - nodes[bound[0]]
            middle = nodes[bound].mean(axis=0)
            target = start + way * float(np.clip((place - start) @ way / (way @ way), 0, 1))
        else:
            middle = nodes[members].mean(axis=0)
        free = np.setdiff1d(members, np.concatenate([turning, held]))
        for origin, end in ((middle, target), (target, target)):
            moved = nodes.copy()
            moved[free] = end + factor * (nodes[free] - origin)
            if _keeps_faces(nodes, moved, faces):
                nodes = moved
                break
        held = np.union1d(held, members)
    return SurfaceMesh(nodes, faces), held.tolist()


def _keeps_faces(before: Floats, after: Floats, faces: NDArray[np.int64]) -> bool:
    """Whether no face is turned over, or shrinks to a tenth of its area."""
    first, second = (
        np.cross(nodes[faces[:, 1]] - nodes[faces[:, 0]], nodes[faces[:, 2]] - nodes[faces[:, 0]])
        for nodes in (before, after)
    )
    return bool(((first * second).sum(axis=1) > 0.1 * (first**2).sum(axis=1)).all())
