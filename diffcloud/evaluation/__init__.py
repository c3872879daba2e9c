"""Comparison of methods under equal conditions, and intervals of the parameters."""

from diffcloud.evaluation.episode import BASELINES, ComparisonSettings, EpisodeRecord, compare_episode
from diffcloud.evaluation.intervals import Intervals, intervals_of
from diffcloud.evaluation.landscape import loss_landscape
from diffcloud.evaluation.methods import Baseline, Estimate, Gap
from diffcloud.evaluation.metrics import EpisodeMeter

__all__ = [
    "BASELINES",
    "Baseline",
    "ComparisonSettings",
    "EpisodeMeter",
    "EpisodeRecord",
    "Estimate",
    "Gap",
    "Intervals",
    "compare_episode",
    "intervals_of",
    "loss_landscape",
]
