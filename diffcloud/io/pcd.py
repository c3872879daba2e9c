"""Read PCD files (Point Cloud Library): ascii, binary and binary_compressed, with all field types.

Only x, y and z are returned. As in PCL and open3d, the VIEWPOINT (sensor pose) is not applied.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EmptyCloudError, EpisodeError

_HEADER = 65_536
"""Largest header [bytes]."""
_LZF_GAIN = 88
"""Largest compression ratio of LZF."""
_TYPES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
"""TYPE -> allowed sizes [bytes]."""


@dataclass(frozen=True)
class _Header:
    layout: np.dtype[Any]
    """Layout of one point. Fields are named by their index, because PCL repeats the name `_` for padding."""
    axes: tuple[int, int, int]
    """Field indices of x, y and z."""
    points: int
    kind: str


def read_pcd(path: Path) -> NDArray[np.float64]:
    """Read the points [N, 3] of a PCD file. Points with NaN, which PCL uses for missing measurements, are dropped.

    Raises:
        EpisodeError: the header is damaged, x, y or z is missing, a field type is unknown, the data end early, or all
            points are NaN (`EmptyCloudError`).
    """
    with path.open("rb") as stream:
        header = _read_header(stream, path)
        left = path.stat().st_size - stream.tell()
        size = header.layout.itemsize
        limits = {"ascii": left // 2, "binary": left // size, "binary_compressed": _LZF_GAIN * left // size}
        most = limits.get(header.kind, 0)
        if not 0 <= header.points <= most:
            raise EpisodeError(
                f"{path} states {header.points} points, but what follows its header can hold {most} at most."
            )
        if header.kind == "ascii":
            columns = _text(stream, header, path)
        elif header.kind == "binary":
            table = np.frombuffer(stream.read(header.points * size), header.layout)
            columns = [table[str(axis)] for axis in header.axes]
        else:
            columns = _compressed(stream.read(), header, path)
    points = np.stack([np.asarray(column, np.float64) for column in columns], axis=1)
    kept = points[~np.isnan(points).any(axis=1)]
    if len(points) and not len(kept):
        raise EmptyCloudError(f"{path} holds {len(points)} points, all of them NaN; leave this frame out.")
    return kept


def _read_header(stream: BinaryIO, path: Path) -> _Header:
    words: dict[str, list[str]] = {}
    while "DATA" not in words and stream.tell() < _HEADER and (line := stream.readline(_HEADER)):
        name, *rest = [*line.decode("ascii", errors="replace").split(), ""]
        words.setdefault(name.upper(), rest[:-1])
    try:
        names = words["FIELDS"] if "FIELDS" in words else words["COLUMNS"]
        sizes = [int(size) for size in words["SIZE"]]
        kinds = [kind.upper() for kind in words["TYPE"]]
        counts = [int(count) for count in words.get("COUNT", ["1"] * len(names))]
        if not len(names) == len(sizes) == len(kinds) == len(counts):
            raise ValueError("FIELDS, SIZE, TYPE and COUNT differ in length")
        width, height = (int(words[key][0]) if key in words else None for key in ("WIDTH", "HEIGHT"))
        points = int(words["POINTS"][0]) if "POINTS" in words else int(words["WIDTH"][0]) * (height or 1)
        if width is not None and width * (1 if height is None else height) != points:
            raise ValueError(f"WIDTH x HEIGHT is {width} x {1 if height is None else height}, POINTS {points}")
        kind = words["DATA"][0].lower()
        fields = []
        for index, (name, size, letter, count) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
            if size not in _TYPES.get(letter, ()):
                raise ValueError(f"field {name} has TYPE {letter} SIZE {size}; allowed are F 4 8, I and U 1 2 4 8")
            if not 1 <= count <= _HEADER:
                raise ValueError(f"field {name} has COUNT {count}")
            fields.append((str(index), f"<{letter.lower()}{size}", (count,)))
        if kind not in ("ascii", "binary", "binary_compressed"):
            raise ValueError(f"DATA is {kind}; allowed are ascii, binary, binary_compressed")
    except (KeyError, IndexError, ValueError) as error:
        raise EpisodeError(f"{path} is not a readable PCD file: its header lacks or garbles a field ({error}).") from error
    axes = tuple(axis_field(names, axis) for axis in "xyz")
    if any(index is None or counts[index] != 1 for index in axes):
        raise EpisodeError(f"{path} has the fields {' '.join(names)}; a cloud needs x, y and z, one number each.")
    flat = [(name, code) if count == (1,) else (name, code, count) for name, code, count in fields]
    return _Header(np.dtype(flat), axes, points, kind)  # type: ignore[arg-type]


def axis_field(names: list[str], axis: str) -> int | None:
    """Return the index of a coordinate among field names, in lower or upper case, or None."""
    return next((names.index(name) for name in (axis, axis.upper()) if name in names), None)


def _text(stream: BinaryIO, header: _Header, path: Path) -> list[NDArray[Any]]:
    try:
        rows = np.loadtxt(stream, ndmin=2) if header.points else np.zeros((0, 0))
    except (ValueError, UnicodeDecodeError) as error:
        raise EpisodeError(f"{path} is not a readable PCD file (numbers, as many in each line): {error}.") from error
    if len(rows) != header.points:
        raise EpisodeError(f"{path} states {header.points} points and holds {len(rows)}.")
    widths = [int(np.prod(header.layout[index].shape)) for index in range(len(header.layout.names or ()))]
    if not header.points:
        return [np.zeros(0)] * 3
    if rows.shape[1] != sum(widths):
        raise EpisodeError(f"{path} states {sum(widths)} numbers a point and holds {rows.shape[1]}.")
    return [rows[:, sum(widths[:axis])] for axis in header.axes]


def _compressed(data: bytes, header: _Header, path: Path) -> list[NDArray[Any]]:
    """Decompress LZF data: field after field, each for all points. Two integers before them are the sizes."""
    packed, size = (int.from_bytes(data[start : start + 4], "little") for start in (0, 4))
    if size != header.points * header.layout.itemsize or len(data) < 8 + packed:
        raise EpisodeError(f"{path}: its compressed data are cut off, or do not fit its header.")
    try:
        plain = lzf_decompressed(data[8 : 8 + packed], size)
    except ValueError as error:
        raise EpisodeError(f"{path}: its compressed data are damaged ({error}).") from error
    columns = []
    for axis in header.axes:
        start = header.points * sum(header.layout[index].itemsize for index in range(axis))
        columns.append(np.frombuffer(plain, header.layout[axis], header.points, start))
    return columns


def lzf_decompressed(data: bytes, size: int) -> bytes:
    """Decompress LibLZF data.

    Args:
        size: expected size of the result [bytes].

    Raises:
        ValueError: the data are damaged, or the result has another size.
    """
    result, place = bytearray(), 0
    while place < len(data) and len(result) <= size:
        control = data[place]
        place += 1
        if control < 32:  # control + 1 literal bytes
            result += data[place : place + control + 1]
            place += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[place] if place < len(data) else 0
            place += 1
        if place >= len(data):
            raise ValueError("it ends within a reference")
        start = len(result) - ((control & 31) << 8) - data[place] - 1
        place += 1
        length += 2
        if start < 0:
            raise ValueError("a reference leads before the beginning")
        copied = result[start : start + length]
        result += (copied * (length // len(copied) + 1))[:length]  # the copy may overlap its own output
    if place > len(data) or len(result) != size:
        raise ValueError(f"{len(result)} bytes instead of {size}")
    return bytes(result)
