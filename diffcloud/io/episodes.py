"""Episodes: recorded point clouds over time, as one `.npz` without pickles.

Fields: `points` float32 [P, 3] of all frames joined, `offsets` int64 [T+1], `times` [T] since the start [s], optional
`gripper` [T, G, 3] of the `grippers` [G] (names), optional per-point `camera` uint8, `pixel` uint16 [P, 2], `sigma`
float32 [P] [m], optional `lost` uint8 [T, C, bytes], and `meta`, a JSON string. All in the frame and length unit of the
scenario's scene.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError
from diffcloud.io.arrays import read_npz
from diffcloud.io.files import write_npz

_OPTIONAL = {"gripper", "grippers", "camera", "pixel", "sigma", "lost"}
_REQUIRED = {"points", "offsets", "times", "meta"}
ONLY_GRIPPER = ("gripper",)
"""The name of a single one."""
_FARTHEST = 1e6
"""[m, s] Of a point, and of a time."""
_MOST_PIXELS = 2**26
_MOST_SIZES, _SMALLEST = 10.0, 0.5
"""How far a gripper may be from the middle of the clouds, in their size, which counts as this much at least [m]."""
_LATEST = 1e3
"""[s] Of the offset of a clock, and of its deviation."""
_FASTEST = 100.0
"""[m/s] Of a gripper; far more than an arm reaches, also where the scene's unit is a decimetre."""


@dataclass(frozen=True)
class Pinhole:
    """A camera without distortion, pixel centres at whole numbers."""

    width: int
    height: int
    focal: tuple[float, float]
    """(fx, fy) in pixels."""
    centre: tuple[float, float]
    """(cx, cy)"""
    T_camera_scene: NDArray[np.float64]
    """[3, 4] maps points of the scene to the camera's frame: x right, y down, z forward; in the scene's length unit."""

    @staticmethod
    def of(told: Mapping[str, Any]) -> Pinhole:
        """The inverse of `described`.

        Raises:
            KeyError, TypeError, ValueError: no such camera.
        """
        width, height = (int(side) for side in told["size"])
        (fx, fy), (cx, cy) = (tuple(map(float, told[name])) for name in ("focal", "centre"))
        pose = np.array(told["T_camera_scene"], dtype=np.float64)
        sound = pose.shape == (3, 4) and np.isfinite([*pose.ravel(), fx, fy, cx, cy]).all() and min(fx, fy) > 0
        if not sound or min(width, height) < 1 or width * height > _MOST_PIXELS:
            raise ValueError("not a camera")
        return Pinhole(width, height, (fx, fy), (cx, cy), pose)

    @property
    def position(self) -> NDArray[np.float64]:
        """[3] where the camera stands in the scene."""
        return np.asarray(-self.T_camera_scene[:, :3].T @ self.T_camera_scene[:, 3])

    def described(self) -> dict[str, Any]:
        """As an episode's meta has it."""
        pose = self.T_camera_scene.tolist()
        return {"size": [self.width, self.height], "focal": self.focal, "centre": self.centre, "T_camera_scene": pose}


@dataclass(frozen=True)
class Clock:
    """How late a camera stamps what it sees: a point stamped t shows the motion at t + offset."""

    offset_s: float
    sigma_s: float
    """Standard deviation of it; zero of the camera to whose clock the offsets of the others refer."""


