"""Read and write cloud files of other tools: NPY, PLY, XYZ and PCD. open3d is imported only on demand."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EmptyCloudError, EpisodeError
from diffcloud.io.files import atomic
from diffcloud.io.inputs import check_input
from diffcloud.io.libusb import load_libusb
from diffcloud.io.pcd import read_pcd
from diffcloud.io.pickles import load_npy
from diffcloud.io.ply import read_ply


def read_cloud(path: Path) -> NDArray[np.float32]:
    """Read the points [N, 3] of a cloud file, without colours, normals and other columns.

    NaN and infinite points are left out: they stand for pixels without depth.

    Raises:
        EpisodeError: the file is missing, damaged, without any point (`EmptyCloudError`), or of the wrong shape.
    """
    path = Path(path)
    check_input(path, kind="cloud", error=EpisodeError)
    if path.suffix.lower() not in FORMATS:
        raise EpisodeError(f"{path}: unknown cloud format; allowed are {', '.join(FORMATS)}.")
    points = np.asarray(FORMATS[path.suffix.lower()](path))
    if points.dtype.kind not in "fiu":
        raise EpisodeError(f"{path} holds {points.dtype} values; a cloud holds numbers.")
    if points.ndim != 2 or points.shape[1] != 3:
        raise EpisodeError(f"{path} has shape {list(points.shape)}; a cloud has shape [points, 3].")
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        raise EmptyCloudError(f"{path} is an empty cloud.")
    return points.astype(np.float32)


def write_ply(path: Path, vertices: NDArray[Any], faces: NDArray[Any] | None = None) -> None:
    """Write a cloud [N, 3] or a mesh as binary PLY, atomically."""
    import trimesh

    shape = trimesh.PointCloud(vertices) if faces is None else trimesh.Trimesh(vertices, faces, process=False)
    with atomic(path) as stream:
        shape.export(stream, file_type="ply")


def _read_xyz(path: Path) -> NDArray[Any]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # numpy warns about a file without rows
            table = np.loadtxt(path, ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        raise EpisodeError(f"{path} is not a readable XYZ file (three or more numbers a line): {error}.") from error
    return table[:, :3] if table.size else np.zeros((0, 3))


FORMATS: dict[str, Callable[[Path], Any]] = {".npy": load_npy, ".ply": read_ply, ".xyz": _read_xyz, ".pcd": read_pcd}
"""Suffix -> reader. CSV is not a cloud format, because tracks and time stamps in the same folder are CSV files."""


def import_open3d() -> Any:
    """Import open3d. If the system has no libusb, the one of libusb-package is loaded first.

    Raises:
        EpisodeError: open3d cannot be imported. The message lists what to install.
    """
    try:
        load_libusb()
        import open3d
    except (ImportError, OSError) as error:
        if isinstance(error.__cause__ or error.__context__, KeyboardInterrupt):  # C libraries report Ctrl-C like this
            raise KeyboardInterrupt from error
        raise EpisodeError(
            f"open3d cannot be imported ({error}). On Debian: apt-get install libgl1 libegl1 libx11-6 libudev1 libgomp1."
        ) from error
    return open3d
