"""Read robot descriptions (URDF): the tree of joints, and the surface mesh of each link in its own frame.

URDF files may come from untrusted sources. XML with document types or entities is refused, sizes are limited, and
meshes are read only from the URDF's folder. `package://name/path` is searched as `name/path` and as `path` in that
folder, so no ROS workspace is needed. As in ROS, the length unit in a COLLADA mesh is applied and its up axis is
ignored.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffcloud.errors import RobotError, unknown_name
from diffcloud.io.inputs import read_input

Floats = NDArray[np.float64]
JointKind = Literal["fixed", "revolute", "continuous", "prismatic"]

_LARGEST_XML = 16 * 2**20
_LARGEST_MESH = 64 * 2**20
_MESH_FORMATS = (".dae", ".obj", ".ply", ".stl")
_LARGEST_M = 10.0
"""Largest extent of a link. A larger mesh is probably in millimetres."""
_LARGEST = 1000.0
"""Largest accepted number in a URDF [m or rad]."""
_ONCE = ("origin", "geometry", "axis", "limit", "mimic", "parent", "child")


@dataclass(frozen=True)
class Mimic:
    """Coupling to another joint: angle = multiplier · angle of `joint` + offset."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Joint:
    """A joint between a parent and a child link."""

    name: str
    kind: JointKind
    parent: str
    child: str
    T_parent_joint: Floats
    """[4, 4] transform from the joint's frame to the parent's at angle 0 [m]."""
    axis: Floats
    """[3] unit vector in the joint's frame."""
    lower: float
    upper: float
    """Limits [rad or m]. Infinite if the URDF does not have them."""
    mimic: Mimic | None = None


@dataclass(frozen=True)
class LinkMesh:
    """A link's surface in the link's frame. The mesh need not be closed."""

    vertices: Floats
    """[V, 3] [m]."""
    faces: NDArray[np.int64]
    """[F, 3]."""


@dataclass(frozen=True)
class RobotDescription:
    """A URDF: a tree of links."""

    name: str
    root: str
    joints: tuple[Joint, ...]
    """Ordered from the root: each joint comes after the joint that moves its parent."""
    meshes: Mapping[str, LinkMesh]
    """Link name -> mesh. Links without geometry are absent."""


def read_urdf(path: Path) -> RobotDescription:
    """Read a URDF and its meshes: the visual geometry, or the collision geometry of links without a visual one.

    Raises:
        RobotError: a file is missing or damaged, or a mesh is outside the URDF's folder. Also if a joint type or shape
            is unknown, or the links do not form a tree. The message names the element.
    """
    path = Path(path)
    root = _xml(path)
    if root.tag != "robot":
        raise RobotError(f"{path} starts with <{root.tag}>; a URDF starts with <robot>. Run xacro on a .xacro file first.")
    _refuse_doubles(root, path)
    links = [_text(element, "name", path) for element in root.iterfind("link")]
    doubled = sorted({name for name in links if links.count(name) > 1})
    if doubled or not links:
        raise RobotError(f"{path}: link names must be there, and once: {doubled or 'there is no link'}.")
    base, joints = _tree(links, [_joint(element, path) for element in root.iterfind("joint")], path)
    loaded: dict[Path, LinkMesh] = {}
    meshes = {}
    for element in root.iterfind("link"):
        shapes = [_shape(shape, path, loaded) for shape in element.findall("visual") or element.findall("collision")]
        if shapes:
            name = element.attrib["name"]
            meshes[name] = joined(shapes)
            extent = float(np.abs(meshes[name].vertices).max())
            if not extent < _LARGEST_M:
                raise RobotError(
                    f"{path}: link {name} reaches {extent:.3g} m from its origin: its mesh is in millimetres (scale "
                    '"0.001 0.001 0.001" is missing) or damaged.'
                )
    return RobotDescription(root.get("name", path.stem), base, joints, meshes)


def _xml(path: Path) -> ElementTree.Element:
    text = read_input(path, kind="robot description", error=RobotError, most_bytes=_LARGEST_XML)
    _refuse_entities(text, path)
    builder = ElementTree.TreeBuilder()
    # Many robots use undeclared XML prefixes (drake:, gazebo:). ROS accepts them, ElementTree's own parser does not.
    parser = expat.ParserCreate("utf-8")
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(text.decode("utf-8"), True)
    except (expat.ExpatError, UnicodeDecodeError, ValueError) as error:
        raise RobotError(f"{path} is not readable XML: {error}.") from error
    return builder.close()


def _refuse_entities(text: bytes, path: Path) -> None:
    """Refuse document types and entities, which can expand without bound or read system files. No robot needs them."""
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text or b"\0" in text:
        raise RobotError(
            f"{path} declares a document type or entities, or is not UTF-8; such XML is not read. Remove them."
        )


