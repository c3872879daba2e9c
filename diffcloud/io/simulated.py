"""Simulated sets: drawn parameters and the node trajectories that the simulator gives for them.

A folder holds, for each split (`train`, `test`), `<split>.csv` (one row per run: the parameters) and `<split>_nodes.npy`
(float32 [N, T+1, V, 3]), and for both `set.json` (scenario, parameters and bounds, frames, how it was drawn), `surface.npz`
(faces, times, the obstacle that is seen) and `replaced.csv` (draws whose simulation diverged, and why); on demand also
`clouds/<split>/<run>/<frame>.npy`. No pickles. All in the frame and length unit of the scenario's scene. Otherwise clouds
are sampled when they are needed (`clouds.augmentation`).
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from diffcloud.errors import DatasetError, unknown_name
from diffcloud.io.files import atomic, read_json, write_json, write_npz, write_text
from diffcloud.mesh.topology import SurfaceMesh

Split = Literal["train", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
SCHEMA = 1
_LARGEST_BYTES = 16 * 2**30
_DAMAGE = (ValueError, OSError, KeyError, TypeError, EOFError, zipfile.BadZipFile)


@dataclass(frozen=True)
class SimulatedSet:
    """One split of a simulated set: N runs of V nodes over T steps of a frame.

    Raises:
        DatasetError: shapes that do not fit together, values that are not finite, a frame that does not exist.
    """

    scenario: str
    names: tuple[str, ...]
    """Of the k drawn parameters."""
    bounds: NDArray[np.float64]
    """[k, 2] lowest and highest value of each."""
    parameters: NDArray[np.float64]
    """[N, k]"""
    nodes: NDArray[np.float32]
    """[N, T+1, V, 3] positions at each frame, the start first."""
    times: NDArray[np.float64]
    """[T+1] since the start [s]."""
    faces: NDArray[np.int64]
    """[F, 3] node indices."""
    loss_faces: NDArray[np.int64] | None
    """Faces whose surface the scenario's loss samples (the upper half of the fold); None for all."""
    loss_frame: int
    """Index into the T+1 frames that the scenario's loss looks at."""
    first_frame: int
    """Index of the frame that a recorded episode begins with."""
    obstacle: SurfaceMesh | None
    """The body seen beside the cloth (the pole, the hook); None where there is only a table."""
    length_unit_m: float
    """Of one length unit of the scene [m]."""

    def __post_init__(self) -> None:
        count, frames, nodes = self.nodes.shape[:3] if self.nodes.ndim == 4 else (0, 0, 0)
        expected: dict[str, tuple[int, ...]] = {
            "nodes": (count, frames, nodes, 3),
            "parameters": (count, len(self.names)),
            "bounds": (len(self.names), 2),
            "times": (frames,),
            "faces": (len(self.faces), 3),
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape or not count:
                raise DatasetError(f"{name} must have shape {list(shape)}, got {list(getattr(self, name).shape)}.")
            if not np.isfinite(getattr(self, name)).all():
                raise DatasetError(f"{name} holds NaN or infinite values; simulate the set again.")
        for name in ("loss_frame", "first_frame"):
            if not 0 <= getattr(self, name) < frames:
                raise DatasetError(f"{name} must be one of the frames 0..{frames - 1}, got {getattr(self, name)}.")
        chosen = np.arange(len(self.faces)) if self.loss_faces is None else self.loss_faces
        for name, index, size in (("faces", self.faces, nodes), ("loss_faces", chosen, len(self.faces))):
            if not len(index) or index.min() < 0 or index.max() >= size:
                raise DatasetError(f"{name} must hold indices in 0..{size - 1}, and at least one.")
        low, high = self.bounds.T
        if not ((low < high).all() and (self.parameters >= low).all() and (self.parameters <= high).all()):
            raise DatasetError(f"Parameters must lie in their bounds {self.bounds.tolist()}, which must be in order.")

    def __len__(self) -> int:
        return len(self.parameters)

    @staticmethod
    def read(folder: Path, split: Split) -> SimulatedSet:
        """Read and check one split.

        Raises:
            DatasetError: missing, damaged, or wrong inside; names the file and what was expected.
        """
        folder = Path(folder)
        if split not in SPLITS:
            raise DatasetError(unknown_name("split", split, SPLITS))
        if not (folder / "set.json").is_file():
            raise DatasetError(
                f"{folder} holds no simulated set (set.json). Make one with `diffcloud simulate --out {folder}`."
            )
        about = _about(folder / "set.json")
        if not about[split]:
            raise DatasetError(f"{folder} has no {split} runs; simulate the set with --{split} above 0.")
        names = tuple(parameter["name"] for parameter in about["parameters"])
        surface = _surface(folder / "surface.npz")
        try:
            return SimulatedSet(
                scenario=about["scenario"],
                names=names,
                bounds=np.array([[parameter["low"], parameter["high"]] for parameter in about["parameters"]]),
                parameters=_table(folder / f"{split}.csv", names),
                nodes=_nodes(folder / f"{split}_nodes.npy"),
                loss_frame=about["loss_frame"],
                first_frame=about["first_frame"],
                length_unit_m=about["length_unit_m"],
                **surface,
            )
        except DatasetError as error:
            raise DatasetError(f"{folder}, {split}: {error}") from error


def write_simulated(
    folder: Path, sets: Mapping[Split, SimulatedSet], *, about: Mapping[str, Any], replaced: str
) -> list[str]:
    """Write all files of a set into a folder, and return their names; the same set gives the same bytes.

    Args:
        sets: the splits that have runs; they share everything but parameters and nodes.
        about: what else `set.json` says (how the parameters were drawn).
        replaced: the table of diverged draws, as CSV.
    """
    folder = Path(folder)
    first = next(iter(sets.values()))
    arrays: dict[str, NDArray[Any]] = {"faces": first.faces, "times": first.times}
    if first.loss_faces is not None:
        arrays["loss_faces"] = first.loss_faces
    if first.obstacle is not None:
        arrays |= {"obstacle_nodes": first.obstacle.nodes, "obstacle_faces": first.obstacle.faces}
    write_npz(folder / "surface.npz", compressed=False, **arrays)
    for split, simulated in sets.items():
        table = pd.DataFrame(simulated.parameters, columns=list(simulated.names)).rename_axis("run")
        write_text(folder / f"{split}.csv", table.to_csv(lineterminator="\n"))
        with atomic(folder / f"{split}_nodes.npy") as stream:
            np.save(stream, simulated.nodes, allow_pickle=False)
    write_text(folder / "replaced.csv", replaced)
    parameters = [
        {"name": name, "low": low, "high": high}
        for name, (low, high) in zip(first.names, first.bounds.tolist(), strict=True)
    ]
    summary = {
        "schema": SCHEMA,
        "scenario": first.scenario,
        "parameters": parameters,
        "train": len(sets.get("train", ())),
        "test": len(sets.get("test", ())),
        "loss_frame": first.loss_frame,
        "first_frame": first.first_frame,
        "length_unit_m": float(first.length_unit_m),
        **about,
    }
    write_json(folder / "set.json", summary)
    tables = (f"{split}{end}" for split in sets for end in (".csv", "_nodes.npy"))
    return ["surface.npz", "replaced.csv", *tables, "set.json"]


def simulated_files(folder: Path) -> list[str]:
    """Files of the set that a folder holds: what a new set may take the place of. None of any other folder."""
    folder = Path(folder)
    try:
        about = _about(folder / "set.json")
    except DatasetError:
        return []
    splits = [split for split in SPLITS if about[split]]
    names = ["set.json", "surface.npz", "replaced.csv", *(f"{s}{end}" for s in splits for end in (".csv", "_nodes.npy"))]
    if about.get("clouds"):
        found = (path.relative_to(folder).as_posix() for path in (folder / "clouds").glob("*/*/*.npy"))
        names += [name for name in found if re.fullmatch(rf"clouds/({'|'.join(splits)})/\d+/\d+\.npy", name)]
    return names


def _about(path: Path) -> dict[str, Any]:
    about = read_json(path, error=DatasetError)
    wanted: dict[str, type] = {"schema": int, "scenario": str, "parameters": list, "loss_frame": int, "first_frame": int}
    wanted |= {"length_unit_m": float, "train": int, "test": int}
    for name, kind in wanted.items():
        if not isinstance(about, dict) or not isinstance(about.get(name), kind):
            raise DatasetError(f"{path}: `{name}` is missing or of the wrong type; this is no simulated set.")
    if about["schema"] != SCHEMA:
        raise DatasetError(f"{path} has schema {about['schema']}; this version reads {SCHEMA}. Simulate the set again.")
    for parameter in about["parameters"]:
        bounds = [parameter.get(key) for key in ("low", "high")] if isinstance(parameter, dict) else []
        if not all(isinstance(bound, (int, float)) for bound in bounds) or not isinstance(parameter.get("name"), str):
            raise DatasetError(f"{path}: a parameter has `name`, `low` and `high`, got {parameter!r}.")
    return cast(dict[str, Any], about)


def _surface(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        obstacle = None
        if "obstacle_nodes" in arrays:
            obstacle = SurfaceMesh(
                arrays["obstacle_nodes"].astype(np.float64, casting="safe").reshape(-1, 3),
                arrays["obstacle_faces"].astype(np.int64, casting="safe").reshape(-1, 3),
            )
            if not np.isin(obstacle.faces, np.arange(len(obstacle.nodes))).all():
                raise ValueError("the obstacle's faces name points that it does not have")
        loss_faces = arrays.get("loss_faces")
        return {
            "faces": arrays["faces"].astype(np.int64, casting="safe"),
            "times": arrays["times"].astype(np.float64, casting="safe"),
            "loss_faces": None if loss_faces is None else loss_faces.astype(np.int64, casting="safe"),
            "obstacle": obstacle,
        }
    except _DAMAGE as error:
        raise DatasetError(f"{path} is not the surface of a simulated set: {error}.") from error


def _table(path: Path, names: tuple[str, ...]) -> NDArray[np.float64]:
    try:
        with path.open(encoding="utf-8") as file:
            columns = file.readline().strip().split(",")
            table = np.loadtxt(file, delimiter=",", ndmin=2)
        if columns != ["run", *names] or not np.array_equal(table[:, 0], np.arange(len(table))):
            raise ValueError(f"expected runs numbered from 0 with the columns {', '.join(names)}")
        return table[:, 1:]
    except _DAMAGE as error:
        raise DatasetError(f"{path} is not a table of parameters: {error}.") from error


def _nodes(path: Path) -> NDArray[np.float32]:
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise ValueError(f"it has {path.stat().st_size} bytes; at most {_LARGEST_BYTES} are read")
        nodes = np.load(path, allow_pickle=False)
        if nodes.dtype != np.float32:
            raise ValueError(f"expected float32, got {nodes.dtype}")
        return nodes
    except _DAMAGE as error:
        raise DatasetError(f"{path} holds no node trajectories: {error}.") from error
