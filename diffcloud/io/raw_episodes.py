"""Read and write raw episodes: folders of depth images and joint angles.

    episode.json                      schema version, scenario, labels, rate, cameras, robot, source, units, status
    cameras/<cam>/camera.json         intrinsics, depth_scale_m, T_world_camera (or a calibration file), serial
    cameras/<cam>/timestamps.csv      frame, t_s
    cameras/<cam>/depth/000000.png    16-bit, times depth_scale_m [m], aligned to the colour image
    cameras/<cam>/color/000000.png
    robot.csv                         t_s, joint_1.. [rad], gripper [0..1], tool_x..z [m], tool_qw..qz, wrench [N, N·m]

All times are seconds of one clock since the start of the recording. `RawEpisodeWriter` writes during the recording. It
writes the images of a frame first, and then the frame's row in timestamps.csv. A frame is valid only if it has a
complete row, so a crash leaves a shorter but valid episode: readers ignore images without a row and an incomplete last
line.
"""

from __future__ import annotations

import datetime
import errno
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Literal, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import AfterValidator, ConfigDict, Field, ValidationError, field_validator

from diffcloud.errors import DiffCloudError, EpisodeError, OutputError
from diffcloud.io.camera_models import Intrinsics, IntrinsicsFile, RigidTransform
from diffcloud.io.files import read_json, write_json
from diffcloud.io.images import read_color, read_depth, write_color, write_depth
from diffcloud.io.schema import Checked, FileName, Plain, Vector, explain
from diffcloud.io.tables import numbers, read_csv

SCHEMA_VERSION = 1
UNITS = {"length": "m", "angle": "rad", "time": "s", "force": "N", "torque": "N·m"}
_FILES = re.compile(
    r"episode\.json|robot\.csv|cameras/[^/]+/(camera\.json|timestamps\.csv|(depth|color)/\d+\.png)"
    r"|truth/(cameras\.json|cloth\.npz|[^/]+/\d+\.png)"
)
"""Pattern of the relative paths of a raw episode's files. `truth/` exists in synthetic episodes only."""
_TOOL = ("tool_x", "tool_y", "tool_z", "tool_qw", "tool_qx", "tool_qy", "tool_qz")
_LATEST_S = 1e6
MOST_HZ = 1e5
"""Highest frame rate that is accepted [Hz]."""
_FARTHEST_RAD, _LARGEST = 200.0, 1e5
"""Largest accepted joint angle [rad] (continuous joints may turn many times), and value of other columns."""
_WRENCH = ("wrench_fx", "wrench_fy", "wrench_fz", "wrench_tx", "wrench_ty", "wrench_tz")


@dataclass(frozen=True)
class CameraInfo:
    """A camera of a raw episode, as `camera.json` describes it."""

    name: str
    serial: str
    intrinsics: Intrinsics
    depth_scale_m: float
    """Metres per unit of the depth image."""
    T_world_camera: NDArray[np.float64] | None = None
    """[4, 4] camera-to-world transform [m]. None if the camera is not calibrated yet or `calibration` names a file."""
    calibration: str | None = None
    """Path of a calibration file, relative to the episode's folder."""
    settings: Mapping[str, float] = field(default_factory=dict)
    """Camera options during the recording, such as `depth.exposure`. Empty if unknown."""

    def to_json(self) -> dict[str, Any]:
        told = {
            "name": self.name,
            "serial": self.serial,
            "intrinsics": self.intrinsics.to_json(),
            "depth_scale_m": self.depth_scale_m,
            "T_world_camera": None if self.T_world_camera is None else self.T_world_camera.tolist(),
            "calibration": self.calibration,
        }
        return told | ({"settings": dict(self.settings)} if self.settings else {})


Name = Annotated[str, Field(max_length=200)]


def _plain_word(name: str) -> str:
    if not _plain(name):
        raise ValueError("it must be a plain folder name, of letters, digits, _, - and .")
    return name


def _depth_scale(scale: float) -> float:
    """Return a valid depth scale [m per unit].

    Raises:
        ValueError: the scale is outside the range of depth cameras.
    """
    if not 1e-6 <= scale <= 0.02:
        raise ValueError("it must be from 1e-6 to 0.02 metres per unit of the depth image; a D435 has 0.001")
    return scale