def _joint(element: ElementTree.Element, path: Path) -> Joint:
    name = _text(element, "name", path)
    where = f"{path}: joint {name}"
    kind = element.get("type", "")
    if kind not in get_args(JointKind):
        raise RobotError(f"{where}: {unknown_name('type', kind, get_args(JointKind))}")
    ends = [element.find(tag) for tag in ("parent", "child")]
    parent, child = ("" if end is None else end.get("link", "") for end in ends)
    axis = np.array([1.0, 0.0, 0.0])
    element_axis = element.find("axis")
    if element_axis is not None and kind != "fixed":
        axis = _numbers(element_axis, "xyz", "1 0 0", where)
        if not np.linalg.norm(axis) > 1e-6:
            raise RobotError(f"{where}: its axis is zero.")
        axis = axis / np.linalg.norm(axis)
    limit = element.find("limit")
    lower, upper = -math.inf, math.inf
    if limit is not None and kind in ("revolute", "prismatic"):
        lower, upper = (float(_numbers(limit, key, "0", where, count=1)[0]) for key in ("lower", "upper"))
        if lower > upper:
            raise RobotError(f"{where}: its limits are out of order ({lower:g} > {upper:g}).")
    mimic = element.find("mimic")
    follows = None
    if mimic is not None:
        multiplier, offset = (
            float(_numbers(mimic, key, default, where, count=1)[0])
            for key, default in (("multiplier", "1"), ("offset", "0"))
        )
        follows = Mimic(_text(mimic, "joint", path), multiplier, offset)
    return Joint(name, cast(JointKind, kind), parent, child, _origin(element, where), axis, lower, upper, follows)


def _tree(links: list[str], joints: list[Joint], path: Path) -> tuple[str, tuple[Joint, ...]]:
    """Return the root link, and the joints ordered from the root outwards."""
    names = [joint.name for joint in joints]
    carried = [joint.child for joint in joints]
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise RobotError(f"{path}: joint {joint.name}: there is no link {link!r}.")
        if joint.mimic is not None:
            leader = next((other for other in joints if other.name == joint.mimic.joint), None)
            if leader is None or leader.mimic is not None or leader.kind == "fixed":
                raise RobotError(f"{path}: joint {joint.name} mimics {joint.mimic.joint!r}, which is no joint that moves.")
    if len(set(names)) < len(names) or len(set(carried)) < len(carried):
        raise RobotError(f"{path}: a joint name or a child link occurs twice; links must form a tree.")
    roots = [link for link in links if link not in carried]
    children: dict[str, list[Joint]] = {}
    for joint in joints:
        children.setdefault(joint.parent, []).append(joint)
    ordered: list[Joint] = []
    todo = roots[:1]
    while todo:
        outwards = children.get(todo.pop(), [])
        ordered += outwards
        todo += [joint.child for joint in outwards]
    if len(roots) != 1 or len(ordered) != len(joints):
        raise RobotError(f"{path}: links must form one tree; nothing carries {roots or 'a link of a ring'}.")
    return roots[0], tuple(ordered)


def _shape(element: ElementTree.Element, path: Path, loaded: dict[Path, LinkMesh]) -> LinkMesh:
    """Read a <visual> or <collision> element as a mesh in the link's frame."""
    import trimesh

    where = f"{path}: <{element.tag}>"
    geometry = element.find("geometry")
    shape = None if geometry is None else next(iter(geometry), None)
    if shape is None:
        raise RobotError(f"{where} holds no geometry.")
    pose = _origin(element, where)
    scale = np.ones(3)
    if shape.tag == "mesh":
        file = _mesh_path(_text(shape, "filename", path), path)
        if file not in loaded:
            loaded[file] = _read_mesh(file)
        mesh = loaded[file]
        scale = _numbers(shape, "scale", "1 1 1", where)
    elif shape.tag == "box":
        mesh = _of(trimesh.creation.box(extents=_sizes(shape, "size", where, count=3)))
    elif shape.tag == "cylinder":
        radius, length = (float(_sizes(shape, key, where)[0]) for key in ("radius", "length"))
        mesh = _of(trimesh.creation.cylinder(radius=radius, height=length, sections=32))
    elif shape.tag == "sphere":
        mesh = _of(trimesh.creation.icosphere(subdivisions=3, radius=float(_sizes(shape, "radius", where)[0])))
    else:
        raise RobotError(f"{where}: {unknown_name('shape', shape.tag, ('mesh', 'box', 'cylinder', 'sphere'))}")
    return LinkMesh((mesh.vertices * scale) @ pose[:3, :3].T + pose[:3, 3], mesh.faces)


def _mesh_path(name: str, urdf: Path) -> Path:
    folder = urdf.parent.resolve()
    plain = name.removeprefix("package://").removeprefix("file://")
    candidates = [folder / plain]
    if name.startswith("package://"):
        candidates.append(folder / plain.partition("/")[2])
    resolved = [candidate.resolve() for candidate in candidates]
    if not all(candidate.is_relative_to(folder) for candidate in resolved):
        raise RobotError(
            f"{urdf}: mesh {name!r} lies outside {folder}; copy it there: meshes are read from that folder only."
        )
    found = next((candidate for candidate in resolved if candidate.is_file()), None)
    if found is None:
        raise RobotError(
            f"{urdf}: mesh {name!r} is missing; it was looked for as {' and '.join(map(str, resolved))}. "
            "Copy the description's mesh folder beside the URDF."
        )
    return found


