"""Cloud files of other tools: NPY, PLY, XYZ, PCD.

PLY goes through trimesh and PCD through open3d, which is imported only when a PCD file is met.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EmptyCloudError, EpisodeError
from diffcloud.io.files import atomic
from diffcloud.io.inputs import check_input
from diffcloud.io.libusb import load_libusb
from diffcloud.io.pickles import load_npy

FORMATS = (".npy", ".ply", ".xyz", ".pcd")
_HEADER = 65_536
"""[B] A longer one is none."""


def read_cloud(path: Path) -> NDArray[np.float32]:
    """[N, 3] points of one file; colours, normals and further columns are left out.

    Raises:
        EpisodeError: missing, damaged, empty (`EmptyCloudError`), of the wrong shape, or with NaN/Inf points.
    """
    path = Path(path)
    check_input(path, kind="cloud", error=EpisodeError)
    readers = {".npy": load_npy, ".ply": _read_ply, ".xyz": _read_xyz, ".pcd": _read_pcd}
    if path.suffix.lower() not in readers:
        raise EpisodeError(f"{path}: unknown cloud format; allowed are {', '.join(FORMATS)}.")
    points = np.asarray(readers[path.suffix.lower()](path))
    if points.dtype.kind not in "fiu":
        raise EpisodeError(f"{path} holds {points.dtype} values; a cloud holds numbers.")
    if points.ndim != 2 or points.shape[1] != 3:
        raise EpisodeError(f"{path} has shape {list(points.shape)}; a cloud has shape [points, 3].")
    if len(points) == 0:
        raise EmptyCloudError(f"{path} is an empty cloud.")
    if not np.isfinite(points).all():
        count = int((~np.isfinite(points).all(axis=1)).sum())
        raise EpisodeError(f"{path} holds {count} NaN or infinite points; remove them first.")
    return points.astype(np.float32)


def write_ply(path: Path, vertices: NDArray[Any], faces: NDArray[Any] | None = None) -> None:
    """Write a cloud [N, 3] or a mesh as binary PLY, atomically."""
    import trimesh

    shape = trimesh.PointCloud(vertices) if faces is None else trimesh.Trimesh(vertices, faces, process=False)
    with atomic(path) as stream:
        shape.export(stream, file_type="ply")


def _read_ply(path: Path) -> NDArray[Any]:
    import trimesh

    try:
        loaded = trimesh.load(path, process=False)
    except Exception as error:  # trimesh raises many kinds on damaged files
        raise EpisodeError(f"{path} is not a readable PLY file: {error}.") from error
    found = np.asarray(getattr(loaded, "vertices", np.zeros((0, 3))))
    with path.open("rb") as stream:  # of text that was cut off at a line's end trimesh takes what is there
        stated = re.search(rb"^element vertex (\d+)\s*$", stream.read(_HEADER), re.MULTILINE)
    if stated is not None and len(found) < int(stated[1]):  # more where faces share places but not their texture
        raise EpisodeError(f"{path} states {int(stated[1])} points and holds {len(found)}: it was cut off.")
    return found


def _read_xyz(path: Path) -> NDArray[Any]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a file without rows
            table = np.loadtxt(path, ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        raise EpisodeError(f"{path} is not a readable XYZ file (three or more numbers a line): {error}.") from error
    return table[:, :3] if table.size else np.zeros((0, 3))


def _read_pcd(path: Path) -> NDArray[Any]:
    _check_pcd(path)
    open3d = import_open3d()
    cloud = open3d.io.read_point_cloud(str(path), remove_nan_points=False, remove_infinite_points=False)
    return np.asarray(cloud.points)


def _check_pcd(path: Path) -> None:
    """Refuse what open3d reads in silence: rows of text as points at zero, and points that the file cannot hold, for which
    it takes memory.

    Raises:
        EpisodeError: these, or no header.
    """
    with path.open("rb") as stream:
        head: dict[str, list[str]] = {}
        while "DATA" not in head and stream.tell() < _HEADER and (line := stream.readline(_HEADER)):
            name, *words = [*line.decode("ascii", errors="replace").split(), ""]
            head[name.upper()] = words[:-1]
        try:
            points, kind, sizes = int(head["POINTS"][0]), head["DATA"][0].lower(), [int(size) for size in head["SIZE"]]
            counts = [int(count) for count in head.get("COUNT", ["1"] * len(sizes))]
            row = max(sum(size * count for size, count in zip(sizes, counts, strict=True)), 1)
        except (KeyError, IndexError, ValueError) as error:
            raise EpisodeError(
                f"{path} is not a readable PCD file: its header lacks or garbles a field ({error})."
            ) from error
        left = path.stat().st_size - stream.tell()
        # LZF, which compressed files have, gains at most a factor of 88
        most = {"ascii": left // 2, "binary": left // row, "binary_compressed": 88 * left // row}.get(kind, 0)
        if not 0 <= points <= most:
            raise EpisodeError(f"{path} states {points} points, but what follows its header can hold {most} at most.")
        if kind != "ascii":
            return
        try:
            rows = np.loadtxt(stream, ndmin=2)
        except (ValueError, UnicodeDecodeError) as error:
            raise EpisodeError(f"{path} is not a readable PCD file (numbers, as many in each line): {error}.") from error
    if len(rows) != points:
        raise EpisodeError(f"{path} states {points} points and holds {len(rows)}.")


def import_open3d() -> Any:
    """open3d, with libusb found where the system has none.

    Raises:
        EpisodeError: open3d cannot be imported; says what to install.
    """
    try:
        load_libusb()
        import open3d
    except (ImportError, OSError) as error:
        if isinstance(error.__cause__ or error.__context__, KeyboardInterrupt):  # as libraries in C report a Ctrl-C
            raise KeyboardInterrupt from error
        raise EpisodeError(
            f"open3d cannot be imported ({error}). On Debian: apt-get install libgl1 libegl1 libx11-6 libudev1 libgomp1. "
            "Or convert PCD files to PLY."
        ) from error
    return open3d
