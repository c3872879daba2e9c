"""Read and write Wavefront OBJ files as ARCSim defines them: `v` is a node, `vt` a vert in material space."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from diffcloud.errors import MeshError
from diffcloud.io.files import write_bytes, write_text
from diffcloud.io.inputs import read_input, read_text
from diffcloud.io.numbers import number, whole
from diffcloud.mesh.topology import ClothMesh, SurfaceMesh

_MOST_CORNERS = 100
"""Largest number of corners of a polygon. The triangulation compares all fans, which is slow for many corners."""
_MOST_BYTES = 100_000_000
_MOST_STRETCH = 1.5
"""Largest accepted stretch from material space to the nodes. The published jacket has 1.44 in the median face."""
STRETCHED = 1.1
"""A hanging cloth may stretch by up to this factor. A larger stretch gives a warning."""
_IGNORED = {"#", "mtllib", "usemtl", "o", "g", "s", "vn", "l"}


@dataclass
class _ObjFile:
    nodes: list[list[float]] = field(default_factory=list)
    verts: list[list[float]] = field(default_factory=list)
    polygons: list[list[tuple[int, int]]] = field(default_factory=list)
    """Corners (node, vert), with indices from 0. vert is -1 if the file gives none."""


def read_cloth(path: Path) -> ClothMesh:
    """Read a cloth: nodes from `v`, rest shape from `vt`. Seams are kept, that is, a node may have several verts.

    `vt` is the flat rest shape in the unit of `v`, not the texture coordinates of an image. A corner without `vt` takes
    the node's first vert, or a new one at (x, y) of the node.

    Raises:
        MeshError: a line or index is invalid, or the mesh cannot be simulated. Also if edge lengths in the rest shape
            and between the nodes differ by more than a factor of 1.5.
    """
    obj = _parse(path)
    verts = list(obj.verts)
    node_of_vert = np.full(len(verts), -1, dtype=np.int64)
    first_vert: dict[int, int] = {}
    for node, vert in (corner for polygon in obj.polygons for corner in polygon):
        if vert >= 0:
            if node_of_vert[vert] not in (-1, node):
                raise MeshError(
                    f"{path}: vt {vert + 1} is shared by nodes {node_of_vert[vert] + 1} and {node + 1}; "
                    "a material-space vert belongs to one node."
                )
            node_of_vert[vert] = node
            first_vert.setdefault(node, vert)
    owners = node_of_vert.tolist()
    faces = []
    for polygon in obj.polygons:
        corners = []
        for node, vert in polygon:
            if vert < 0 and node not in first_vert:
                first_vert[node] = len(verts)
                verts.append(obj.nodes[node][:2])
                owners.append(node)
            corners.append(vert if vert >= 0 else first_vert[node])
        faces += _fan(corners, np.array([obj.nodes[node] for node, _ in polygon]))
    used = np.array(owners, dtype=np.int64) >= 0
    renumber = np.cumsum(used) - 1
    try:
        mesh = ClothMesh(
            nodes=np.array(obj.nodes, dtype=np.float64).reshape(-1, 3),
            verts=np.array(verts, dtype=np.float64).reshape(-1, 2)[used],
            vert_node=np.array(owners, dtype=np.int64)[used],
            face_verts=renumber[np.array(faces, dtype=np.int64).reshape(-1, 3)],
        )
        factor, message = other_lengths(mesh)
        if factor > _MOST_STRETCH:
            raise MeshError(message)
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    return mesh


def other_lengths(mesh: ClothMesh) -> tuple[float, str]:
    """Compare the lengths between the nodes with the rest shape. Return a stretch factor and advice to the user.

    The factor is the larger of the median principal stretches (or their inverses) over all faces. It is at least 1.
    """
    corner = mesh.nodes[mesh.faces]
    edges = np.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=-1)  # [F, 3, 2]
    gradient = edges @ np.linalg.inv(mesh.material_edges)
    metric = np.swapaxes(gradient, 1, 2) @ gradient
    stretch = np.median(np.sqrt(np.maximum(np.linalg.eigvalsh(metric), 0)), axis=0)
    factor = float(np.maximum(stretch, 1 / np.maximum(stretch, 1e-9)).max())
    along = np.median(np.sqrt(metric[:, [0, 1], [0, 1]]), axis=0)
    area = 0.5 * np.linalg.norm(np.cross(edges[..., 0], edges[..., 1]), axis=-1).sum()
    return factor, (
        f"the material space (vt) has {mesh.face_area.sum():.3g} m², the faces between the nodes (v) have {area:.3g} m²; "
        "vt looks like texture coordinates of a picture. It must be the flat rest shape in the unit of v, which a cloth "
        f"that hangs stretches by some per cent. Scale u by {along[0]:.3g} and v by {along[1]:.3g} if the whole cloth is "
        "drawn to one scale, or unfold it again in real size."
    )


def read_surface(path: Path) -> SurfaceMesh:
    """Read the triangle mesh of an obstacle. Its `vt` lines are ignored.

    Raises:
        MeshError: a line is not readable, an index is out of range, or there are no faces.
    """
    obj = _parse(path)
    faces = []
    for polygon in obj.polygons:
        corners = [node for node, _ in polygon]
        faces += _fan(corners, np.array([obj.nodes[node] for node in corners]))
    if not faces:
        raise MeshError(f"{path}: the mesh has no faces.")
    return SurfaceMesh(nodes=np.array(obj.nodes, dtype=np.float64), faces=np.array(faces, dtype=np.int64))


def write_cloth(path: Path, mesh: ClothMesh, nodes: np.ndarray | None = None) -> None:
    """Write a cloth with its material space. `nodes` [V, 3] replaces the node positions. Floats keep all digits."""
    positions = mesh.nodes if nodes is None else nodes
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(positions, dtype=np.float64).tolist()]
    lines += [f"vt {u!r} {v!r}" for u, v in mesh.verts.tolist()]
    corners = np.stack([mesh.faces, mesh.face_verts], axis=-1) + 1
    lines += ["f " + " ".join(f"{node}/{vert}" for node, vert in face) for face in corners.tolist()]
    write_text(path, "\n".join(lines) + "\n")


def write_surface(path: Path, mesh: SurfaceMesh) -> None:
    """Write a triangle mesh without material space. Floats keep all digits."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.nodes.tolist()]
    lines += ["f " + " ".join(str(node) for node in face) for face in (mesh.faces + 1).tolist()]
    write_text(path, "\n".join(lines) + "\n")


