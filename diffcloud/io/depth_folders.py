"""Import folders of PNG depth images with a camera JSON, as Open3D and simple recorders write them.

<folder>/depth/*.png            16-bit, named by frame number or by time (`io.frame_names`)
<folder>/color/*.png or *.jpg   optional; same frame numbers, or the nearest times
<folder>/camera.json            as in raw episodes, or Open3D's {width, height, intrinsic_matrix (column-major),
depth_scale} <folder>/timestamps.csv         frame, t_s; optional if names are times or the frame rate is given
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from diffcloud.errors import EpisodeError
from diffcloud.io.camera_models import Intrinsics, IntrinsicsFile, Pixels
from diffcloud.io.files import files_in, read_json
from diffcloud.io.frame_names import NamedFrames, named_frames
from diffcloud.io.images import read_color, read_depth
from diffcloud.io.raw_episodes import CameraFile, CameraInfo, Name, first_backwards, read_timestamps
from diffcloud.io.recordings import RecordedFrame, Recording, check_frame_rate
from diffcloud.io.ros.pairing import pair
from diffcloud.io.schema import Component, explain

_IMAGES = (".png", ".jpg", ".jpeg")
_JSON_NAMES = ("camera.json", "intrinsics.json", "camera_intrinsic.json", "intrinsic.json")


def depth_folders(folders: Mapping[str, Path], *, rate_hz: float | None = None) -> Recording:
    """Build a recording from one folder per camera.

    Args:
        folders: camera name -> folder.
        rate_hz: frame rate, if there is no timestamps.csv and names are not times.

    Raises:
        EpisodeError: images, camera JSON, times or frame numbers are missing, or depth is JPEG. Also if times do not
            increase or contradict each other, or the rate is invalid.
    """
    cameras = {name: _camera(Path(folder), name) for name, folder in folders.items()}
    named = {name: named_frames(Path(folder) / "depth", _IMAGES, kind="images") for name, folder in folders.items()}
    images = {name: dict(zip(held.numbers, held.paths, strict=True)) for name, held in named.items()}
    times = {name: _times(Path(folder), named[name], rate_hz) for name, folder in folders.items()}
    order = sorted((times[name][number], name, number) for name in folders for number in images[name])

    found = {name: _colors(Path(folder), name, named[name]) for name, folder in folders.items()}
    colors, warnings = _aligned_colors(cameras, {name: held for name, (held, _) in found.items()})
    for name, (_, why) in found.items():
        warnings += why if colors[name] else ()
    warnings += _lost_colors({name: images[name] for name in folders if named[name].times is None}, colors)

    def frames() -> Iterator[RecordedFrame]:
        for t, name, number in order:
            path = colors[name].get(number)
            color = None if path is None else read_color(path)
            yield RecordedFrame(name, t, read_depth(images[name][number]), color)

    source = f"depth images {', '.join(Path(folder).name for folder in folders.values())}"
    return Recording(cameras, frames(), source, warnings=tuple(warnings))


def _camera(folder: Path, name: str) -> CameraInfo:
    path = next((folder / file for file in _JSON_NAMES if (folder / file).is_file()), None)
    if path is None:
        raise EpisodeError(f"{folder} has none of {', '.join(_JSON_NAMES)}; the intrinsics must be stated.")
    data = read_json(path, error=EpisodeError)
    kind = _Open3DCamera if isinstance(data, dict) and "intrinsic_matrix" in data else _OwnCamera
    try:
        return kind.model_validate(data).camera(name)
    except ValidationError as error:
        raise explain(path, error, EpisodeError) from error


class _OwnCamera(CameraFile):
    """Schema of `camera.json` as in raw episodes. The default serial number is the folder's camera name."""

    serial: Name | None = None  # type: ignore[assignment]

    def camera(self, name: str) -> CameraInfo:
        return replace(super().camera(name), serial=self.serial or name, calibration=None)


