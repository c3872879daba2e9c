"""The report: one self-contained HTML page."""

from diffcloud.report.page import EpisodeEntry, build_page

__all__ = ["EpisodeEntry", "build_page"]
