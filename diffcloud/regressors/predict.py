"""Parameters of a recorded episode."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError
from diffcloud.io.episodes import Episode
from diffcloud.regressors.checkpoints import Prediction, Regressor


def recorded_frames(regressor: Regressor, episode: Episode) -> list[NDArray[np.float32]]:
    """The T clouds [N, 3] of an episode that a regressor looks at.

    Each is the recorded frame nearest in time, so that recordings of other rates, or that begin with the first moved frame,
    fit as well.

    Raises:
        EpisodeError: a frame of the training has no recorded one within a frame's time.
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
    """Parameters of one episode, as a batch of one.

    Args:
        seed: of the choice of points.

    Raises:
        EpisodeError: the episode lacks the frames that the regressor sees.
    """
    return regressor.predict([recorded_frames(regressor, episode)], seed=seed)