def copy_mesh(path: Path, target: Path) -> None:
    """Copy a mesh file.

    Raises:
        MeshError: the file cannot be read, or is too large.
    """
    write_bytes(target, read_input(path, kind="mesh", error=MeshError, most_bytes=_MOST_BYTES))


def _parse(path: Path) -> _ObjFile:
    obj = _ObjFile()
    text = read_text(path, kind="mesh", error=MeshError, most_bytes=_MOST_BYTES)
    for row, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0] in _IGNORED or words[0].startswith("#"):
            continue
        try:
            if words[0] == "v":
                obj.nodes.append([number(word) for word in words[1:4]])
                if len(obj.nodes[-1]) != 3:
                    raise ValueError("a node has three coordinates")
            elif words[0] == "vt":
                obj.verts.append([number(word) for word in words[1:3]])
                if len(obj.verts[-1]) != 2:
                    raise ValueError("a material-space vert has two coordinates")
            elif words[0] == "f":
                obj.polygons.append([_corner(word) for word in words[1:]])
                if len(obj.polygons[-1]) < 3:
                    raise ValueError("a face has at least three corners")
                if len(obj.polygons[-1]) > _MOST_CORNERS:
                    raise ValueError(f"a face has at most {_MOST_CORNERS} corners here; triangulate it")
            else:
                raise ValueError(f"unsupported keyword {words[0]!r}")
        except ValueError as error:
            raise MeshError(f"{path}, line {row}: {error}.") from error
    for polygon in obj.polygons:
        for node, vert in polygon:
            if not 0 <= node < len(obj.nodes) or vert >= len(obj.verts):
                raise MeshError(
                    f"{path}: a face refers to v {node + 1} / vt {vert + 1}, but the file has {len(obj.nodes)} v and "
                    f"{len(obj.verts)} vt."
                )
    return obj


def _corner(word: str) -> tuple[int, int]:
    parts = word.split("/")
    node = whole(parts[0])
    vert = whole(parts[1]) if len(parts) > 1 and parts[1] else 0
    if node < 1 or vert < 0:
        raise ValueError(f"index {word!r}: indices start at 1, relative ones are not supported")
    return node - 1, vert - 1


def _fan(corners: list[int], positions: np.ndarray) -> list[list[int]]:
    """Triangulate a polygon as a fan. The fan with the largest minimum angle is chosen, the first one in a tie."""
    count = len(corners)
    if count == 3:
        return [corners]
    fans = [[[s, (s + k) % count, (s + k + 1) % count] for k in range(1, count - 1)] for s in range(count)]
    quality = [min(_smallest_angle(positions[triangle]) for triangle in fan) for fan in fans]
    best = next(s for s in range(count) if quality[s] >= max(quality) - 1e-9)
    return [[corners[index] for index in triangle] for triangle in fans[best]]


def _smallest_angle(triangle: np.ndarray) -> float:
    forward = np.roll(triangle, -1, axis=0) - triangle
    backward = np.roll(triangle, 1, axis=0) - triangle
    scale = np.linalg.norm(forward, axis=1) * np.linalg.norm(backward, axis=1)
    cosine = (forward * backward).sum(axis=1) / np.maximum(scale, 1e-300)
    return float(np.arccos(np.clip(cosine, -1, 1)).min())
