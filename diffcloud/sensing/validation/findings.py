"""What checks of a raw episode say, and what they look at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from diffcloud.io.raw_episodes import CameraInfo


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, or may be."""

    severity: Literal["fault", "warning"]
    """A fault makes what follows wrong; a warning is worth a look."""
    code: str
    """A word to filter by, such as clock_gap."""
    place: str
    message: str


@dataclass(frozen=True)
class RecordedCamera:
    """A camera's folder, as far as it could be read."""

    name: str
    folder: Path
    info: CameraInfo | None
    frames: NDArray[np.int64]
    times: NDArray[np.float64]
