"""The report: one self-contained HTML page."""

from diffcloud.report.comparison import ComparisonEntry
from diffcloud.report.figures import comparison_figures, overlay_figure
from diffcloud.report.page import EpisodeEntry, build_page
from diffcloud.report.regressors import TrainingEntry

__all__ = ["ComparisonEntry", "EpisodeEntry", "TrainingEntry", "build_page", "comparison_figures", "overlay_figure"]
