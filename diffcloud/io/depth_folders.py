"""Folders of PNG depth images and a JSON of the camera, as simple recorders and Open3D write them.

<folder>/depth/*.png    16-bit, numbered          <folder>/color/*.png or *.jpg    optional, same numbers
<folder>/camera.json    as in raw episodes, or Open3D's {width, height, intrinsic_matrix (column-major), depth_scale}
<folder>/timestamps.csv frame, t_s                optional; else the rate is given
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from diffcloud.errors import EpisodeError
from diffcloud.io.camera_models import read_intrinsics, read_transform
from diffcloud.io.files import files_in, read_json
from diffcloud.io.images import decode_color, read_depth
from diffcloud.io.raw_episodes import CameraInfo, first_backwards, read_timestamps
from diffcloud.io.recordings import RecordedFrame, Recording

_JSON_NAMES = ("camera.json", "intrinsics.json", "camera_intrinsic.json", "intrinsic.json")


def depth_folders(folders: Mapping[str, Path], *, rate_hz: float | None = None) -> Recording:
    """A recording from one folder per camera.

    Args:
        folders: by the camera's name.
        rate_hz: of frames without timestamps.csv.

    Raises:
        EpisodeError: no images, no camera JSON, gaps in the numbers, JPEG depth, no times, or times that run backwards.
    """
    cameras = {name: _camera(Path(folder), name) for name, folder in folders.items()}
    images = {name: _numbered(Path(folder) / "depth", (".png", ".jpg", ".jpeg")) for name, folder in folders.items()}
    times = {name: _times(Path(folder), sorted(images[name]), rate_hz) for name, folder in folders.items()}
    order = sorted((times[name][number], name, number) for name in folders for number in images[name])

    colors = {name: _colors(Path(folder)) for name, folder in folders.items()}

    def frames() -> Iterator[RecordedFrame]:
        for t, name, number in order:
            path = colors[name].get(number)
            color = None if path is None else decode_color(path.read_bytes(), str(path))
            yield RecordedFrame(name, t, read_depth(images[name][number]), color)

    source = f"depth images {', '.join(Path(folder).name for folder in folders.values())}"
    return Recording(cameras, frames(), source, warnings=tuple(_lost_colors(images, colors)))


def _camera(folder: Path, name: str) -> CameraInfo:
    path = next((folder / file for file in _JSON_NAMES if (folder / file).is_file()), None)
    if path is None:
        raise EpisodeError(f"{folder} has none of {', '.join(_JSON_NAMES)}; the intrinsics must be stated.")
    data = read_json(path, error=EpisodeError)
    if not isinstance(data, dict):
        raise EpisodeError(f"{path} must be a JSON object.")
    try:
        if "intrinsic_matrix" in data:
            matrix = np.asarray(data["intrinsic_matrix"], dtype=np.float64).reshape(3, 3).T
            held = {"width": data["width"], "height": data["height"], "fx": matrix[0, 0], "fy": matrix[1, 1]}
            intrinsics = read_intrinsics({**held, "cx": matrix[0, 2], "cy": matrix[1, 2]}, str(path))
            scale = 1 / float(data.get("depth_scale", 1000.0))  # Open3D: units per metre
        else:
            intrinsics = read_intrinsics(data["intrinsics"], str(path))
            scale = float(data["depth_scale_m"])
    except (KeyError, TypeError, ValueError) as error:
        raise EpisodeError(f"{path}: a field is missing or wrong: {error!r}.") from error
    pose = data.get("T_world_camera")
    place = None if pose is None else read_transform(pose, f"{path}: T_world_camera")
    return CameraInfo(name, str(data.get("serial", data.get("serial_number", name))), intrinsics, scale, place)


def _times(folder: Path, numbers: list[int], rate_hz: float | None) -> dict[int, float]:
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
    return {number: (number - numbers[0]) / rate_hz for number in numbers}


def _colors(folder: Path) -> dict[int, Path]:
    return _numbered(folder / "color", (".png", ".jpg", ".jpeg")) if (folder / "color").is_dir() else {}


def _lost_colors(images: Mapping[str, dict[int, Path]], colors: Mapping[str, dict[int, Path]]) -> Iterator[str]:
    for name, numbers in images.items():
        lost = sorted(set(numbers) - set(colors[name]))
        if colors[name] and lost:
            yield (
                f"Camera {name}: {len(lost)} of {len(numbers)} frames have no colour image of their number, such as frame "
                f"{lost[0]}."
            )


def _numbered(folder: Path, formats: tuple[str, ...]) -> dict[int, Path]:
    if not folder.is_dir():
        raise EpisodeError(f"No such folder of images: {folder}.")
    found: dict[int, Path] = {}
    for path in files_in(folder, *formats):
        match = re.search(r"(\d+)$", path.stem)
        if match:
            found[int(match.group(1))] = path
    if not found:
        raise EpisodeError(f"{folder} holds no numbered images such as 000000.png.")
    gaps = sorted(set(range(min(found), max(found) + 1)) - set(found))
    if gaps:
        raise EpisodeError(f"{folder}: frames {gaps[:10]} are missing between {min(found)} and {max(found)}.")
    return found