def _read_mesh(path: Path) -> LinkMesh:
    suffix = path.suffix.lower()
    if suffix not in _MESH_FORMATS:
        raise RobotError(f"{path}: {unknown_name('mesh format', suffix, _MESH_FORMATS)}")
    data = read_input(path, kind="mesh", error=RobotError, most_bytes=_LARGEST_MESH)
    try:
        mesh = _read_collada(data, path) if suffix == ".dae" else _read_triangles(data, suffix)
    except RobotError:
        raise
    except Exception as error:  # mesh readers raise many types of errors on damaged files
        raise RobotError(f"{path} is not a readable mesh: {error}.") from error
    if not len(mesh.faces) or not np.isfinite(mesh.vertices).all():
        raise RobotError(f"{path} holds no triangle, or coordinates that are not finite.")
    return mesh


def _read_triangles(data: bytes, suffix: str) -> LinkMesh:
    import trimesh

    # Without a resolver, trimesh opens no materials or textures that the file names.
    return _of(trimesh.load(io.BytesIO(data), file_type=suffix[1:], force="mesh", process=False))


def _read_collada(data: bytes, path: Path) -> LinkMesh:
    import collada

    _refuse_entities(data, path)
    document = collada.Collada(
        io.BytesIO(data), ignore=[collada.common.DaeUnsupportedError, collada.common.DaeBrokenRefError]
    )
    shapes = []
    for geometry in document.scene.objects("geometry"):
        for primitive in geometry.primitives():
            triangles = primitive.triangleset() if hasattr(primitive, "triangleset") else primitive
            shapes.append(LinkMesh(np.asarray(triangles.vertex, np.float64), np.asarray(triangles.vertex_index, np.int64)))
    if not shapes:
        raise RobotError(f"{path} holds no triangles.")
    whole = joined(shapes)
    return LinkMesh(whole.vertices * float(document.assetInfo.unitmeter or 1.0), whole.faces)


def _of(mesh: Any) -> LinkMesh:
    return LinkMesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def joined(shapes: list[LinkMesh]) -> LinkMesh:
    """Concatenate meshes."""
    starts = np.cumsum([0, *(len(shape.vertices) for shape in shapes)])
    return LinkMesh(
        np.concatenate([shape.vertices for shape in shapes]),
        np.concatenate([shape.faces + start for shape, start in zip(shapes, starts, strict=False)]),
    )


def _origin(element: ElementTree.Element, where: str) -> Floats:
    pose = np.eye(4)
    origin = element.find("origin")
    if origin is not None:
        pose[:3, 3] = _numbers(origin, "xyz", "0 0 0", where)
        pose[:3, :3] = Rotation.from_euler("xyz", _numbers(origin, "rpy", "0 0 0", where)).as_matrix()
    return pose


def _numbers(element: ElementTree.Element, key: str, default: str, where: str, *, count: int = 3) -> Floats:
    text = element.get(key, default)
    try:
        values = np.array(text.split(), dtype=np.float64)
    except ValueError:
        values = np.array([])
    if len(values) != count or not (np.abs(values) <= _LARGEST).all():
        wanted = "a number" if count == 1 else f"{count} numbers"
        raise RobotError(
            f"{where}: {key} of <{element.tag}> must be {wanted} of at most {_LARGEST:g} (m, rad), got {text!r:.60}."
        )
    return values


def _sizes(element: ElementTree.Element, key: str, where: str, *, count: int = 1) -> Floats:
    values = _numbers(element, key, "", where, count=count)
    if not (values > 0).all():
        raise RobotError(f"{where}: {key} of <{element.tag}> must be positive, got {element.get(key)!r}.")
    return values


def _refuse_doubles(root: ElementTree.Element, path: Path) -> None:
    """Refuse duplicate elements, of which a parser would silently use only one."""
    for element in root.iter():
        for tag in _ONCE:
            if len(element.findall(tag)) > 1:
                raise RobotError(f"{path}: <{element.tag}> {element.get('name', '')} has <{tag}> twice; keep one of them.")
        if element.tag == "geometry" and len(element) > 1:
            raise RobotError(f"{path}: a <geometry> holds {len(element)} shapes; it takes one.")


def _text(element: ElementTree.Element, key: str, path: Path) -> str:
    value = element.get(key)
    if not value:
        raise RobotError(f"{path}: a <{element.tag}> lacks its {key}.")
    return value


def link_names(description: RobotDescription) -> Iterator[str]:
    """Yield the root link, then the child link of each joint."""
    yield description.root
    yield from (joint.child for joint in description.joints)
