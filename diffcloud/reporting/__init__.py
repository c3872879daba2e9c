"""The report: one self-contained HTML page."""

from diffcloud.reporting.comparison import ComparisonEntry
from diffcloud.reporting.figures import comparison_figures, overlay_figure
from diffcloud.reporting.page import EpisodeEntry, build_page
from diffcloud.reporting.regressors import TrainingEntry

__all__ = ["ComparisonEntry", "EpisodeEntry", "TrainingEntry", "build_page", "comparison_figures", "overlay_figure"]
