"""Cloud files of other tools: NPY, PLY, XYZ, PCD; and open3d, which is imported only where it is used."""

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
    """[N, 3] points of one file. Colours, normals and further columns are left out, and so are points that are NaN or
    infinite, which stand for pixels without depth.

    Raises:
        EpisodeError: missing, damaged, without any point (`EmptyCloudError`), or of the wrong shape.
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
            warnings.simplefilter("ignore", UserWarning)  # of a file without rows
            table = np.loadtxt(path, ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        raise EpisodeError(f"{path} is not a readable XYZ file (three or more numbers a line): {error}.") from error
    return table[:, :3] if table.size else np.zeros((0, 3))


FORMATS: dict[str, Callable[[Path], Any]] = {".npy": load_npy, ".ply": read_ply, ".xyz": _read_xyz, ".pcd": read_pcd}
"""Suffix -> reader. Not .csv: tracks and time stamps lie beside clouds."""


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
            f"open3d cannot be imported ({error}). On Debian: apt-get install libgl1 libegl1 libx11-6 libudev1 libgomp1."
        ) from error
    return open3d
