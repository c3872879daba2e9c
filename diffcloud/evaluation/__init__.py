"""Comparing methods on equal terms, and what can be known of the parameters."""

from diffcloud.evaluation.episode import RIVALS, ComparisonSettings, EpisodeRecord, compare_episode
from diffcloud.evaluation.intervals import Intervals, intervals_of
from diffcloud.evaluation.landscape import loss_landscape
from diffcloud.evaluation.methods import Estimate, Gap, Rival
from diffcloud.evaluation.metrics import EpisodeMeter

__all__ = [
    "RIVALS",
    "ComparisonSettings",
    "EpisodeMeter",
    "EpisodeRecord",
    "Estimate",
    "Gap",
    "Intervals",
    "Rival",
    "compare_episode",
    "intervals_of",
    "loss_landscape",
]
