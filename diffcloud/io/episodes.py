"""Episodes: recorded point clouds over time, stored as one `.npz` file without pickles.

P points, T frames, G grippers, C cameras. Fields: `points` float32 [P, 3] (all frames concatenated), `offsets` int64
[T+1], `times` [T] [s] since the start, and `meta`, a JSON string. Optional: `gripper` [T, G, 3], `grippers` [G]
(names), `camera` uint8 [P], `pixel` uint16 [P, 2], `sigma` float32 [P] [m], and `lost` uint8 [T, C, bytes]. Positions
are in the frame and length unit of the scene.
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
"""Name of the gripper if there is only one."""
_FARTHEST = 1e6
"""Largest accepted coordinate of a point [m] and largest time [s]."""
_MOST_PIXELS = 2**26
_MOST_SIZES, _SMALLEST = 10.0, 0.5
"""Largest distance of a gripper from the centre of the clouds, as a multiple of their size. Sizes below `_SMALLEST` [m]
are replaced by it."""
_LATEST = 1e3
"""Largest clock offset and largest standard deviation of it [s]."""
_FASTEST = 100.0
"""Highest gripper speed [m/s]. It is far above any arm's speed, for scenes whose unit is a decimetre."""


@dataclass(frozen=True)
class Pinhole:
    """A pinhole camera without lens distortion. Pixel centres have whole coordinates."""

    width: int
    height: int
    focal: tuple[float, float]
    """(fx, fy) in pixels."""
    centre: tuple[float, float]
    """(cx, cy) in pixels."""
    T_camera_scene: NDArray[np.float64]
    """[3, 4] scene-to-camera transform, in the scene's length unit. Camera axes: x right, y down, z forward."""

    @staticmethod
    def of(told: Mapping[str, Any]) -> Pinhole:
        """Build the camera from a mapping as `described` returns it.

        Raises:
            KeyError, TypeError, ValueError: the mapping does not describe a camera.
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
        """[3] position of the camera in the scene."""
        return np.asarray(-self.T_camera_scene[:, :3].T @ self.T_camera_scene[:, 3])

    def described(self) -> dict[str, Any]:
        """Return the camera as a JSON-compatible mapping, the form in an episode's `meta`."""
        pose = self.T_camera_scene.tolist()
        return {"size": [self.width, self.height], "focal": self.focal, "centre": self.centre, "T_camera_scene": pose}


@dataclass(frozen=True)
class Clock:
    """Clock offset of a camera: a point stamped t belongs to the motion at t + `offset_s`."""

    offset_s: float
    sigma_s: float
    """Standard deviation of the offset. It is zero for the camera whose clock is the reference."""