class _Open3DCamera(BaseModel):
    """Schema of Open3D's camera JSON. Other fields are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    width: Pixels
    height: Pixels
    intrinsic_matrix: Annotated[list[Component], Field(min_length=9, max_length=9)]
    """Nine numbers in column-major order."""
    depth_scale: Annotated[float, Field(ge=50, le=1e6)] = 1000.0
    """Depth units per metre."""
    serial_number: Name | None = None

    @model_validator(mode="after")
    def _is_a_camera(self) -> Self:
        self.intrinsics()
        return self

    def intrinsics(self) -> Intrinsics:
        fx, _, _, _, fy, _, cx, cy, _ = self.intrinsic_matrix
        held = {"width": self.width, "height": self.height, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
        return IntrinsicsFile.model_validate(held).intrinsics()

    def camera(self, name: str) -> CameraInfo:
        return CameraInfo(name, self.serial_number or name, self.intrinsics(), 1 / self.depth_scale)


def _times(folder: Path, named: NamedFrames, rate_hz: float | None) -> dict[int, float]:
    numbers = list(named.numbers)
    if named.times is not None:
        if (folder / "timestamps.csv").is_file():
            raise EpisodeError(
                f"{folder}: the names of the depth images are times ({named.paths[0].name}), and there is a timestamps.csv."
                " Remove timestamps.csv to use the names, or rename the images to its frame numbers."
            )
        named.check_rate(rate_hz, folder / "depth")
        return dict(zip(numbers, named.times.tolist(), strict=True))
    if (folder / "timestamps.csv").is_file():
        frames, times = read_timestamps(folder / "timestamps.csv")
        known = dict(zip(frames.tolist(), times.tolist(), strict=True))
        missing = [number for number in numbers if number not in known]
        if missing:
            raise EpisodeError(f"{folder / 'timestamps.csv'} lacks frames {missing[:5]}.")
        bad = first_backwards(np.array([known[number] for number in numbers]))
        if bad is not None:
            frame, before = numbers[bad], numbers[bad - 1]
            raise EpisodeError(
                f"{folder / 'timestamps.csv'}: the time runs backwards: frame {frame} is of {known[frame]:.6f} s, frame "
                f"{before} of {known[before]:.6f} s. The clock was set while recording, or rows were mixed up: put the "
                "times right, or cut the recording there."
            )
        return known
    if rate_hz is None:
        raise EpisodeError(f"{folder} has no timestamps.csv; give the frame rate with --rate-hz.")
    check_frame_rate(rate_hz)
    return {number: (number - numbers[0]) / rate_hz for number in numbers}


def _colors(folder: Path, camera: str, depth: NamedFrames) -> tuple[dict[int, Path], tuple[str, ...]]:
    """Return (depth image number -> colour image, warnings). Colour may be missing for some or all depth images."""
    if not files_in(folder / "color", *_IMAGES):
        return {}, ()
    held = named_frames(folder / "color", _IMAGES, kind="images", gaps=True)
    if (held.times is None) != (depth.times is None):
        raise EpisodeError(
            f"{folder}: the images in depth ({depth.paths[0].name}) and color ({held.paths[0].name}) are not named alike: "
            "one by times, the other by frame numbers. Name both in one way, or remove the folder color."
        )
    if held.times is None or depth.times is None:
        return dict(zip(held.numbers, held.paths, strict=True)), ()
    nearest = pair(camera, f"{folder / 'depth'}", depth.times, held.times)
    pairs = enumerate(nearest.colors.tolist())
    return {frame: held.paths[number] for frame, number in pairs if number >= 0}, nearest.warnings


def _aligned_colors(
    cameras: Mapping[str, CameraInfo], colors: Mapping[str, dict[int, Path]]
) -> tuple[dict[str, dict[int, Path]], list[str]]:
    """Drop colour images whose size differs from depth, and return a warning for each such camera.

    Only the first image of each camera is checked.
    """
    aligned, warnings = dict(colors), list[str]()
    for name, images in colors.items():
        size = (cameras[name].intrinsics.height, cameras[name].intrinsics.width)
        own = next((read_color(path).shape[:2] for path in images.values()), size)
        if own != size:
            aligned[name] = {}
            warnings.append(
                f"Camera {name}: colour is left out, as it is not aligned to depth: it has {own[1]} x {own[0]} pixels, "
                f"depth {size[1]} x {size[0]}."
            )
    return aligned, warnings


def _lost_colors(images: Mapping[str, dict[int, Path]], colors: Mapping[str, dict[int, Path]]) -> Iterator[str]:
    for name, numbers in images.items():
        lost = sorted(set(numbers) - set(colors[name]))
        if colors[name] and lost:
            yield (
                f"Camera {name}: {len(lost)} of {len(numbers)} frames have no colour image of their number, such as frame "
                f"{lost[0]}."
            )
