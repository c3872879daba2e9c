"""Read the points of PLY files: ASCII and binary in both byte orders, with any elements and properties.

Only x, y and z of the element `vertex` are returned. Later elements are ignored, and files that the header names, such
as textures, are not opened.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError
from diffcloud.io.pcd import axis_field

_HEADER = 65_536
"""Largest header [bytes]."""
_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
    "int64": "i8",
    "uint64": "u8",
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class _Element:
    name: str
    count: int
    names: list[str] = field(default_factory=list)
    types: list[tuple[str, ...]] = field(default_factory=list)
    """NumPy type code of each property. A list property has two: of its length and of its entries."""


def read_ply(path: Path) -> NDArray[np.float64]:
    """Read the vertices [N, 3] of a PLY file, in file order.

    Raises:
        EpisodeError: the header is damaged, vertices have no x, y and z, or the file is too short.
    """
    data = path.read_bytes()
    try:
        order, elements, start = _header(data)
    except ValueError as error:
        raise EpisodeError(f"{path} is not a readable PLY file: {error}.") from error
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise EpisodeError(f"{path} has the elements {', '.join(names) or 'none'}; a cloud needs vertex.")
    before, vertex = elements[: names.index("vertex")], elements[names.index("vertex")]
    axes = [axis_field(vertex.names, axis) for axis in "xyz"]
    if any(axis is None or len(vertex.types[axis]) > 1 for axis in axes):
        raise EpisodeError(f"{path}: its vertices have {', '.join(vertex.names) or 'no properties'}; they need x, y and z.")
    columns = [axis for axis in axes if axis is not None]
    least = sum(element.count for element in (*before, vertex))  # [bytes] each element takes at least one
    if least > len(data) - start:
        raise EpisodeError(f"{path} states {vertex.count} points, but is shorter than that: it was cut off.")
    try:
        if not order:
            return _from_text(data[start:], before, vertex, columns)
        for element in before:
            start = _skipped(data, start, element, order)
        return _from_bytes(data, start, vertex, order, columns)
    except _CutOffError as error:
        raise EpisodeError(f"{path} states {vertex.count} points and holds {error}: it was cut off.") from error
    except (ValueError, IndexError) as error:
        raise EpisodeError(f"{path} is not a readable PLY file: {error}.") from error


class _CutOffError(Exception):
    """The file ends too early. The argument is the number of vertices found."""


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """Parse the header. Return the byte order (empty for ASCII), the elements, and the offset of the data."""
    if not data.startswith(b"ply"):
        raise ValueError("it does not start with ply")
    newline = b"\r\n" if data[3:5] == b"\r\n" else data[3:4]
    if newline not in (b"\n", b"\r", b"\r\n"):
        newline = b"\n"
    order, elements, place = None, list[_Element](), 0
    while True:
        end = data.find(newline, place, _HEADER)
        if end < 0:
            raise ValueError("its header does not end")
        words = data[place:end].decode("ascii", errors="replace").split()
        place = end + len(newline)
        match words:
            case ["end_header"]:
                break
            case ["format", kind, *_] if kind in _ORDERS:
                order = _ORDERS[kind]
            case ["element", name, count] if count.isdecimal():
                elements.append(_Element(name, int(count)))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= _TYPES.keys():
                elements[-1].names.append(name)
                elements[-1].types.append((_TYPES[length], _TYPES[kind]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].names.append(name)
                elements[-1].types.append((_TYPES[kind],))
            case ["ply"] | ["comment", *_] | ["obj_info", *_] | []:
                pass
            case _:
                raise ValueError(f"its header has the line {' '.join(words)!r:.60}")
    if order is None:
        raise ValueError(f"its header states no format; allowed are {', '.join(_ORDERS)}")
    return order, elements, place


def _layout(element: _Element, order: str) -> np.dtype[Any] | None:
    """Return the NumPy type of one entry, or None if its size varies because of list properties."""
    if any(len(codes) > 1 for codes in element.types):
        return None
    return np.dtype([(str(index), order + codes[0]) for index, codes in enumerate(element.types)])


def _skipped(data: bytes, start: int, element: _Element, order: str) -> int:
    """Return the offset of the data that follow an element."""
    layout = _layout(element, order)
    if layout is not None:
        return start + element.count * layout.itemsize
    for _ in range(element.count):
        start = _walked(data, start, element, order)[-1]
    return start


def _walked(data: bytes, start: int, element: _Element, order: str) -> list[int]:
    """Return the offset of each property of one entry, and of the next entry."""
    places = [start]
    for codes in element.types:
        size = np.dtype(codes[-1]).itemsize
        place = places[-1]
        if len(codes) > 1:
            head = np.dtype(order + codes[0])
            if place + head.itemsize > len(data):
                raise _CutOffError("fewer")
            length = int(np.frombuffer(data, head, 1, place)[0])
            if length < 0:
                raise ValueError(f"a list has {length} entries")
            size = head.itemsize + length * size
        if place + size > len(data):
            raise _CutOffError("fewer")
        places.append(place + size)
    return places


def _from_bytes(data: bytes, start: int, vertex: _Element, order: str, axes: list[int]) -> NDArray[np.float64]:
    layout = _layout(vertex, order)
    if layout is not None:
        held = max(len(data) - start, 0) // layout.itemsize
        if held < vertex.count:
            raise _CutOffError(held)
        table = np.frombuffer(data, layout, vertex.count, start)
        return np.stack([table[str(axis)].astype(np.float64) for axis in axes], axis=1)
    rows = np.zeros((vertex.count, 3))
    for row in range(vertex.count):
        places = _walked(data, start, vertex, order)
        start = places[-1]
        rows[row] = [np.frombuffer(data, order + vertex.types[axis][0], 1, places[axis])[0] for axis in axes]
    return rows


def _from_text(data: bytes, before: list[_Element], vertex: _Element, axes: list[int]) -> NDArray[np.float64]:
    """Read vertices from ASCII data. Numbers are separated by any white space; line breaks have no meaning."""
    words = data.split()
    place = 0
    for element in before:
        for _ in range(element.count):
            place = _read_words(words, place, element)[-1]
    if _layout(vertex, "") is not None:
        width = len(vertex.types)
        held = max(len(words) - place, 0) // width
        if held < vertex.count:
            raise _CutOffError(held)
        table = np.array(words[place : place + vertex.count * width], dtype="S").reshape(-1, width)
        return table[:, axes].astype(np.float64)
    rows = np.zeros((vertex.count, 3))
    for row in range(vertex.count):
        places = _read_words(words, place, vertex)
        place = places[-1]
        if place > len(words):
            raise _CutOffError(row)
        rows[row] = [float(words[places[axis]]) for axis in axes]
    return rows


def _read_words(words: list[bytes], place: int, element: _Element) -> list[int]:
    """Return the word index of each property of one entry, and of the next entry."""
    places = [place]
    for codes in element.types:
        length = 1
        if len(codes) > 1:
            if places[-1] >= len(words):
                raise _CutOffError("fewer")
            length = 1 + int(words[places[-1]])
            if length < 1:
                raise ValueError(f"a list has {length - 1} entries")
        places.append(places[-1] + length)
    return places