@dataclass(frozen=True)
class Episode:
    """A recorded episode.

    Raises:
        EpisodeError: a wrong shape, an empty frame, points that are not finite, or times that do not increase.
    """

    points: NDArray[np.float32]
    """[P, 3] points of all frames, concatenated."""
    offsets: NDArray[np.int64]
    """[T + 1] frame t is points[offsets[t]:offsets[t + 1]]."""
    times: NDArray[np.float64]
    """[T] since the start of the motion [s]."""
    gripper: NDArray[np.float64] | None = None
    """[T, G, 3] positions of the grippers. If None, the scene defines the gripper motion."""
    grippers: tuple[str, ...] = ONLY_GRIPPER
    """[G] gripper names, as in the scene."""
    camera: NDArray[np.uint8] | None = None
    """[P] index of the camera that saw the point."""
    pixel: NDArray[np.uint16] | None = None
    """[P, 2] image position (column, row) of the point."""
    sigma: NDArray[np.float32] | None = None
    """[P] standard deviation of the depth [m]."""
    lost: NDArray[np.uint8] | None = None
    """[T, C, bytes] invalid-pixel mask of each of the C `pinholes`, one bit per pixel, row by row. A set bit marks a
    pixel in which the cloth cannot be seen: no depth, robot, robot shadow or image border."""
    meta: Mapping[str, Any] = field(default_factory=dict)
    """Labels (scenario, fabric, category, repeat), camera data, true parameters and quality figures."""

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
        """Check that each gripper stays near the clouds and has a plausible speed. Others would take hours to simulate.

        Raises:
            EpisodeError: a gripper is too far away or too fast.
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
        """Camera name -> position [3] in the scene. Empty if unknown.

        Raises:
            EpisodeError: `viewpoints` of the meta is not a mapping to finite positions.
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
        """Camera name -> plane [4] (a, b, c, d): the camera's points were cropped to a x + b y + c z >= d.

        Cameras whose points were not cropped are absent.

        Raises:
            EpisodeError: `cut_planes` of the meta are invalid, or name a camera that is not in `cameras`.
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
        """Standard deviation [s] of the clock offset that preprocessing estimated, or None if it did not estimate one.

        Raises:
            EpisodeError: the meta's value is not a positive number.
        """
        quality = self.meta.get("quality") or {}
        refinement = quality.get("refinement") or {} if isinstance(quality, Mapping) else {}
        told = refinement.get("lag_sigma_s") if isinstance(refinement, Mapping) else None
        if told in (None, 0):  # the arm was not visible
            return None
        if isinstance(told, bool) or not isinstance(told, int | float) or not 0 < told < _FARTHEST:
            raise EpisodeError(f"lag_sigma_s of an episode's refinement is a positive number of seconds, got {told!r}.")
        return float(told)

    @property
    def clocks(self) -> dict[str, Clock]:
        """Camera name -> clock, in the order of the indices in `camera`. Empty if the meta has no `clocks`.

        Cameras without an entry have offset 0.

        Raises:
            EpisodeError: `clocks` of the meta are invalid, or points have no valid camera index.
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
        """Standard deviation of the clouds' length scale, as a fraction, or None if the meta does not have it.

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
        """Pose variable -> prior standard deviation [m, rad, s], for variables with another than the default value.

        Raises:
            EpisodeError: the meta's `pose_sigmas` are not positive numbers.
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
        """[C] cameras that have an invalid-pixel mask in `lost`. Empty if there is none.

        Raises:
            EpisodeError: `pinholes` of the meta are not valid cameras.
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
        """Return the invalid-pixel mask [T, H, W] of the camera with this index in `pinholes`."""
        assert self.lost is not None
        pinhole = self.pinholes[camera]
        bits = np.unpackbits(self.lost[:, camera], axis=-1, count=pinhole.width * pinhole.height)
        return bits.astype(bool).reshape(-1, pinhole.height, pinhole.width)

    def frame(self, index: int) -> NDArray[np.float32]:
        """Return the points [N, 3] of one frame. Negative indices count from the end.

        Raises:
            EpisodeError: the frame does not exist.
        """
        position = index + self.frame_count if index < 0 else index
        if not 0 <= position < self.frame_count:
            raise EpisodeError(
                f"Frame {index} is missing: the episode has {self.frame_count} frames. Record the whole motion, or choose "
                "another loss frame."
            )
        return self.points[self.offsets[position] : self.offsets[position + 1]]

    def select(self, kept: NDArray[np.bool_] | NDArray[np.int64]) -> Episode:
        """Return the episode with a subset of its points, given as a mask [P] or as ascending indices.

        Raises:
            EpisodeError: a frame would have no points.
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

    def select_frames(self, kept: NDArray[np.int64]) -> Episode:
        """Return the episode with some of its frames.

        Args:
            kept: indices of the frames, ascending.
        """
        counts = np.diff(self.offsets)
        points = np.isin(np.repeat(np.arange(self.frame_count), counts), kept)
        return replace(
            self,
            points=self.points[points],
            offsets=np.cumsum([0, *counts[kept]], dtype=np.int64),
            times=self.times[kept],
            gripper=None if self.gripper is None else self.gripper[kept],
            camera=None if self.camera is None else self.camera[points],
            pixel=None if self.pixel is None else self.pixel[points],
            sigma=None if self.sigma is None else self.sigma[points],
            lost=None if self.lost is None else self.lost[kept],
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
        """Build an episode from one cloud [N_t, 3] per frame. The other arguments are the fields of the same name."""
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
    """Write an episode atomically. The same episode always gives the same bytes."""
    arrays: dict[str, Any] = {"points": episode.points, "offsets": episode.offsets, "times": episode.times}
    arrays |= {name: getattr(episode, name) for name in sorted(_OPTIONAL) if getattr(episode, name) is not None}
    arrays.pop("grippers")
    if episode.gripper is not None:
        arrays["grippers"] = np.array(episode.grippers)
    arrays["meta"] = np.array(json.dumps(dict(episode.meta), sort_keys=True, allow_nan=False))
    write_npz(path, **arrays)


def read_episode(path: Path) -> Episode:
    """Read and check an episode. Files of earlier versions with a gripper track [T, 3] are read as having one gripper.

    Raises:
        EpisodeError: the file is missing, damaged, or not a valid episode. The message names the file and the field.
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
