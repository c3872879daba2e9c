"""A camera that is a folder being written: another program stores images there, and they are recorded as they appear.

<folder>/camera.json     as in raw episodes: intrinsics, depth_scale_m
<folder>/depth/*.png     16-bit, numbered; written under another name and renamed, or written at once
<folder>/color/*.png     optional, of the same names, and there before the depth image

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
"""An image that cannot be read for so long is damaged, and not only half-written."""


class FolderCamera:
    """A driver: keeps the protocol `devices.Camera`.

    Args:
        name: of the camera in the episode.
        serial: the folder.
    """

    def __init__(self, name: str, serial: str, **_: Any) -> None:
        self.name, self._folder = name, Path(serial)
        self._seen: set[str] | None = None

    def open(self) -> CameraInfo:
        try:
            info = read_camera_info(self._folder / "camera.json")
        except EpisodeError as error:
            raise HardwareError(f"Camera {self.name}: {error}") from error
        self._seen = {path.name for path in self._images()}  # what was there before is no frame of this recording
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
                time.sleep(_LOOK_S)  # it is still being written
