"""Prediction of the parameters of a recorded episode."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError
from diffcloud.io.episodes import Episode
from diffcloud.regressors.checkpoints import Prediction, Regressor


def recorded_frames(regressor: Regressor, episode: Episode) -> list[NDArray[np.float32]]:
    """Return the T clouds [N, 3] of an episode that a regressor needs.

    Each is the recorded frame nearest in time. So recordings may have another frame rate, or begin with the first moved
    frame.

    Raises:
        EpisodeError: there is no recorded frame within one frame time of a training frame.
    """
    told = regressor.description
    wanted = np.array(told.times)
    distance = np.abs(episode.times - wanted[:, None])  # [T, recorded]
    missing = np.flatnonzero(distance.min(axis=1) > told.frame_time * (1 + 1e-6))
    if len(missing):
        raise EpisodeError(
            f"This {told.model} looks at {wanted[missing[0]]:.3g} s, but the episode's {episode.frame_count} frames run "
            f"from {episode.times[0]:.3g} to {episode.times[-1]:.3g} s. Record the whole motion of {told.scenario}."
        )
    return [episode.frame(int(index)) for index in distance.argmin(axis=1)]


def predict_episode(regressor: Regressor, episode: Episode, *, seed: int = 0) -> Prediction:
    """Predict the parameters of one episode, as a batch of one.

    Args:
        seed: seed for the choice of points.

    Raises:
        EpisodeError: the episode lacks the frames that the regressor needs.
    """
    return regressor.predict([recorded_frames(regressor, episode)], seed=seed)