@dataclass(frozen=True)
class Episode:
    """A recorded episode.

    Raises:
        EpisodeError: a wrong shape, an empty frame, NaN/Inf points, or times that do not increase.
    """

    points: NDArray[np.float32]
    """[P, 3] of all frames joined."""
    offsets: NDArray[np.int64]
    """[T + 1] frame t holds points[offsets[t]:offsets[t + 1]]."""
    times: NDArray[np.float64]
    """[T] since the start of the motion [s]."""
    gripper: NDArray[np.float64] | None = None
    """[T, G, 3] position of each gripper's tool; None: the scene's own motion drives the handles."""
    grippers: tuple[str, ...] = ONLY_GRIPPER
    """[G] their names, as scenarios know them."""
    camera: NDArray[np.uint8] | None = None
    """[P] which camera saw the point."""
    pixel: NDArray[np.uint16] | None = None
    """[P, 2] (column, row)."""
    sigma: NDArray[np.float32] | None = None
    """[P] standard deviation of the depth [m]."""
    lost: NDArray[np.uint8] | None = None
    """[T, C, bytes] for each of the C `pinholes`, the pixels in which it could not show the cloth: without depth, on the
    robot or in its shadow, at a border. Rows one after the other, a bit for each pixel."""
    meta: Mapping[str, Any] = field(default_factory=dict)
    """scenario, fabric, category, repeat, truth, published predictions, quality figures."""

    def __post_init__(self) -> None:
        points, offsets, times = self.points, self.offsets, self.times
        if points.ndim != 2 or points.shape[1] != 3:
            raise EpisodeError(f"points must have shape [points, 3], got {list(points.shape)}.")
        if times.ndim != 1:
            raise EpisodeError(f"times must have shape [frames], got {list(times.shape)}.")
        count = len(times)
        if count < 1 or offsets.shape != (count + 1,) or offsets[0] != 0 or offsets[-1] != len(points):
            raise EpisodeError(
                f"offsets must be {count + 1} numbers from 0 to {len(points)} for {count} frames, got shape "
                f"{list(offsets.shape)}."
            )
        empty = np.flatnonzero(np.diff(offsets) <= 0)
        if len(empty):
            raise EpisodeError(f"Frame {empty[0]} is empty; every frame needs at least one point.")
        if not np.isfinite(points).all():
            bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
            frame = int(np.searchsorted(offsets, bad, side="right")) - 1
            raise EpisodeError(f"Frame {frame} holds NaN or infinite points; remove them when you import.")
        if not np.isfinite(times).all() or (np.diff(times) <= 0).any() or times[0] < 0:
            raise EpisodeError("times must increase from 0 or later; sort the frames and remove repeats.")
        for name, width in (("camera", ()), ("pixel", (2,)), ("sigma", ())):
            value = getattr(self, name)
            if value is not None and value.shape != (len(points), *width):
                raise EpisodeError(f"{name} must have shape {[len(points), *width]}, got {list(value.shape)}.")
        if self.sigma is not None and not ((self.sigma >= 0) & (self.sigma < _FARTHEST)).all():
            raise EpisodeError("sigma must be standard deviations [m], finite and not negative.")
        if self.lost is not None:
            most = max((pinhole.width * pinhole.height for pinhole in self.pinholes), default=0)
            shape = (count, len(self.pinholes), (most + 7) // 8)
            if self.lost.shape != shape or not most:
                raise EpisodeError(
                    f"lost must be {list(shape)} bytes (frames, `pinholes` of the meta, bits of their pixels), got "
                    f"{list(self.lost.shape)}."
                )
        if max(float(points.max()), -float(points.min()), float(times[-1])) > _FARTHEST:
            raise EpisodeError(f"Points or times lie beyond {_FARTHEST:g} m or s; they are in the wrong unit, or damaged.")
        if self.gripper is not None:
            names = self.grippers
            if len(set(names)) < len(names) or not all(names):
                raise EpisodeError(f"Each gripper needs a name of its own, got {list(names)}.")
            if self.gripper.shape != (count, len(names), 3) or not np.isfinite(self.gripper).all():
                raise EpisodeError(
                    f"gripper must be finite positions {[count, len(names), 3]} (frames, grippers, axes), got "
                    f"{list(self.gripper.shape)}."
                )
            self._refuse_implausible_track(self.gripper)

    def _refuse_implausible_track(self, gripper: NDArray[np.float64]) -> None:
        """
        Raises:
            EpisodeError: a gripper that holds no cloth of these clouds: a simulation would follow it for hours.
        """
        low, high = self.points.min(axis=0).astype(np.float64), self.points.max(axis=0).astype(np.float64)
        size = max(float(np.linalg.norm(high - low)), _SMALLEST)
        away = np.linalg.norm(gripper - (low + high) / 2, axis=-1)
        frame, which = np.unravel_index(away.argmax(), away.shape)
        if away.max() > _MOST_SIZES * size:
            raise EpisodeError(
                f"In frame {frame} the gripper {self.grippers[which]!r} is {away.max():.3g} m away from the middle of the "
                f"clouds, which are {size:.2g} m large. It may be {_MOST_SIZES:g} times their size away. Give its "
                "positions in metres, not millimetres, in the frame of the clouds."
            )
        if len(gripper) > 1:
            speed = np.linalg.norm(np.diff(gripper, axis=0), axis=-1) / np.diff(self.times)[:, None]
            frame, which = np.unravel_index(speed.argmax(), speed.shape)
            if speed.max() > _FASTEST:
                raise EpisodeError(
                    f"After frame {frame} the gripper {self.grippers[which]!r} moves at {speed.max():.3g} m/s. It may move "
                    f"at {_FASTEST:g} m/s. Give times in seconds and positions in metres, and look for rows in disorder."
                )

    @property
    def frame_count(self) -> int:
        return len(self.times)

    @property
    def viewpoints(self) -> dict[str, NDArray[np.float64]]:
        """Camera -> [3] where it stood; empty where that is not known.

        Raises:
            EpisodeError: `viewpoints` of the meta are no finite positions.
        """
        told = self.meta.get("viewpoints") or {}
        try:
            found = {str(name): np.array(place, dtype=np.float64) for name, place in told.items()}
        except (AttributeError, TypeError, ValueError):
            found = {"": np.empty(0)}
        if not all(place.shape == (3,) and np.isfinite(place).all() for place in found.values()):
            raise EpisodeError(f"viewpoints of an episode's meta are camera -> [x, y, z], finite, got {told!r}.")
        return found

    @property
    def cut_planes(self) -> dict[str, NDArray[np.float64]]:
        """Camera -> [4] (a, b, c, d): the camera shows only points of the scene with a x + b y + c z >= d. Cameras whose
        points were not cut have none.

        Raises:
            EpisodeError: `cut_planes` of the meta are no planes of its `cameras`.
        """
        told, cameras = self.meta.get("cut_planes"), self.meta.get("cameras")
        if not told:
            return {}
        try:
            found = {str(name): np.array(plane, dtype=np.float64) for name, plane in told.items()}
        except (AttributeError, TypeError, ValueError):
            found = {"": np.empty(0)}
        if not (isinstance(cameras, list) and set(found) <= set(map(str, cameras))) or not all(
            plane.shape == (4,) and np.isfinite(plane).all() and plane[:3].any() for plane in found.values()
        ):
            raise EpisodeError(
                f"cut_planes of the episode's meta are {told!r}, with the cameras {cameras!r}. They are camera -> "
                "[a, b, c, d], finite, with a, b, c not all zero. Correct them, or remove `cut_planes`."
            )
        return found

    @property
    def lag_sigma_s(self) -> float | None:
        """Standard deviation with which preprocessing has measured how late the joint log is; None where it has not.

        Raises:
            EpisodeError: the meta's is no positive number.
        """
        quality = self.meta.get("quality") or {}
        refinement = quality.get("refinement") or {} if isinstance(quality, Mapping) else {}
        told = refinement.get("lag_sigma_s") if isinstance(refinement, Mapping) else None
        if told in (None, 0):  # no arm showed it
            return None
        if isinstance(told, bool) or not isinstance(told, int | float) or not 0 < told < _FARTHEST:
            raise EpisodeError(f"lag_sigma_s of an episode's refinement is a positive number of seconds, got {told!r}.")
        return float(told)

    @property
    def clocks(self) -> dict[str, Clock]:
        """Camera -> its clock, in the order in which `camera` numbers them; empty where the meta states none. Cameras that
        its `clocks` leave out have no offset.

        Raises:
            EpisodeError: the meta's `clocks` are no offsets of its `cameras`, or points do not name their camera.
        """
        told = self.meta.get("clocks")
        if not told:
            return {}
        cameras = self.meta.get("cameras")
        if not (isinstance(cameras, list) and cameras and all(isinstance(name, str) for name in cameras)):
            raise EpisodeError(
                f"The episode's meta has clocks, and its cameras are {cameras!r}. Clocks need the list of the cameras' "
                "names, in the order in which points number them. Add `cameras`, or remove `clocks`."
            )
        if not (isinstance(told, Mapping) and set(told) <= set(cameras) and all(map(_is_clock, told.values()))):
            raise EpisodeError(
                f"clocks in an episode's meta are {told!r}. They may hold, for each of the cameras {', '.join(cameras)}, "
                "offset_s and sigma_s in seconds, sigma_s not negative. Correct them, or remove `clocks`."
            )
        if self.camera is None or int(self.camera.max()) >= len(cameras):
            raise EpisodeError(
                "The episode's meta has the clocks of its cameras, but some points name none of them. With `clocks`, every "
                "point names one of the cameras. Give each point its `camera`, or remove `clocks`."
            )
        stated = {name: Clock(float(one["offset_s"]), float(one["sigma_s"])) for name, one in told.items()}
        return {name: stated.get(name, Clock(0.0, 0.0)) for name in cameras}

    @property
    def scale_sigma(self) -> float | None:
        """By what fraction distances in the clouds may be off, one standard deviation; None where the meta does not say.

        Raises:
            EpisodeError: the meta's value is not between 0 and 1.
        """
        told = self.meta.get("scale_sigma")
        if told is None:
            return None
        if isinstance(told, bool) or not isinstance(told, int | float) or not 0 < told < 1:
            raise EpisodeError(f"scale_sigma in an episode's meta must be a fraction between 0 and 1, got {told!r}.")
        return float(told)

    @property
    def pose_sigmas(self) -> dict[str, float]:
        """Standard deviations of variables of the pose that the recording knows better or worse than usual [m, rad, s].

        Raises:
            EpisodeError: the meta's `pose_sigmas` are no positive numbers.
        """
        told = self.meta.get("pose_sigmas") or {}
        values = list(told.values()) if isinstance(told, Mapping) else [None]
        if not all(isinstance(one, int | float) and not isinstance(one, bool) and 0 < one < _FARTHEST for one in values):
            raise EpisodeError(
                f"pose_sigmas of an episode's meta are {told!r}. They may be variable -> positive number [m, rad, s]. "
                "Correct them, or remove `pose_sigmas`."
            )
        return {str(name): float(one) for name, one in told.items()}

    @cached_property
    def pinholes(self) -> tuple[Pinhole, ...]:
        """[C] the cameras whose lost pixels are known; empty where none is.

        Raises:
            EpisodeError: `pinholes` of the meta are no cameras.
        """
        told = self.meta.get("pinholes") or {}
        try:
            return tuple(Pinhole.of(one) for one in told.values())
        except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
            raise EpisodeError(
                "pinholes of an episode's meta are camera -> size [width, height], focal [fx, fy] and centre [cx, cy] in "
                f"pixels, and T_camera_scene, 3 rows of 4; got {told!r}."
            ) from error

    def lost_pixels(self, camera: int) -> NDArray[np.bool_]:
        """[T, H, W] of one of the `pinholes`."""
        assert self.lost is not None
        pinhole = self.pinholes[camera]
        bits = np.unpackbits(self.lost[:, camera], axis=-1, count=pinhole.width * pinhole.height)
        return bits.astype(bool).reshape(-1, pinhole.height, pinhole.width)

    def frame(self, index: int) -> NDArray[np.float32]:
        """[N, 3] points of one frame; negative indices count from the end.

        Raises:
            EpisodeError: no such frame.
        """
        position = index + self.frame_count if index < 0 else index
        if not 0 <= position < self.frame_count:
            raise EpisodeError(
                f"Frame {index} is missing: the episode has {self.frame_count} frames. Record the whole motion, or choose "
                "another loss frame."
            )
        return self.points[self.offsets[position] : self.offsets[position + 1]]

    def select(self, kept: NDArray[np.bool_] | NDArray[np.int64]) -> Episode:
        """The points to keep: a mask [P], or indices that go up.

        Raises:
            EpisodeError: a frame of which nothing is kept.
        """
        chosen = np.flatnonzero(kept) if kept.dtype == bool else kept
        return replace(
            self,
            points=self.points[chosen],
            offsets=np.searchsorted(chosen, self.offsets),
            camera=None if self.camera is None else self.camera[chosen],
            pixel=None if self.pixel is None else self.pixel[chosen],
            sigma=None if self.sigma is None else self.sigma[chosen],
        )

    @staticmethod
    def from_frames(
        frames: Sequence[NDArray[np.floating[Any]]],
        times: NDArray[np.float64],
        *,
        gripper: NDArray[np.float64] | None = None,
        grippers: tuple[str, ...] = ONLY_GRIPPER,
        meta: Mapping[str, Any] | None = None,
    ) -> Episode:
        """Join clouds [N_t, 3]; the rest as of the fields."""
        for index, frame in enumerate(frames):
            if frame.ndim != 2 or frame.shape[1] != 3:
                raise EpisodeError(f"Frame {index} must have shape [points, 3], got {list(frame.shape)}.")
        if not frames:
            raise EpisodeError("An episode needs at least one frame.")
        return Episode(
            points=np.concatenate(frames).astype(np.float32),
            offsets=np.cumsum([0, *(len(frame) for frame in frames)], dtype=np.int64),
            times=np.asarray(times, dtype=np.float64),
            gripper=gripper,
            grippers=grippers,
            meta=dict(meta or {}),
        )


def _is_clock(told: object) -> bool:
    if not (isinstance(told, Mapping) and set(told) == {"offset_s", "sigma_s"}):
        return False
    if any(isinstance(one, bool) or not isinstance(one, int | float) for one in told.values()):
        return False
    return abs(told["offset_s"]) < _LATEST and 0 <= told["sigma_s"] < _LATEST


def write_episode(path: Path, episode: Episode) -> None:
    """Write atomically; the same episode gives the same bytes."""
    arrays: dict[str, Any] = {"points": episode.points, "offsets": episode.offsets, "times": episode.times}
    arrays |= {name: getattr(episode, name) for name in sorted(_OPTIONAL) if getattr(episode, name) is not None}
    arrays.pop("grippers")
    if episode.gripper is not None:
        arrays["grippers"] = np.array(episode.grippers)
    arrays["meta"] = np.array(json.dumps(dict(episode.meta), sort_keys=True, allow_nan=False))
    write_npz(path, **arrays)


def read_episode(path: Path) -> Episode:
    """Read and check an episode. A track [T, 3], as earlier versions wrote it, is that of the only gripper.

    Raises:
        EpisodeError: missing, damaged, not an episode, or wrong inside; names the file and the field.
    """
    path = Path(path)
    arrays = read_npz(path, kind="episode", error=EpisodeError)
    names = set(arrays)
    if not names >= _REQUIRED or not names <= _REQUIRED | _OPTIONAL:
        raise EpisodeError(
            f"{path} has the fields {sorted(names)}; an episode has {sorted(_REQUIRED)} and may have {sorted(_OPTIONAL)}."
        )
    try:
        meta = json.loads(str(arrays.pop("meta")))
    except (ValueError, RecursionError) as error:
        raise EpisodeError(f"{path}: meta is not readable JSON: {error}.") from error
    kinds = {"points": np.float32, "offsets": np.int64, "times": np.float64, "gripper": np.float64}
    kinds |= {"grippers": np.str_, "camera": np.uint8, "pixel": np.uint16, "sigma": np.float32, "lost": np.uint8}
    try:
        converted = {name: array.astype(kinds[name], casting="same_kind", copy=False) for name, array in arrays.items()}
        if not isinstance(meta, dict):
            raise EpisodeError(f"meta must be a JSON object, got {type(meta).__name__}.")
        if converted.get("grippers", np.zeros(1)).ndim != 1:
            raise EpisodeError("grippers must be a list of names.")
        gripper, grippers = converted.pop("gripper", None), converted.pop("grippers", np.array(ONLY_GRIPPER))
        if gripper is not None and gripper.ndim == 2:
            gripper = gripper[:, None]
        return Episode(**converted, gripper=gripper, grippers=tuple(map(str, grippers.ravel())), meta=meta)
    except TypeError as error:
        raise EpisodeError(f"{path}: a field has the wrong type: {error}.") from error
    except EpisodeError as error:
        raise EpisodeError(f"{path}: {error}") from error
