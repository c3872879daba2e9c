"""Settings of a capture."""

from __future__ import annotations

from dataclasses import dataclass

from diffcloud.hardware.trajectory import DEFAULT_GAIN


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of a capture."""

    rate_hz: float = 10.0
    """Rate of the control loop and of the episode."""
    frames_hz: float | None = None
    """Number of frames written per second and camera, evenly spaced. None writes all."""
    gain: float = DEFAULT_GAIN
    approach_speed_m_s: float = 0.1
    """Speed of the tool during the approach, and of the arm's fastest point on the way home."""
    go_home: bool = False
    hold_s: float = 0.5
    """Time at rest after the last keyframe that is recorded too."""
    camera_timeout_s: float = 1.0
    durable: bool = True
