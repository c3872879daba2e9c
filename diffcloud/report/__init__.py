"""The report: one self-contained HTML page."""

from diffcloud.report.page import EpisodeEntry, build_page
from diffcloud.report.regressors import TrainingEntry

__all__ = ["EpisodeEntry", "TrainingEntry", "build_page"]
