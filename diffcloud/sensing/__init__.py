"""Synthetic recordings, and what recorded clouds need before a fit."""

from diffcloud.sensing.depth_camera import DepthCamera, default_cameras
from diffcloud.sensing.filters import FilterReport, clean_frame
from diffcloud.sensing.recorder import record, sample_surface

__all__ = ["DepthCamera", "FilterReport", "clean_frame", "default_cameras", "record", "sample_surface"]
