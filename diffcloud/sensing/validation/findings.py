"""Result type of the checks of a raw episode, and their input."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from diffcloud.io.raw_episodes import CameraInfo


@dataclass(frozen=True)
class Finding:
    """One fault or warning."""

    severity: Literal["fault", "warning"]
    """A fault makes later results wrong; a warning should be looked at."""
    code: str
    """Identifier such as clock_gap."""
    place: str
    message: str


@dataclass(frozen=True)
class RecordedCamera:
    """The readable part of a camera's folder."""

    name: str
    folder: Path
    info: CameraInfo | None
    frames: NDArray[np.int64]
    times: NDArray[np.float64]
