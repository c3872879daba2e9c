"""Recordings of cameras and arm, real and synthetic, and what their clouds need before a fit."""

from diffcloud.sensing.filters import FilterReport, clean_frame
from diffcloud.sensing.whole_surface import sample_surface

__all__ = ["FilterReport", "clean_frame", "sample_surface"]
