"""Parameters of a recorded episode."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffcloud.errors import EpisodeError
from diffcloud.io.episodes import Episode
from diffcloud.regressors.checkpoints import Prediction, Regressor


def episode_clouds(regressor: Regressor, episode: Episode, *, seed: int = 0) -> Tensor:
    """The frames of an episode that a regressor sees, each thinned to its number of points.

    What the regressor knows as background is left out. Each is the recorded frame nearest in time, so that recordings of
    other rates, or that begin with the first moved frame, fit as well. Points are drawn without repeats where there are
    enough: the order of a recording, by camera and by row, must not decide which points a network groups.

    Args:
        seed: of the choice of points.

    Returns:
        float32 [1, T, P, 3].

    Raises:
        EpisodeError: a frame of the training has no recorded one within a frame's time.
    """
    told = regressor.description
    wanted = np.array(told.times)
    distance = np.abs(episode.times - wanted[:, None])  # [T, recorded]
    chosen = distance.argmin(axis=1)
    missing = np.flatnonzero(distance.min(axis=1) > told.frame_time * (1 + 1e-6))
    if len(missing):
        raise EpisodeError(
            f"This {told.model} looks at {wanted[missing[0]]:.3g} s, but the episode's {episode.frame_count} frames run "
            f"from {episode.times[0]:.3g} to {episode.times[-1]:.3g} s. Record the whole motion of {told.scenario}."
        )
    rng = np.random.default_rng(seed)
    background = None if told.background is None else told.background.build()
    clouds = []
    for index in chosen:  # frames are ragged
        cloud = episode.frame(int(index))
        if background is not None:
            free = cloud[~background.holds(torch.from_numpy(cloud)).numpy()]
            cloud = free if len(free) else cloud
        clouds.append(cloud[rng.choice(len(cloud), told.points, replace=len(cloud) < told.points)])
    return torch.from_numpy(np.stack(clouds))[None]


def predict_episode(regressor: Regressor, episode: Episode, *, seed: int = 0) -> Prediction:
    """Parameters of one episode, as a batch of one.

    Raises:
        EpisodeError: the episode lacks the frames that the regressor sees.
    """
    return regressor.predict(episode_clouds(regressor, episode, seed=seed))
