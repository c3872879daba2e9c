"""A camera driver that reads images which another program writes into a folder.

<folder>/camera.json     as in raw episodes: intrinsics, depth_scale_m
<folder>/depth/*.png     16-bit, numbered; best written under another name and then renamed
<folder>/color/*.png     optional, with the same names, written before the depth image

In rig.yaml: `camera_driver: diffcloud.hardware.examples.folder_camera:FolderCamera` and `cameras: {side: /data/side}`.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from diffcloud.errors import EpisodeError, HardwareError
from diffcloud.hardware.devices import CameraFrame
from diffcloud.io.files import files_in
from diffcloud.io.images import read_color, read_depth
from diffcloud.io.raw_episodes import CameraInfo, read_camera_info

_LOOK_S = 0.005
_SETTLED_S = 1.0
"""Time after which an unreadable image is considered damaged. Before, it may still be being written."""


class FolderCamera:
    """A camera driver that implements `devices.Camera`.

    Args:
        name: name of the camera in the episode.
        serial: path of the folder.
    """

    def __init__(self, name: str, serial: str, **_: Any) -> None:
        self.name, self._folder = name, Path(serial)
        self._seen: set[str] | None = None

    def open(self) -> CameraInfo:
        try:
            info = read_camera_info(self._folder / "camera.json")
        except EpisodeError as error:
            raise HardwareError(f"Camera {self.name}: {error}") from error
        self._seen = {path.name for path in self._images()}  # ignore images from before the recording
        return replace(info, name=self.name)

    def read(self, timeout_s: float) -> CameraFrame:
        if self._seen is None:
            raise HardwareError(f"Camera {self.name} is not open.")
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            path = next((path for path in self._images() if path.name not in self._seen), None)
            if path is not None:
                frame = self._frame(path, min(end, time.monotonic() + _SETTLED_S))
                self._seen.add(path.name)
                return frame
            time.sleep(_LOOK_S)
        raise HardwareError(f"Camera {self.name} delivered no frame for {timeout_s:g} s: nothing new in {self._folder}.")

    def close(self) -> None:
        self._seen = None

    def _images(self) -> list[Path]:
        return files_in(self._folder / "depth", ".png")

    def _frame(self, path: Path, end: float) -> CameraFrame:
        appeared = time.monotonic()
        color = self._folder / "color" / path.name
        while True:
            try:
                return CameraFrame(appeared, read_depth(path), read_color(color) if color.is_file() else None)
            except EpisodeError as error:
                if time.monotonic() > end:
                    raise HardwareError(f"Camera {self.name}: {error}") from error
                time.sleep(_LOOK_S)  # the image may still be being written