class CameraFile(Checked):
    """Schema of `camera.json`."""

    name: Name | None = None
    serial: Name
    intrinsics: IntrinsicsFile
    depth_scale_m: Annotated[float, AfterValidator(_depth_scale)]
    T_world_camera: RigidTransform | None = None
    calibration: FileName | None = None
    settings: dict[Name, Annotated[float, Field(ge=-1e9, le=1e9)]] = Field(default_factory=dict)

    def camera(self, name: str) -> CameraInfo:
        """Return the contents of this file as the `CameraInfo` of the camera with this name."""
        place = None if self.T_world_camera is None else np.array(self.T_world_camera)
        held = self.intrinsics.intrinsics()
        return CameraInfo(name, self.serial, held, self.depth_scale_m, place, self.calibration, self.settings)


class PlacementFile(Checked):
    """Schema of `scene_in_world` in `episode.json`; see `ScenePlacement`."""

    origin_m: Vector = (0.0, 0.0, 0.0)
    yaw_rad: Annotated[float, Field(ge=-100, le=100)] = 0.0
    length_unit_m: Annotated[float, Field(ge=1e-3, le=1e3)] = 1.0


class EpisodeFile(Plain):
    """Schema of `episode.json`. Further keys are allowed as the user's own labels."""

    model_config = ConfigDict(frozen=True, extra="allow")

    schema_version: Literal[1]
    scenario: Annotated[Name, AfterValidator(_plain_word)] | None = None
    fabric: Name | None = None
    category: Name | None = None
    repeat: Annotated[int, Field(ge=0, le=1_000_000)] | None = None
    truth: dict[str, Annotated[float, Field(gt=0, le=1e12)]] = Field(default_factory=dict)
    rate_hz: Annotated[float, Field(gt=0, le=MOST_HZ)] | None = None
    cameras: Annotated[list[Annotated[Name, AfterValidator(_plain_word)]], Field(min_length=1, max_length=64)]
    robot: dict[str, Any] | None = None
    source: Name | None = None
    units: dict[str, Any] = UNITS
    started_at: Name | None = None
    status: Literal["recording", "complete", "stopped"] | None = None
    stop_reason: str | None = None
    frames: dict[str, Annotated[int, Field(ge=0, le=100_000_000)]] | None = None
    scene_in_world: PlacementFile = PlacementFile()

    @field_validator("cameras")
    @classmethod
    def _each_once(cls, names: list[str]) -> list[str]:
        if len(set(names)) < len(names):
            raise ValueError("a camera is listed twice")
        return names

    @field_validator("units")
    @classmethod
    def _in_si(cls, units: dict[str, Any]) -> dict[str, Any]:
        if any(units.get(key, value) != value for key, value in UNITS.items()):
            raise ValueError(f"a raw episode is in {UNITS}; convert when you import")
        return units


@dataclass(frozen=True)
class RobotSample:
    """One row of robot.csv. A quantity that the source does not measure is None."""

    t_s: float
    joints_rad: NDArray[np.float64]
    """[J] joint angles."""
    gripper: float | None = None
    """Gripper opening, from 0 (open) to 1 (closed)."""
    tool_position_m: NDArray[np.float64] | None = None
    """[3] in the robot's base frame."""
    tool_quaternion: NDArray[np.float64] | None = None
    """[4] (w, x, y, z)."""
    wrench: NDArray[np.float64] | None = None
    """[6] external force [N] and torque [N·m] at the tool."""


@dataclass(frozen=True)
class RobotLog:
    """Contents of robot.csv, N rows and J joints. Missing values are NaN."""

    times: NDArray[np.float64]
    """[N] [s]."""
    joints_rad: NDArray[np.float64]
    """[N, J]."""
    gripper: NDArray[np.float64]
    """[N] from 0 (open) to 1 (closed)."""
    tool_position_m: NDArray[np.float64]
    """[N, 3] in the robot's base frame."""
    tool_quaternion: NDArray[np.float64]
    """[N, 4] (w, x, y, z)."""
    wrench: NDArray[np.float64]
    """[N, 6] external force [N] and torque [N·m] at the tool."""


@dataclass(frozen=True)
class RawCamera:
    """One camera of a raw episode. Images are read from disk on each call."""

    info: CameraInfo
    folder: Path
    frames: NDArray[np.int64]
    """[T] file numbers of the frames."""
    times: NDArray[np.float64]
    """[T] [s]."""

    def depth(self, index: int) -> NDArray[np.uint16]:
        """Return the depth image [H, W] of frame `index`, in units of `depth_scale_m`. 0 is no measurement."""
        return read_depth(self.folder / "depth" / f"{self.frames[index]:06d}.png")

    def color(self, index: int) -> NDArray[np.uint8] | None:
        """Return the colour image [H, W, 3] of frame `index`, or None if colour was not recorded."""
        path = self.folder / "color" / f"{self.frames[index]:06d}.png"
        return read_color(path) if path.is_file() else None


