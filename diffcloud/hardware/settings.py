"""How a capture runs."""

from __future__ import annotations

from dataclasses import dataclass

from diffcloud.hardware.trajectory import DEFAULT_GAIN


@dataclass(frozen=True)
class CaptureSettings:
    """How a capture runs."""

    rate_hz: float = 10.0
    """Of control, and of the episode."""
    frames_hz: float | None = None
    """So many of a camera's frames are written in a second, evenly; None writes all."""
    gain: float = DEFAULT_GAIN
    approach_speed_m_s: float = 0.1
    """Of the tool on the way to the first keyframe, and of the arm's fastest point on the way home."""
    go_home: bool = False
    hold_s: float = 0.5
    """Recorded at rest after the last keyframe."""
    camera_timeout_s: float = 1.0
    durable: bool = True
