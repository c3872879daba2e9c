"""Simulated data sets: sampled parameters and the node trajectories that the simulator returns for them.

A folder has for each split (`train`, `test`) `<split>.csv` (parameters, one row per run) and `<split>_nodes.npy`
(float32 [N, T+1, V, 3]). Both splits share `set.json` (scenario, parameters, bounds, frames, sampling), `surface.npz`
(faces, times, the visible obstacle) and `replaced.csv` (samples whose simulation diverged, with the reason).
`clouds/<split>/<run>/ <frame>.npy` is optional; without it, clouds are sampled on demand (`clouds.augmentation`). No
file has pickles. All positions are in the frame and length unit of the scene.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, ValidationError

from diffcloud.errors import DatasetError, unknown_name
from diffcloud.io.arrays import read_npy, read_npz
from diffcloud.io.files import atomic, read_json, write_json, write_npz, write_text
from diffcloud.io.inputs import read_text
from diffcloud.io.schema import Component, Plain, explain
from diffcloud.mesh.topology import SurfaceMesh

Split = Literal["train", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
SCHEMA = 1
LARGEST_BYTES = 16 * 2**30
"""Largest size of a file of node trajectories."""
_LATEST_S = 1e6
_DAMAGE = (ValueError, OSError, KeyError, TypeError)


Name = Annotated[str, Field(min_length=1, max_length=200)]
Count = Annotated[int, Field(ge=0, le=10_000_000)]


class SetParameter(Plain):
    """Schema of a parameter in set.json."""

    name: Name
    low: Component
    high: Component


class SetFile(Plain):
    """Schema of set.json. Further keys describe how the set was made."""

    model_config = ConfigDict(extra="allow")

    schema_version: Literal[1] = Field(alias="schema")
    scenario: Name
    parameters: Annotated[list[SetParameter], Field(min_length=1, max_length=100)]
    train: Count
    test: Count
    loss_frame: Count
    first_frame: Count
    length_unit_m: Annotated[float, Field(gt=0, le=1e3)]
    draws: Name | None = None
    seed: Annotated[int, Field(ge=0)] | None = None
    uncertain: dict[Name, Component] = Field(default_factory=dict)
    """Nuisance material parameter -> standard deviation as a factor. These values also vary between runs."""
    integrator: Name | None = None
    replaced: Count = 0
    clouds: Count = 0
    """Number of points of each cloud on disk, 0 if none were written."""


@dataclass(frozen=True)
class SimulatedSet:
    """One split of a simulated set: N runs of V nodes over T frame intervals, with k sampled parameters.

    Raises:
        DatasetError: inconsistent shapes, values that are not finite, or a frame that does not exist.
    """

    scenario: str
    names: tuple[str, ...]
    """[k] parameter names."""
    bounds: NDArray[np.float64]
    """[k, 2] lower and upper bound of each parameter."""
    parameters: NDArray[np.float64]
    """[N, k]"""
    nodes: NDArray[np.float32]
    """[N, T+1, V, 3] node positions at each frame, starting with the initial state."""
    times: NDArray[np.float64]
    """[T+1] since the start [s]."""
    faces: NDArray[np.int64]
    """[F, 3] node indices."""
    loss_faces: NDArray[np.int64] | None
    """Faces from which the scenario's loss samples points (the upper half of the fold). None: all faces."""
    loss_frame: int
    """Index (0 to T) of the frame at which the scenario's loss is evaluated."""
    first_frame: int
    """Index of the first frame of a recorded episode."""
    obstacle: SurfaceMesh | None
    """The body that is visible beside the cloth (pole, hook). None if there is only a table."""
    length_unit_m: float
    """Length of one unit of the scene [m]."""

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
        if self.times[0] < 0 or (np.diff(self.times) <= 0).any() or self.times[-1] > _LATEST_S:
            raise DatasetError("times must increase from zero or later, in seconds; simulate the set again.")
        for name in ("loss_frame", "first_frame"):
            if not 0 <= getattr(self, name) < frames:
                raise DatasetError(f"{name} must be one of the frames 0..{frames - 1}, got {getattr(self, name)}.")
        chosen = np.arange(len(self.faces)) if self.loss_faces is None else self.loss_faces
        for name, index, size in (("faces", self.faces, nodes), ("loss_faces", chosen, len(self.faces))):
            if not len(index) or index.min() < 0 or index.max() >= size:
                raise DatasetError(f"{name} must hold indices in 0..{size - 1}, and at least one.")
        if (self.faces == np.roll(self.faces, 1, axis=1)).any():
            raise DatasetError("A face names a node twice; simulate the set again.")
        low, high = self.bounds.T
        if not ((low < high).all() and (self.parameters >= low).all() and (self.parameters <= high).all()):
            raise DatasetError(f"Parameters must lie in their bounds {self.bounds.tolist()}, which must be in order.")

    def __len__(self) -> int:
        return len(self.parameters)

    @staticmethod
    def read(folder: Path, split: Split) -> SimulatedSet:
        """Read and check one split.

        Raises:
            DatasetError: a file is missing, damaged or inconsistent.
        """
        folder = Path(folder)
        if split not in SPLITS:
            raise DatasetError(unknown_name("split", split, SPLITS))
        if not (folder / "set.json").is_file():
            raise DatasetError(
                f"{folder} holds no simulated set (set.json). Make one with `diffcloud network generate --out {folder}`."
            )
        about = _about(folder / "set.json")
        if not about[split]:
            raise DatasetError(f"{folder} has no {split} runs; simulate the set with --{split} above 0.")
        names = tuple(parameter["name"] for parameter in about["parameters"])
        surface = _surface(folder / "surface.npz")
        try:
            parameters = _table(folder / f"{split}.csv", names)
            if len(parameters) != about[split]:
                raise DatasetError(f"set.json states {about[split]} runs, {split}.csv has {len(parameters)}.")
            return SimulatedSet(
                scenario=about["scenario"],
                names=names,
                bounds=np.array([[parameter["low"], parameter["high"]] for parameter in about["parameters"]]),
                parameters=parameters,
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
    """Write all files of a set into a folder and return their names. The same set always gives the same bytes.

    Args:
        sets: the splits that have runs. They share everything except parameters and nodes.
        about: further entries of `set.json`, such as how the parameters were sampled.
        replaced: the table of diverged samples, as CSV.
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
    """List the files of the simulated set in a folder, which a new set may overwrite. Empty for any other folder."""
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
    if isinstance(about, dict) and about.get("schema", SCHEMA) != SCHEMA:
        raise DatasetError(f"{path} has schema {about['schema']}; this version reads {SCHEMA}. Simulate the set again.")
    try:
        told = SetFile.model_validate(about)
    except ValidationError as error:
        raise explain(f"{path} is no simulated set", error, DatasetError) from error
    return told.model_dump(mode="json", exclude_unset=True, by_alias=True)  # numeric strings became numbers


def _surface(path: Path) -> dict[str, Any]:
    try:
        arrays = read_npz(path, kind="surface of a simulated set", error=DatasetError)
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
        file = io.StringIO(read_text(path, kind="table of parameters", error=DatasetError))
        columns = file.readline().strip().split(",")
        table = np.loadtxt(file, delimiter=",", ndmin=2)
        if columns != ["run", *names] or not np.array_equal(table[:, 0], np.arange(len(table))):
            raise ValueError(f"expected runs numbered from 0 with the columns {', '.join(names)}")
        return table[:, 1:]
    except _DAMAGE as error:
        raise DatasetError(f"{path} is not a table of parameters: {error}.") from error


def _nodes(path: Path) -> NDArray[np.float32]:
    nodes = read_npy(path, kind="file of node trajectories", error=DatasetError, most_bytes=LARGEST_BYTES)
    if nodes.dtype != np.float32:
        raise DatasetError(f"{path} holds no node trajectories: expected float32, got {nodes.dtype}.")
    return nodes