@dataclass(frozen=True)
class ScenePlacement:
    """Pose and unit of a scene in the robot's base frame: p_scene = Rz(yaw) (p_base - origin) / length_unit."""

    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the scene's origin in the base frame."""
    yaw_rad: float = 0.0
    length_unit_m: float = 1.0

    def to_scene(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Transform base-frame points [..., 3] [m] to the scene's frame and length unit."""
        return (points - np.array(self.origin_m)) @ self.rotation.T / self.length_unit_m

    def to_world(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Transform scene points [..., 3] to the base frame [m]."""
        return self.length_unit_m * points @ self.rotation + np.array(self.origin_m)

    @property
    def rotation(self) -> NDArray[np.float64]:
        """[3, 3] rotation from the base frame to the scene's frame."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class RawEpisode:
    """A raw episode on disk."""

    folder: Path
    description: Mapping[str, Any]
    cameras: Mapping[str, RawCamera]
    robot: RobotLog | None

    @property
    def placement(self) -> ScenePlacement:
        """Placement of the scene in the base frame, from episode.json. Without an entry both frames are the same."""
        return read_placement(self.description.get("scene_in_world") or {})


def read_placement(fields: Mapping[str, Any]) -> ScenePlacement:
    """Return the placement that the fields of `scene_in_world` describe.

    Raises:
        ValidationError: (pydantic's) the fields are not a valid placement.
    """
    stated = PlacementFile.model_validate(fields)
    return ScenePlacement(stated.origin_m, stated.yaw_rad, stated.length_unit_m)


def read_raw_episode(folder: Path) -> RawEpisode:
    """Open a raw episode. `diffcloud.sensing.validation` has further checks of the data.

    Raises:
        EpisodeError: a file is missing or damaged, times do not increase, or a camera has no frame.
    """
    folder = Path(folder)
    description = read_description(folder)
    cameras = {}
    for name in description["cameras"]:
        cameras[name] = camera = read_raw_camera(folder, name)
        if not len(camera.frames):
            raise EpisodeError(f"{camera.folder / 'timestamps.csv'} lists no frame: the camera delivered nothing.")
    robot = None
    if description.get("robot") is not None:
        robot = read_robot_log(folder / "robot.csv", torn=True)
        _refuse_backwards(robot.times, folder / "robot.csv")
    return RawEpisode(folder, description, cameras, robot)


def read_raw_camera(folder: Path, name: str) -> RawCamera:
    """Open one camera of a raw episode. During a recording, it has the frames written so far, possibly none.

    Raises:
        EpisodeError: a file is missing or damaged, or times do not increase. The message names file and row.
    """
    place = folder / "cameras" / name
    frames, times = read_timestamps(place / "timestamps.csv", torn=True)
    _refuse_backwards(times, place / "timestamps.csv")
    return RawCamera(read_camera_info(place / "camera.json"), place, frames, times)


def read_description(folder: Path) -> dict[str, Any]:
    """Read and validate episode.json.

    Raises:
        EpisodeError: the file is missing or damaged, has another schema version, no camera, or other units than SI.
    """
    path = Path(folder) / "episode.json"
    data = read_json(path, error=EpisodeError)
    try:
        told = EpisodeFile.model_validate(data)
    except ValidationError as error:
        raise explain(path, error, EpisodeError) from error
    return told.model_dump(mode="json", exclude_unset=True)


def read_camera_info(path: Path) -> CameraInfo:
    """Read a camera.json file.

    Raises:
        EpisodeError: the file is missing or damaged, or a value is out of range. The message names the field.
    """
    try:
        told = CameraFile.model_validate(read_json(Path(path), error=EpisodeError))
    except ValidationError as error:
        raise explain(path, error, EpisodeError) from error
    return told.camera(told.name or Path(path).parent.name)


def read_timestamps(path: Path, *, torn: bool = False) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the frame numbers [T] and times [T] of timestamps.csv, in the order of the file.

    Args:
        torn: ignore an incomplete last line, as a crash of `RawEpisodeWriter` leaves it.

    Raises:
        EpisodeError: the file is missing, or its columns are not frame and t_s.
    """
    table = _read_table(path, ("frame", "t_s"), torn=torn)
    frames = table["frame"].to_numpy(np.float64)
    if (frames != np.rint(frames)).any() or (frames < 0).any():
        raise EpisodeError(f"{path}: frame numbers must be whole and not negative.")
    if len(np.unique(frames)) < len(frames):
        raise EpisodeError(f"{path} lists a frame twice.")
    return frames.astype(np.int64), table["t_s"].to_numpy(np.float64)


def read_robot_log(path: Path, *, torn: bool = False) -> RobotLog:
    """Read robot.csv. Columns other than t_s and the joints may be absent or empty.

    Args:
        torn: ignore an incomplete last line, as a crash of `RawEpisodeWriter` leaves it.

    Raises:
        EpisodeError: the file is missing, has no columns t_s and joint_1, or has invalid values.
    """
    table = _read_table(path, ("t_s", "joint_1"), torn=torn)
    count = 1
    while f"joint_{count + 1}" in table.columns:
        count += 1
    beyond = [name for name in table.columns if re.fullmatch(r"joint_\d+", name) and int(name[6:]) > count]
    if beyond:
        raise EpisodeError(f"{path} has the column {beyond[0]} and no joint_{count + 1}.")
    joints = table[[f"joint_{index + 1}" for index in range(count)]].to_numpy(np.float64)
    if not np.isfinite(joints).all():
        row = int(np.flatnonzero(~np.isfinite(joints).all(axis=1))[0])
        raise EpisodeError(f"{path}: row {row + 1} lacks a joint angle.")

    if np.abs(joints).max(initial=0.0) > _FARTHEST_RAD:
        raise EpisodeError(f"{path}: a joint angle is {np.abs(joints).max():g}; angles are radians, not degrees or ticks.")

    def columns(names: Sequence[str]) -> NDArray[np.float64]:
        empty = np.full(len(table), np.nan)
        return np.column_stack([table[name].to_numpy(np.float64) if name in table.columns else empty for name in names])

    tool, gripper, wrench = columns(_TOOL), columns(["gripper"])[:, 0], columns(_WRENCH)
    for told, array in (
        ("tool position", tool[:, :3]),
        ("quaternion", tool[:, 3:]),
        ("gripper, 0 open to 1 closed,", gripper),
        ("wrench", wrench),
    ):
        largest = float(np.abs(array[~np.isnan(array)]).max(initial=0.0))
        if largest > _LARGEST:
            raise EpisodeError(f"{path}: a {told} is {largest:g}; at most {_LARGEST:g} can be right. Units are {UNITS}.")
    if np.nanmin(gripper, initial=0.0) < -0.1:
        raise EpisodeError(f"{path}: the gripper is at {np.nanmin(gripper):g}; it is 0 open to 1 closed.")
    return RobotLog(table["t_s"].to_numpy(np.float64), joints, gripper, tool[:, :3], tool[:, 3:], wrench)


def first_backwards(times: NDArray[np.float64]) -> int | None:
    """Return the index of the first time that is not later than its predecessor, or None."""
    bad = np.flatnonzero(~(np.diff(times) > 0))
    return int(bad[0]) + 1 if len(bad) else None


def raw_episode_files(folder: Path) -> tuple[list[str], list[str]]:
    """List the files of a raw episode, and all other files in its folder, without hidden ones (relative paths)."""
    paths = (path for path in Path(folder).rglob("*") if path.is_file())
    names = [path.relative_to(folder) for path in paths]
    seen = sorted(name.as_posix() for name in names if not any(part.startswith(".") for part in name.parts))
    own = [name for name in seen if _FILES.fullmatch(name)]
    return own, sorted(set(seen) - set(own))


def exists_already(folder: Path) -> EpisodeError:
    """Return the error for an attempt to write a raw episode to a folder that already exists."""
    return EpisodeError(f"{folder} exists; raw episodes are never overwritten. Choose another name.")


class RawEpisodeWriter:
    """Write a raw episode during a recording; a context manager.

    Each camera may call `add_frame` from its own thread. Only one thread may add robot rows.

    Args:
        folder: folder to create. An existing folder is an error, since raw episodes are never overwritten.
        cameras: camera name -> description.
        rate_hz: frame rate, None if unknown.
        robot: description of the arm (model, address), None without an arm.
        joint_count: number of joints in robot.csv.
        durable: fsync each frame, so that a power cut does not lose it.
        started_at: start time in ISO 8601, by default now.

    Raises:
        EpisodeError: the folder exists, or a name is not a plain folder name.
        OutputError: the system refused a write (a full disk). The message has the number of complete frames.
    """

    def __init__(
        self,
        folder: Path,
        cameras: Mapping[str, CameraInfo],
        *,
        rate_hz: float | None,
        source: str,
        robot: Mapping[str, Any] | None = None,
        joint_count: int = 7,
        durable: bool = True,
        meta: Mapping[str, Any] | None = None,
        started_at: str | None = None,
    ) -> None:
        self.folder = Path(folder)
        if not cameras:
            raise EpisodeError("A raw episode needs at least one camera.")
        for name in cameras:
            if not _plain(name):
                raise EpisodeError(f"A camera is named by a plain word such as overhead, got {name!r}.")
        try:
            self.folder.mkdir(parents=True, exist_ok=False)
        except FileExistsError as error:
            raise exists_already(folder) from error
        except OSError as error:
            raise OutputError(f"Cannot write {folder}: {error.strerror}.") from error
        self._description: dict[str, Any] = {
            "schema_version": SCHEMA_VERSION,
            **(meta or {}),
            "rate_hz": rate_hz,
            "cameras": list(cameras),
            "robot": None if robot is None else dict(robot),
            "source": source,
            "units": UNITS,
            "started_at": started_at or datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds"),
            "status": "recording",
        }
        self._durable = durable
        self._joint_count = joint_count
        self._cameras = {
            name: _CameraFiles(self.folder / "cameras" / name, info, durable=durable) for name, info in cameras.items()
        }
        self._robot: _Rows | None = None
        if robot is not None:
            joints = [f"joint_{index + 1}" for index in range(joint_count)]
            self._robot = _Rows(self.folder / "robot.csv", ["t_s", *joints, "gripper", *_TOOL, *_WRENCH], durable=durable)
        self.robot_rows = 0
        write_json(self.folder / "episode.json", self._description)
        if durable:  # readers need these files and folders even after a crash
            _sync(self.folder / "episode.json", self.folder, self.folder / "cameras", self.folder.parent)

    @property
    def frame_counts(self) -> dict[str, int]:
        """Number of complete frames of each camera."""
        return {name: files.count for name, files in self._cameras.items()}

    def add_frame(self, camera: str, t_s: float, depth: NDArray[np.uint16], color: NDArray[np.uint8] | None = None) -> None:
        """Write one frame of one camera. The frame is complete when this method returns."""
        self._cameras[camera].add(t_s, depth, color)

    def add_robot(self, *samples: RobotSample) -> None:
        """Write rows of robot.csv, with at most one fsync for all of them."""
        if self._robot is None:
            raise EpisodeError("This episode was opened without a robot.")
        rows = []
        for sample in samples:
            if len(sample.joints_rad) != self._joint_count:
                raise EpisodeError(f"A robot row has {len(sample.joints_rad)} joints, the log {self._joint_count}.")
            unknown = np.full(3, np.nan)
            position = unknown if sample.tool_position_m is None else sample.tool_position_m
            quaternion = np.full(4, np.nan) if sample.tool_quaternion is None else sample.tool_quaternion
            wrench = np.full(6, np.nan) if sample.wrench is None else sample.wrench
            gripper = np.nan if sample.gripper is None else sample.gripper
            rows.append([sample.t_s, *sample.joints_rad, gripper, *position, *quaternion, *wrench])
        if rows:
            self._robot.append(*rows)
            self.robot_rows += len(rows)

    def state_rate(self, rate_hz: float | None) -> None:
        """Set the frame rate afterwards, if it is known only at the end of the recording."""
        self._description["rate_hz"] = rate_hz

    def close(self, *, stop_reason: str | None = None) -> None:
        """Finish with status `complete`, or `stopped` if a reason is given. Further calls have no effect."""
        if self._description["status"] != "recording":
            return
        for rows in (*(files.rows for files in self._cameras.values()), *([] if self._robot is None else [self._robot])):
            rows.close()
        self._description["status"] = "complete" if stop_reason is None else "stopped"
        if stop_reason is not None:
            self._description["stop_reason"] = stop_reason
        self._description["frames"] = self.frame_counts
        write_json(self.folder / "episode.json", self._description)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        reason = None if kind is None else f"{kind.__name__}: {error}"
        try:
            self.close(stop_reason=reason)
        except DiffCloudError:
            if error is None:  # otherwise the error inside the block has already reported a full disk
                raise


class _CameraFiles:
    """Image folders and timestamps.csv of one camera that is being recorded."""

    def __init__(self, folder: Path, info: CameraInfo, *, durable: bool) -> None:
        self._folder, self._durable = folder, durable
        self._shape = (info.intrinsics.height, info.intrinsics.width)
        self.count = 0
        write_json(folder / "camera.json", info.to_json())
        self.rows = _Rows(folder / "timestamps.csv", ["frame", "t_s"], durable=durable)
        if durable:
            _sync(folder / "camera.json", folder)

    def add(self, t_s: float, depth: NDArray[np.uint16], color: NDArray[np.uint8] | None) -> None:
        for kind, image in (("depth", depth), ("colour", color)):
            if image is not None and image.shape[:2] != self._shape:
                raise EpisodeError(
                    f"{self._folder.name}: a {kind} image has {image.shape[1]} x {image.shape[0]} pixels where the camera "
                    f"has {self._shape[1]} x {self._shape[0]}."
                )
        try:
            name = f"{self.count:06d}.png"
            write_depth(self._folder / "depth" / name, depth, durable=self._durable)
            if color is not None:
                write_color(self._folder / "color" / name, color, durable=self._durable)
            if self._durable:
                _sync(self._folder / "depth")
                if color is not None:
                    _sync(self._folder / "color")
                if self.count == 0:
                    _sync(self._folder)  # the image folders in it are new
            self.rows.append([self.count, t_s])
        except (OSError, DiffCloudError) as error:
            kept = f" The {self.count} frames before it are kept." if self._durable else ""
            raise OutputError(
                f"Frame {self.count} of camera {self._folder.name} could not be written: {str(error).rstrip('.')}.{kept}"
            ) from error
        self.count += 1


class _Rows:
    """A CSV file to which complete lines are appended without buffering."""

    def __init__(self, path: Path, columns: Sequence[str], *, durable: bool) -> None:
        self._durable, self._path = durable, path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # Unbuffered, so that closing the file does not retry a write that a full disk refused.
            self._stream = path.open("xb", buffering=0)
        except OSError as error:
            raise OutputError(f"Cannot write {path}: {error.strerror}.") from error
        self._write(",".join(columns))

    def append(self, *rows: Sequence[float]) -> None:
        self._write("\n".join(",".join("" if np.isnan(value) else f"{value:.9g}" for value in row) for row in rows))

    def close(self) -> None:
        self._stream.close()

    def _write(self, line: str) -> None:
        try:
            data = (line + "\n").encode()
            if self._stream.write(data) != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            if self._durable:
                os.fsync(self._stream.fileno())
        except OSError as error:
            raise OutputError(f"Cannot write {self._path}: {error.strerror}.") from error


def _sync(*paths: Path) -> None:
    """Flush files and folders to the disk (fsync)."""
    for path in paths:
        try:
            handle = os.open(path, os.O_RDONLY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)
        except OSError as error:
            raise OutputError(f"Cannot write {path}: {error.strerror}.") from error


def _plain(name: str) -> bool:
    return bool(name) and name not in (".", "..") and all(letter.isalnum() or letter in "_-." for letter in name)


def _refuse_backwards(times: NDArray[np.float64], path: Path) -> None:
    bad = first_backwards(times)
    if bad is not None:
        raise EpisodeError(
            f"{path}: row {bad + 1}: the time runs backwards ({times[bad]:.6f} s after {times[bad - 1]:.6f} s); the clock "
            "was set while recording, or rows were mixed up."
        )
    if len(times) and max(abs(times[0]), abs(times[-1])) > _LATEST_S:
        raise EpisodeError(f"{path}: a time is {times[-1]:g}; times are seconds since the start of the recording.")


def _read_table(path: Path, required: Sequence[str], *, torn: bool) -> pd.DataFrame:
    table = read_csv(path, kind="table", error=EpisodeError, torn=torn)
    if not np.isfinite(numbers(table, required, place=str(path), error=EpisodeError)).all():
        raise EpisodeError(f"{path}: a cell of {', '.join(required)} is empty or infinite.")
    names = [str(name) for name in table]
    return pd.DataFrame(numbers(table, names, place=str(path), error=EpisodeError), columns=names)
